"""What hostile input is held to: our own error in one line, in little time and memory."""

import multiprocessing
import os
import resource
import time
import traceback
from collections.abc import Callable
from pathlib import Path

from hypothesis import HealthCheck, settings

from pipeline.errors import DzopError

EXAMPLES = int(os.environ.get("DZOP_FUZZ", "0"))
"""Examples of every fuzz test, fresh ones in every run; 0: few, always the same."""


def fuzzed(few: int):
    """Settings of a fuzz test."""
    return settings(
        max_examples=EXAMPLES or few,
        derandomize=not EXAMPLES,
        deadline=None,  # ``outcome`` counts the processor's time, which no neighbour can lengthen
        database=None,
        suppress_health_check=list(HealthCheck),
    )


def outcome(call: Callable[[], object]) -> str:
    """ "read", or the one line of our own error; whatever else is raised fails the test."""
    start = time.process_time()
    try:
        call()
    except DzopError as error:
        told = str(error)
    else:
        told = "read"
    assert time.process_time() - start < 10, told
    assert told.strip()
    assert "\n" not in told, told
    assert len(told) < 2000
    return told


def _within(call: Callable[[], object], bytes_more: int, answer) -> None:
    try:
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + bytes_more, used + bytes_more))
        start = time.process_time()
        told = outcome(call)
        answer.put((told, time.process_time() - start))
    except BaseException:
        answer.put((traceback.format_exc(), 0.0))


def within(call: Callable[[], object], *, seconds: float, megabytes: int) -> str:
    """The outcome in a process that may not take more than this."""
    context = multiprocessing.get_context("fork")
    answer = context.Queue()
    process = context.Process(target=_within, args=(call, megabytes << 20, answer))
    process.start()
    try:
        told, taken = answer.get(timeout=60)
    finally:
        process.kill()
        process.join()
    assert "Traceback" not in told, told
    assert "MemoryError" not in told, f"refused only when the memory was spent: {told}"
    assert taken < seconds, f"{taken:.1f} s: {told}"
    return told


def refused_within(call: Callable[[], object], *, seconds: float, megabytes: int) -> str:
    """The message of our own error, raised in a process that may not take more than this."""
    told = within(call, seconds=seconds, megabytes=megabytes)
    assert told != "read"
    return told
