"""Ending a command from outside: SIGTERM and SIGHUP stop it as Ctrl-C does, with the processes that it started."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType

import psutil

_SIGNALS = (signal.SIGTERM, signal.SIGHUP)
_GRACE_S = 3.0


class Terminated(KeyboardInterrupt):
    """The process was asked to end. Handled wherever Ctrl-C is."""


@contextmanager
def stop_on_signals() -> Iterator[None]:
    """Inside the block the first SIGTERM or SIGHUP raises Terminated; a second one ends the process at once.

    A signal that the caller ignores, such as SIGHUP under nohup, stays ignored.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    replaced = [number for number in _SIGNALS if signal.getsignal(number) is signal.SIG_DFL]
    for number in replaced:
        signal.signal(number, _raise_terminated)
    try:
        yield
    finally:
        for number in replaced:
            signal.signal(number, signal.SIG_DFL)


def _raise_terminated(number: int, frame: FrameType | None) -> None:
    signal.signal(number, signal.SIG_DFL)
    raise Terminated


def stop_children() -> None:
    """End all processes that this one has started and that still run: workers of a sweep or of a local cluster.

    Python's resource trackers are left alone: they clean up and end once this process has ended.
    """
    children = [child for child in psutil.Process().children(recursive=True) if not _is_resource_tracker(child)]
    for child in children:
        with suppress(psutil.Error):
            child.terminate()
    _, alive = psutil.wait_procs(children, timeout=_GRACE_S)
    for child in alive:
        with suppress(psutil.Error):
            child.kill()


def _is_resource_tracker(process: psutil.Process) -> bool:
    try:
        return any("resource_tracker" in word for word in process.cmdline())
    except psutil.Error:
        return False
