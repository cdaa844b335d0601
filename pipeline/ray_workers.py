"""Run tasks on a Ray cluster. Only this module imports Ray (``pip install --editable '.[ray]'``).

Each worker is an actor that builds the run's graph once, backbone included, and computes one item after another.
Results go through the store; only counts come back. A worker that dies is replaced, and its item is computed again by
the next free worker, which reuses whatever the lost one had stored.
"""

from __future__ import annotations

import logging
import os
import socket
import sys
from collections import Counter, deque
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from pipeline.errors import BadInput, DzopError
from pipeline.graph import Context, Counts
from pipeline.spec import NonNegative, Positive, Runtime, spec
from pipeline.store import MemoryStoreConfig
from pipeline.worker import build_graph, worker_setup

try:
    import ray
    from ray import exceptions as ray_errors
except ImportError:
    ray = None  # type: ignore[assignment]

Actor = Any
Future = Any
"""Ray's ObjectRef: the result of a remote call, which may still be running."""

_OBJECT_STORE_BYTES = 100_000_000  # results go through the feature store, so Ray's own can be small
_START_NOTICE_S = 30.0
_CONNECT_TIMEOUT_S = 10.0
_ADDRESSES = "local, auto (after `ray start`), host:6379 or ray://host:10001"


@spec
class RayRuntime(Runtime):
    """Compute on workers of a Ray cluster.

    ``address``: local, auto, host:port or ray://host:port. ``actors``: number of workers, 0 = as many as fit.
    ``gpus_per_actor``: None = one if the cluster has GPUs. ``retries``: how many workers an item may lose.
    """

    address: str = "local"
    actors: NonNegative = 0
    gpus_per_actor: Annotated[float, Field(ge=0, allow_inf_nan=False)] | None = None
    cpus_per_actor: Positive = 1
    retries: NonNegative = 3

    @contextmanager
    def start_workers(self, run: Context, *, threads: int) -> Iterator[RayWorkers]:
        """Workers that start with the first item to compute and end with the block.

        Raises BadInput without Ray or with a store that workers cannot share, DzopError when the cluster fails.
        """
        if ray is None:
            raise BadInput("runtime", found="ray, which is not installed", needed="pip install --editable '.[ray]'")
        if isinstance(run.store.config, MemoryStoreConfig):
            raise BadInput("store", found="memory with runtime=ray", needed="a store that workers share: local or s3")
        workers = RayWorkers(self, run, threads)
        try:
            yield workers
        except ray_errors.RayError as error:
            where = f"runtime.address={self.address}"
            raise DzopError(f"{where}: {_first_line(error)}; run again: completed entries are kept") from None
        finally:
            workers.close()


class RayWorkers:
    """The workers of one run."""

    def __init__(self, runtime: RayRuntime, run: Context, threads: int) -> None:
        self.runtime, self.run, self.threads = runtime, run, threads
        self._connected = False
        self._max_workers = 0
        self._setup: Future = None
        self._starting: dict[Future, Actor] = {}
        self._idle: list[Actor] = []

    def map(self, task: str, items: Sequence[Any]) -> Iterator[tuple[Any, Counts]]:
        """See Workers.map."""
        self._start(len(items))
        waiting, losses = deque(items), Counter[Any]()
        busy: dict[Future, tuple[Actor, Any]] = {}
        while waiting or busy:
            while waiting and self._idle:
                worker, item = self._idle.pop(), waiting.popleft()
                busy[worker.do.remote(task, item)] = worker, item
            for future in self._wait(busy):
                worker, item = busy.pop(future)
                result = _get_result(future)
                if isinstance(result, Exception):
                    losses[item] += 1
                    self._report_loss(f"{task} of {item}", losses[item], result)
                    waiting.appendleft(item)
                    self._start_worker()
                    continue
                self._idle.append(worker)
                yield item, result

    def _wait(self, busy: Collection[Future]) -> list[Future]:
        """Wait until an item is finished or a worker has started; returns the futures of finished items."""
        ready, _ = ray.wait([*busy, *self._starting], num_returns=1, timeout=_START_NOTICE_S)
        if not ready and not busy:
            _report(f"no worker has started for {_START_NOTICE_S:.0f} s: the cluster is full or busy; still waiting")
        for future in ready:
            if future in self._starting:
                _check_started(future)
                self._idle.append(self._starting.pop(future))
        return [future for future in ready if future in busy]

    def _report_loss(self, item: str, losses: int, error: Exception) -> None:
        """Print that an item lost its worker. Raises DzopError when it has lost too many."""
        if losses > self.runtime.retries:
            found = f"{item}: lost {losses} workers, the last with: {_first_line(error)}"
            raise DzopError(f"{found}; often out of memory: try fewer runtime.actors") from None
        _report(f"{item}: its worker was lost; retrying on another")

    # --- starting and ending -----------------------------------------------------------------------------------------

    def _start(self, items: int) -> None:
        """Connect to the cluster once, then start workers: at most one per item, and no more than fit."""
        if not self._connected:
            _connect(self.runtime.address)
            self._connected = True
            self._max_workers = self._fit_workers()
            self._setup = ray.put(worker_setup(self.run, self.runtime, self.threads or self.runtime.cpus_per_actor))
        for _ in range(min(items, self._max_workers) - len(self._idle) - len(self._starting)):
            self._start_worker()

    def _start_worker(self) -> None:
        actor: Any = ray.remote(num_cpus=self.runtime.cpus_per_actor, num_gpus=self._gpus_per_worker())(Worker)
        worker = actor.remote(self._setup)
        self._starting[worker.startup_error.remote()] = worker

    def _gpus_per_worker(self) -> float:
        if self.runtime.gpus_per_actor is not None:
            return self.runtime.gpus_per_actor
        return 1.0 if ray.cluster_resources().get("GPU", 0) and self.runtime.device != "cpu" else 0.0

    def _fit_workers(self) -> int:
        """The configured number of workers, or as many as fit. Raises BadInput when the cluster is too small."""
        resources = ray.cluster_resources()
        needs = {"CPU": self.runtime.cpus_per_actor, "GPU": self._gpus_per_worker()}
        fitting = min(int(resources.get(name, 0) / amount + 1e-6) for name, amount in needs.items() if amount)
        if fitting < max(self.runtime.actors, 1):
            available = ", ".join(f"{resources.get(name, 0):g} {name}s" for name in needs)
            each = " and ".join(f"{amount:g} {name}" for name, amount in needs.items())
            found = f"{self.runtime.actors or 1} of {each} each on a cluster of {available}"
            needed = f"at most {fitting}" if fitting else "smaller cpus_per_actor or gpus_per_actor"
            raise BadInput("runtime.actors", found=found, needed=needed)
        return self.runtime.actors or fitting

    def close(self) -> None:
        """Stop all workers and disconnect; a cluster that this process started ends too."""
        if self._connected:
            self._idle.clear()
            self._starting.clear()
            ray.shutdown()


