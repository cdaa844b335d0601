"""Several runs of the pipeline at a time, as processes that end together if one fails or Ctrl-C is pressed."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from pipeline.errors import DzopError

RunName = tuple[str, str]
"""Title of the table, name of the system."""

_POLL_S = 0.1


@dataclass(frozen=True, eq=False)
class _Running:
    """A started run."""

    name: RunName
    process: subprocess.Popen[bytes]
    start: float

    def check(self) -> bool:
        """Whether the run has finished. Raises DzopError if it failed."""
        code = self.process.poll()
        if code is None:
            return False
        if code:
            killed = f"was killed by signal {-code}, often because memory ran out"
            why = killed if code < 0 else "failed, see above"
            raise DzopError(f"no table: {', '.join(self.name)}: the run {why}; run the same command again to resume")
        print(f"{', '.join(self.name)}: {time.perf_counter() - self.start:.0f} s", file=sys.stderr, flush=True)
        return True


def run_all(overrides_of: Mapping[RunName, Sequence[str]], *, jobs: int) -> None:
    """Run the pipeline with each list of overrides, ``jobs`` runs at a time; print a line for each finished run.

    If a run fails or on Ctrl-C, the others are terminated; completed cache entries are kept. Raises DzopError or
    KeyboardInterrupt.
    """
    waiting = list(overrides_of)
    running: list[_Running] = []
    with _deferred_interrupts() as interrupts:
        try:
            while waiting or running:
                while waiting and len(running) < jobs:
                    name = waiting.pop(0)
                    running.append(_start(name, overrides_of[name]))
                time.sleep(_POLL_S)
                if interrupts:
                    raise KeyboardInterrupt
                running = [run for run in running if not run.check()]
        finally:
            for run in running:
                run.process.terminate()
            for run in running:
                run.process.wait()


def _start(name: RunName, overrides: Sequence[str]) -> _Running:
    command = [sys.executable, "-m", "pipeline", *overrides, "runtime.progress=false"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, process_group=0)
    return _Running(name, process, time.perf_counter())


@contextmanager
def _deferred_interrupts() -> Iterator[list[int]]:
    """Collect Ctrl-C in a list instead of raising: between a start and its record, the new process would be lost."""
    interrupts: list[int] = []
    before = signal.getsignal(signal.SIGINT)
    if before is signal.default_int_handler:
        signal.signal(signal.SIGINT, lambda number, _: interrupts.append(number))
    try:
        yield interrupts
    finally:
        signal.signal(signal.SIGINT, before)
