"""Helpers: untrusted input must give a one-line DzopError within limits of time and memory."""

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
"""Examples per fuzz test, new ones in every run; 0: a few, always the same."""


def fuzz_settings(few: int):
    """Settings of a fuzz test."""
    return settings(
        max_examples=EXAMPLES or few,
        derandomize=not EXAMPLES,
        deadline=None,  # ``outcome`` limits CPU time, which does not depend on other processes
        database=None,
        suppress_health_check=list(HealthCheck),
    )


def outcome(call: Callable[[], object]) -> str:
    """The message of the DzopError raised, "read" without one; any other exception fails the test."""
    start = time.process_time()
    try:
        call()
    except DzopError as error:
        message = str(error)
    else:
        message = "read"
    assert time.process_time() - start < 10, message
    assert message.strip()
    assert "\n" not in message, message
    assert len(message) < 2000
    return message


def _run_limited(call: Callable[[], object], bytes_more: int, answer) -> None:
    try:
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + bytes_more, used + bytes_more))
        start = time.process_time()
        message = outcome(call)
        answer.put((message, time.process_time() - start))
    except BaseException:
        answer.put((traceback.format_exc(), 0.0))


def run_within(call: Callable[[], object], *, seconds: float, megabytes: int) -> str:
    """``outcome`` in a process with limited CPU time and memory."""
    context = multiprocessing.get_context("fork")
    answer = context.Queue()
    process = context.Process(target=_run_limited, args=(call, megabytes << 20, answer))
    process.start()
    try:
        message, taken = answer.get(timeout=60)
    finally:
        process.kill()
        process.join()
    assert "Traceback" not in message, message
    assert "MemoryError" not in message, f"rejected only when out of memory: {message}"
    assert taken < seconds, f"{taken:.1f} s: {message}"
    return message


def message_within(call: Callable[[], object], *, seconds: float, megabytes: int) -> str:
    """The message of the DzopError raised in a process with limited CPU time and memory."""
    message = run_within(call, seconds=seconds, megabytes=megabytes)
    assert message != "read"
    return message
