"""Times that survive a busy machine: CPU seconds beside wall seconds, medians, and contestants that take turns."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import psutil
import torch


def peak_bytes() -> int:
    """The most memory of this process that was resident (Linux). getrusage's would begin with its parent's peak."""
    status = Path("/proc/self/status").read_text()
    return 1024 * int(status.split("VmHWM:")[1].split()[0])


@dataclass(frozen=True)
class Times:
    """Medians of one contestant, in seconds. ``cpu_s``: of all of this process's threads together."""

    cpu_s: float
    wall_s: float


@dataclass(frozen=True)
class Figure:
    """A measured value, what it was measured against, and the target it has to meet (None: none is set)."""

    name: str
    value: float
    unit: str
    against: str = ""
    target: float | None = None
    better: Literal["less", "more"] = "less"

    @property
    def verdict(self) -> str:
        """``pass``, or by how much the target is missed; "" where there is none."""
        if self.target is None:
            return ""
        if self.value <= self.target if self.better == "less" else self.value >= self.target:
            return "pass"
        factor = self.value / self.target if self.better == "less" else self.target / max(self.value, 1e-12)
        return f"short by a factor of {factor:.2f}"

    def record(self) -> dict[str, Any]:
        """JSON-able."""
        return {**vars(self), "verdict": self.verdict}


def interleaved(contestants: Mapping[str, Callable[[], object]], *, repeats: int) -> dict[str, Times]:
    """Medians of contestants that take turns, so that whatever else runs here disturbs all of them alike.

    The first turn warms caches and is not counted.
    """
    seen: dict[str, list[tuple[float, float]]] = {name: [] for name in contestants}
    for turn in range(repeats + 1):
        for name, contestant in contestants.items():
            cpu, wall = time.process_time(), time.perf_counter()
            contestant()
            if torch.cuda.is_available():
                torch.cuda.synchronize()
            if turn:
                seen[name].append((time.process_time() - cpu, time.perf_counter() - wall))
    return {
        name: Times(*(float(np.median(column)) for column in zip(*rows, strict=True))) for name, rows in seen.items()
    }


def machine(device: str) -> dict[str, Any]:
    """What a figure has to be read with."""
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


def table(figures: list[Figure]) -> str:
    """A line for each figure."""
    heads = ("what", "measured", "target", "verdict", "against")
    rows = [heads]
    for figure in figures:
        sign = "" if figure.target is None else f"{'<=' if figure.better == 'less' else '>='} {figure.target:g}"
        rows.append((figure.name, f"{figure.value:.4g} {figure.unit}", sign, figure.verdict, figure.against))
    widths = [max(len(row[k]) for row in rows) for k in range(len(heads))]
    return "\n".join("  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows)