def _get_result(future: Future) -> Counts | Exception:
    """Counts of a finished item; Ray's error if its worker was lost. Raises DzopError with the worker's message."""
    try:
        counts, message = ray.get(future)
    except ray_errors.RayTaskError:
        raise  # a bug: keep the worker's traceback
    except (ray_errors.RayActorError, ray_errors.WorkerCrashedError, ray_errors.ObjectLostError) as error:
        return error
    if message:
        raise DzopError(message)
    return counts


def _check_started(future: Future) -> None:
    """Raise DzopError if a worker could not start."""
    try:
        message: Any = ray.get(future)
    except ray_errors.RayActorError as error:
        if isinstance(error.__cause__, ray_errors.RayTaskError):
            raise  # a bug: keep the worker's traceback
        message = _first_line(error)
    if message:
        raise DzopError(f"a worker could not start: {message}")


def _report(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


# --- in a worker's process --------------------------------------------------------------------------------------------


class Worker:
    """An actor that holds the run's graph in its own process.

    Errors that a user can fix are returned as one-line messages, because Ray would wrap exceptions in its own.
    """

    def __init__(self, setup: dict[str, Any]) -> None:
        self.error, self.graph = "", None
        try:
            self.graph = build_graph(**setup)
        except DzopError as error:
            self.error = str(error)

    def startup_error(self) -> str:
        """Message of the error that prevented the start; empty if there was none."""
        return self.error

    def do(self, task: str, item: Any) -> tuple[Counts, str]:
        """Compute one item: its counts, and an error message that is empty on success."""
        assert self.graph is not None
        try:
            return self.graph.run_item(task, item), ""
        except DzopError as error:
            return {}, str(error)


# --- connecting -------------------------------------------------------------------------------------------------------


def _connect(address: str) -> None:
    """Join a cluster, or start a local one without dashboard and usage reports. Raises BadInput if that fails."""
    if ray.is_initialized():
        return
    _check_reachable(address)
    protect_auth_token()
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    options: dict[str, Any] = {"address": address}
    if address == "local":
        options |= {"include_dashboard": False, "object_store_memory": _OBJECT_STORE_BYTES}
    try:
        ray.init(**options, log_to_driver=False, logging_level=logging.ERROR)
    except Exception as error:  # Ray raises a plain Exception when a node does not start in time
        raise BadInput("runtime.address", found=f"{address} ({_first_line(error)})", needed=_ADDRESSES) from None


def protect_auth_token() -> None:
    """Make Ray's token file readable by its owner only: whoever has it can run code on the cluster."""
    path = Path(os.environ.get("RAY_AUTH_TOKEN_PATH") or Path.home() / ".ray" / "auth_token")
    try:
        if path.is_file() and path.stat().st_mode & 0o077:
            path.chmod(0o600)
    except OSError as error:
        found = f"a token that others may read ({error.strerror})"
        raise BadInput(path, found=found, needed="a file that only its owner may read: chmod 600") from None


def _check_reachable(address: str) -> None:
    """Raise BadInput if nothing listens at the address; Ray itself would take minutes to fail."""
    host, colon, port = address.removeprefix("ray://").rpartition(":")
    if not colon:
        return
    try:
        socket.create_connection((host, int(port)), timeout=_CONNECT_TIMEOUT_S).close()
    except (OSError, ValueError, OverflowError) as error:
        raise BadInput("runtime.address", found=f"{address} ({error})", needed=_ADDRESSES) from None


def _first_line(error: BaseException) -> str:
    """First line of an error message; Ray's often fill a page."""
    text = str(error).strip()
    return text.splitlines()[0].strip() if text else type(error).__name__
