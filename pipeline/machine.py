"""What computes results: library versions, device and CPU. Recorded with entries, never part of a key."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path

from pipeline import __version__


def describe_machine(device: str = "cpu") -> dict[str, str]:
    """Versions, the device with its name, the CPU with its instruction set, and the number of worker threads.

    Results depend on all of them except the threads. ``device``: a torch name.
    """
    import cv2  # here, since commands that only print descriptions need none of these
    import numpy as np
    import scipy
    import torch

    from pipeline.parallel import worker_count

    return {
        "dzop": __version__,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "opencv": cv2.__version__,
        "poselib": version("poselib"),
        "zarr": version("zarr"),
        "device": torch.cuda.get_device_name(device) if device.startswith("cuda") else device,
        "cpu": f"{cpu_model()}, {torch.backends.cpu.get_cpu_capability()}",
        "threads": str(worker_count()),
    }


@lru_cache(maxsize=1)
def cpu_model() -> str:
    """Name of the CPU, as the system gives it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor() or platform.machine())


def machine_text(made_by: Mapping[str, str]) -> str:
    """A description in one line, without the threads, which change no result."""
    libraries = ("dzop", "python", "torch", "numpy", "scipy", "opencv", "poselib", "zarr")
    parts = [f"{name} {made_by[name]}" for name in libraries if name in made_by]
    return ", ".join([*parts, f"on {made_by.get('device', '?')} ({made_by.get('cpu', '?')})"])
