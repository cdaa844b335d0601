"""CPU threads that never change a result.

Libraries split sums among their threads, and so round them differently with every number of threads. Each kernel
therefore runs on one thread, and the cores are used by computing independent items at the same time: passes of a
backbone, blocks of a matrix. Results are returned in the order of the items.
"""

from __future__ import annotations

import os
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, TypeVar

import cv2
import scipy.linalg  # noqa: F401  loads SciPy's BLAS, so that its threads are limited from the first call
import torch
from threadpoolctl import ThreadpoolController

T = TypeVar("T")
U = TypeVar("U")


@dataclass
class _Kernels:
    """Threads of the libraries in this process. ``entered``: how many ``one_thread_per_kernel`` blocks are open."""

    lock: threading.RLock = field(default_factory=threading.RLock)
    entered: int = 0
    restore: Callable[[], None] = lambda: None

    def limit(self) -> None:
        """Limit BLAS and OpenCV, which have one setting for the whole process."""
        blas, opencv = _find_libraries(len(sys.modules)).limit(limits=1, user_api="blas"), cv2.getNumThreads()
        cv2.setNumThreads(1)

        def restore() -> None:
            blas.restore_original_limits()
            cv2.setNumThreads(opencv)

        self.restore = restore


@lru_cache(maxsize=1)
def _find_libraries(modules: int) -> ThreadpoolController:
    """The libraries that have threads; searched again, which takes 5 ms, if ``modules`` have been imported since."""
    return ThreadpoolController()


@dataclass
class _Workers:
    """Threads that compute items. ``count`` 0: as many as torch would use."""

    count: int = 0
    pool: ThreadPoolExecutor | None = None
    pool_size: int = 0
    thread: threading.local = field(default_factory=threading.local)

    def pool_of(self, size: int) -> ThreadPoolExecutor:
        """The pool, replaced if its size changed; it is kept because oneDNN caches kernels for each thread."""
        with _kernels.lock:
            if self.pool is None or self.pool_size != size:
                if self.pool is not None:
                    self.pool.shutdown(wait=False)
                self.pool, self.pool_size = ThreadPoolExecutor(size, "dzop", self._start), size
            return self.pool

    def _start(self) -> None:
        torch.set_num_threads(1)  # each thread has a setting of its own
        self.thread.is_worker = True

    def forget(self) -> None:
        """Drop the pool, whose threads do not survive a fork."""
        self.pool = None


_kernels, _workers = _Kernels(), _Workers()
_DEFAULT_WORKERS = torch.get_num_threads()
os.register_at_fork(after_in_child=_workers.forget)


def use_threads(threads: int) -> None:
    """Set how many items ``ordered_map`` computes at the same time in this process; 0: one per core."""
    _workers.count = threads


def worker_count() -> int:
    """How many items ``ordered_map`` computes at the same time; 1 in its own threads."""
    return 1 if getattr(_workers.thread, "is_worker", False) else _workers.count or _DEFAULT_WORKERS


@contextmanager
def one_thread_per_kernel() -> Iterator[None]:
    """Within it torch, OpenCV and BLAS run every kernel on one thread; it may be nested and entered by many threads."""
    before = torch.get_num_threads()
    with _kernels.lock:
        _kernels.entered += 1
        if _kernels.entered == 1:
            _kernels.limit()
        if before != 1:
            torch.set_num_threads(1)
    try:
        yield
    finally:
        with _kernels.lock:
            _kernels.entered -= 1
            if _kernels.entered == 0:
                _kernels.restore()
                if before != 1:
                    torch.set_num_threads(before)


def ordered_map(function: Callable[[T], U], items: Sequence[T]) -> Iterator[U]:
    """Results in the order of ``items``; some are computed ahead, at the same time, each kernel on one thread.

    At most one result more than there are workers is held. Raises the first exception of ``function``.
    """
    with one_thread_per_kernel():
        count = min(worker_count(), len(items))
        if count < 2:
            yield from map(function, items)
            return
        pool, waiting = _workers.pool_of(worker_count()), deque[Future[Any]]()
        try:
            for item in items:
                waiting.append(pool.submit(function, item))
                if len(waiting) > count:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()
