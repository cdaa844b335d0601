"""Seconds until the package is imported, and until the command line has printed its help, in new processes."""

from __future__ import annotations

import os
import resource
import subprocess
import sys

import numpy as np

from benchmarks.cli_runs import ONE_THREAD, ROOT
from benchmarks.measure import Measurement

COMMANDS = {
    "import pipeline": ["-c", "import pipeline"],
    "python -m pipeline --help": ["-m", "pipeline", "--help"],
    "python -m pipeline cache --help": ["-m", "pipeline", "cache", "--help"],
}


def imports(*, device: str, repeats: int) -> list[Measurement]:
    """CPU seconds of each command, the interpreter's start included."""
    found = {name: [_cpu_s(command) for _ in range(min(repeats, 5))] for name, command in COMMANDS.items()}
    return [Measurement(name, float(np.median(times)), "s of one core") for name, times in found.items()]


def _cpu_s(arguments: list[str]) -> float:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    environment = os.environ | ONE_THREAD | {"PYTHONPATH": str(ROOT)}
    subprocess.run([sys.executable, *arguments], cwd=ROOT, env=environment, check=True, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
