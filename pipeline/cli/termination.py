"""Ending a command from outside: SIGTERM and SIGHUP stop it as Ctrl-C does, with the processes that it started.

So does a worker process that was killed while it sent a result: joblib's pool, loky, would wait for the rest for ever.
"""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType

import psutil

_SIGNALS = (signal.SIGTERM, signal.SIGHUP)
_GRACE_S = 3.0
_WATCH_S, _NOTICED_S = 5.0, 20.0
"""Seconds between two looks at the worker processes, and within which loky notices that one has died."""
_WORKER = "popen_loky"  # in the command line of loky's processes


class Terminated(KeyboardInterrupt):
    """The process was asked to end. Handled wherever Ctrl-C is."""


class WorkerLost(Terminated):
    """A worker process died and its pool did not notice."""


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


@contextmanager
def stop_on_lost_workers() -> Iterator[None]:
    """Inside the block, a dead worker process that loky does not notice raises WorkerLost in the main thread.

    Inside ``stop_on_signals`` only. loky reaps a dead process as soon as it notices; one that stays a zombie means
    that loky's thread waits for the rest of its last message.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    done = threading.Event()
    previous = signal.getsignal(signal.SIGUSR1)
    signal.signal(signal.SIGUSR1, _raise_lost)
    watch = threading.Thread(target=_watch_workers, args=(done,), daemon=True)
    watch.start()
    try:
        yield
    finally:
        done.set()
        signal.signal(signal.SIGUSR1, previous)


def _watch_workers(done: threading.Event) -> None:
    workers: set[psutil.Process] = set()
    dead_since: dict[psutil.Process, float] = {}
    while not done.wait(_WATCH_S):
        workers |= {child for child in psutil.Process().children() if _is_worker(child)}
        zombies = {worker for worker in workers if _is_zombie(worker)}
        dead_since = {worker: dead_since.get(worker, time.monotonic()) for worker in zombies}
        if any(time.monotonic() - since > _NOTICED_S for since in dead_since.values()) and not done.is_set():
            signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGUSR1)
            return


def _is_worker(process: psutil.Process) -> bool:
    try:
        return any(_WORKER in word for word in process.cmdline())
    except psutil.Error:
        return False


def _is_zombie(process: psutil.Process) -> bool:
    try:
        return bool(process.status() == psutil.STATUS_ZOMBIE)
    except psutil.Error:
        return False


def _raise_lost(number: int, frame: FrameType | None) -> None:
    raise WorkerLost


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
