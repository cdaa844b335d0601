"""Runs of the command line of any checkout, in processes of their own: CPU and wall seconds, peak memory."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from pipeline.errors import BadInput, DzopError

ROOT = Path(__file__).resolve().parents[1]
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "MALLOC_ARENA_MAX"), "1")
QUIET = ("overlays=false", "gallery=0", "runtime.progress=false", "evaluate.vsd=false")

_MEASURE = """
import json, pathlib, runpy, sys, time
start, target = time.perf_counter(), pathlib.Path(sys.argv[1])
sys.argv = ["dzop", *sys.argv[2:]]
try:
    runpy.run_module("pipeline", run_name="__main__", alter_sys=True)
finally:
    peak_kb = pathlib.Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0]
    usage = {"cpu_s": time.process_time(), "wall_s": time.perf_counter() - start, "peak_mb": int(peak_kb) / 1024}
    target.write_text(json.dumps(usage))
"""


@dataclass(frozen=True)
class Usage:
    """What a process took: CPU seconds of its threads, wall seconds without the interpreter's start, peak memory."""

    cpu_s: float
    wall_s: float
    peak_mb: float


def run_dzop(folder: Path, *overrides: str, checkout: Path = ROOT, threads: int = 1, **environment: str) -> Usage:
    """Run ``dzop`` with data, cache and results below ``folder``. Raises DzopError with its last line."""
    places = [f"{name}={folder / place}" for name, place in _PLACES.items() if not _is_set(name, overrides)]
    with tempfile.TemporaryDirectory() as name:
        usage = Path(name) / "usage.json"
        command = [sys.executable, "-c", _MEASURE, str(usage), *places, *QUIET, f"threads={threads}", *overrides]
        variables = os.environ | ONE_THREAD | {"PYTHONPATH": str(checkout)} | environment
        done = subprocess.run(command, cwd=checkout, env=variables, capture_output=True, text=True)
        if done.returncode:
            reason = (done.stderr.strip() or f"status {done.returncode}").splitlines()[-1]
            raise DzopError(f"dzop {' '.join(overrides)} in {checkout}: {reason}")
        return Usage(**json.loads(usage.read_text()))


_PLACES = {"dataset.root": "data", "store.root": "cache", "out": "out"}


def _is_set(name: str, overrides: tuple[str, ...]) -> bool:
    return any(override.startswith(f"{name}=") for override in overrides)


@contextmanager
def checkout_of(revision: str) -> Iterator[Path]:
    """A git worktree of a revision, removed afterwards. Raises BadInput for an unknown one."""
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "before"
        git = ["git", "-C", str(ROOT), "worktree"]
        try:
            subprocess.run([*git, "add", "--quiet", "--detach", str(path), revision], check=True, capture_output=True)
        except (OSError, subprocess.CalledProcessError):
            raise BadInput("--before", found=repr(revision), needed="a commit of this git checkout") from None
        try:
            yield path
        finally:
            subprocess.run([*git, "remove", "--force", str(path)], check=False)
