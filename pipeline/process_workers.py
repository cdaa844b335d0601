"""Run tasks in processes of this machine (``runtime.workers``). Results go through the store; only counts come back."""

from __future__ import annotations

import signal
from collections.abc import Iterator, Sequence
from concurrent.futures import as_completed
from contextlib import contextmanager
from typing import Any, Literal

from joblib import cpu_count
from joblib.externals.loky.process_executor import BrokenProcessPool, ProcessPoolExecutor

from pipeline.errors import BadInput, DzopError
from pipeline.graph import Context, Counts, Graph
from pipeline.spec import Positive, Runtime, spec
from pipeline.store import MemoryStoreConfig
from pipeline.worker import build_graph, worker_setup

_IDLE_S = 24 * 3600  # a worker keeps its backbone while other steps run in the main process


@spec
class LocalRuntime(Runtime):
    """Compute in processes of this machine. ``workers``: their number; 1: this process; auto: one for each core."""

    workers: Positive | Literal["auto"] = 1

    @contextmanager
    def start_workers(self, run: Context, *, threads: int) -> Iterator[ProcessWorkers | None]:
        """Processes that start with the first item to compute and end with the block; ``threads`` each, 0 for one.

        Raises BadInput for a store that processes cannot share.
        """
        count = cpu_count() if self.workers == "auto" else self.workers
        if count > 1 and isinstance(run.store.config, MemoryStoreConfig):
            found = f"memory with runtime.workers={self.workers}"
            raise BadInput("store", found=found, needed="a store that processes share: local or s3")
        if count == 1:
            yield None
            return
        workers = ProcessWorkers(run, self, count, threads or 1)
        try:
            yield workers
        finally:
            workers.close()


class ProcessWorkers:
    """The processes of one run. Items are independent, so their bytes are those of a run in one process."""

    def __init__(self, run: Context, runtime: LocalRuntime, count: int, threads: int) -> None:
        self.run, self.runtime, self.count, self.threads = run, runtime, count, threads
        self._pool: ProcessPoolExecutor | None = None

    def map(self, task: str, items: Sequence[Any]) -> Iterator[tuple[Any, Counts]]:
        """See Workers.map. A lost process ends the run: most often memory ran out, and would again."""
        pool = self._start()
        waiting = {pool.submit(_do, task, item): item for item in items}
        try:
            for future in as_completed(waiting):
                counts, message = future.result()
                if message:
                    raise DzopError(message)
                yield waiting[future], counts
        except BrokenProcessPool:
            needed = "often memory ran out: try fewer runtime.workers; run again: completed entries are kept"
            raise DzopError(f"{task}: a worker process was lost; {needed}") from None
        finally:
            for future in waiting:
                future.cancel()

    def _start(self) -> ProcessPoolExecutor:
        """The pool, started once; BLAS and torch of its processes use one thread from the first import on."""
        if self._pool is None:
            one_thread = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
            setup = worker_setup(self.run, self.runtime, self.threads)
            self._pool = ProcessPoolExecutor(
                self.count, timeout=_IDLE_S, initializer=_initialize, initargs=(setup,), env=one_thread
            )
        return self._pool

    def close(self) -> None:
        """End the processes, whatever they are doing."""
        if self._pool is not None:
            self._pool.shutdown(wait=False, kill_workers=True)
            self._pool = None


# --- in a worker's process --------------------------------------------------------------------------------------------

_graph: Graph | None = None
_error = ""


def _initialize(setup: dict[str, Any]) -> None:
    """Build the run's graph; an error that a user can fix is kept for the first item."""
    global _graph, _error
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the main process ends this one
    try:
        _graph = build_graph(**setup)
    except DzopError as error:
        _error = str(error)


def _do(task: str, item: Any) -> tuple[Counts, str]:
    """Compute one item: its counts, and an error message that is empty on success."""
    if _graph is None:
        return {}, f"a worker could not start: {_error}"
    try:
        return _graph.run_item(task, item), ""
    except DzopError as error:
        return {}, str(error)
