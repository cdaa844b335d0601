"""Timing on a shared machine: CPU and wall seconds, medians, candidates measured in turn."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
import psutil
import torch

K = TypeVar("K", bound=Hashable)


def peak_bytes() -> int:
    """Peak resident memory of this process, bytes (Linux). getrusage would start from the parent's peak."""
    status = Path("/proc/self/status").read_text()
    return 1024 * int(status.split("VmHWM:")[1].split()[0])


@dataclass(frozen=True)
class Times:
    """Median times of one candidate. ``cpu_s``: of all threads of this process together."""

    cpu_s: float
    wall_s: float


@dataclass(frozen=True)
class Measurement:
    """A measured value, the reference it is relative to ("": absolute), and its target, if it has one."""

    name: str
    value: float
    unit: str
    against: str = ""
    target: float | None = None
    better: Literal["less", "more"] = "less"

    @property
    def verdict(self) -> str:
        """``pass``, or by how much the target is missed; "" without a target."""
        if self.target is None:
            return ""
        if self.value <= self.target if self.better == "less" else self.value >= self.target:
            return "pass"
        factor = self.value / self.target if self.better == "less" else self.target / max(self.value, 1e-12)
        return f"short by a factor of {factor:.2f}"

    def to_record(self) -> dict[str, Any]:
        """The fields and the verdict, for JSON."""
        return {**vars(self), "verdict": self.verdict}


def time_interleaved(candidates: Mapping[K, Callable[[], object]], *, repeats: int) -> dict[K, Times]:
    """Median times of candidates that are run in turn, so that other load on the machine affects all of them equally.

    The first round warms caches and is not counted.
    """
    times: dict[K, list[tuple[float, float]]] = {name: [] for name in candidates}
    for round_ in range(repeats + 1):
        for name, candidate in candidates.items():
            cpu, wall = time.process_time(), time.perf_counter()
            candidate()
            if torch.cuda.is_available():
                torch.cuda.synchronize()
            if round_:
                times[name].append((time.process_time() - cpu, time.perf_counter() - wall))
    return {
        name: Times(*(float(np.median(column)) for column in zip(*rows, strict=True))) for name, rows in times.items()
    }


def describe_machine(device: str) -> dict[str, Any]:
    """Hardware and library versions that the measurements depend on."""
    return {
        "cpu": _cpu_model(),
        "cores": os.cpu_count(),
        "memory_gb": round(psutil.virtual_memory().total / 1e9, 1),
        "load": [round(load, 2) for load in os.getloadavg()],
        "threads": torch.get_num_threads(),
        "device": torch.cuda.get_device_name() if device.startswith("cuda") else device,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "numpy": np.__version__,
    }


def _cpu_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "?")


def table(measurements: list[Measurement]) -> str:
    """One line per measurement."""
    heads = ("what", "measured", "target", "verdict", "compared with")
    rows = [heads]
    for m in measurements:
        sign = "" if m.target is None else f"{'<=' if m.better == 'less' else '>='} {m.target:g}"
        rows.append((m.name, f"{m.value:.4g} {m.unit}", sign, m.verdict, m.against))
    widths = [max(len(row[k]) for row in rows) for k in range(len(heads))]
    return "\n".join("  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows)
