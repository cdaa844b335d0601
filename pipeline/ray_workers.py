"""Work of a run on a Ray cluster: the only module that knows Ray (``pip install 'dzop[ray]'``).

Workers are actors that hold the graph of the run, backbone included, and take one unit of work after the other.
What they make goes through the store; what comes back is what was counted. Whoever dies is replaced, and its unit is
done by the next worker that is free: the store keeps what was complete of it.
"""

from __future__ import annotations

import logging
import os
import socket
import sys
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from typing import Annotated, Any

from pydantic import Field

from pipeline.errors import BadInput, DzopError
from pipeline.graph import Context, Counts, Graph, use_threads
from pipeline.spec import NonNegative, Positive, Runtime, spec
from pipeline.store import MemoryStoreConfig, Store

try:
    import ray
    from ray import exceptions as faults
except ImportError:
    ray = None  # type: ignore[assignment]

_STORE_BYTES = 100_000_000  # results travel through our store, so that Ray's own may be small
_PATIENCE_S = 30.0
_REACH_S = 10.0
_ADDRESSES = "local, auto where `ray start` has run, host:6379 or ray://host:10001"


@spec
class RayRuntime(Runtime):
    """Workers of a Ray cluster. ``address``: local, auto, host:port or ray://host:port; ``actors`` 0: as many as fit.

    ``gpus_per_actor`` None: one where the cluster has GPUs. ``retries``: how often a unit of work may lose its worker.
    """

    address: str = "local"
    actors: NonNegative = 0
    gpus_per_actor: Annotated[float, Field(ge=0, allow_inf_nan=False)] | None = None
    cpus_per_actor: Positive = 1
    retries: NonNegative = 3

    @contextmanager
    def workers(self, run: Context, *, threads: int) -> Iterator[RayWorkers]:
        """Workers that start when the first unit of work is missing, and end with the block."""
        if ray is None:
            raise BadInput("runtime", found="ray without Ray", needed="pip install 'dzop[ray]'")
        if isinstance(run.store.config, MemoryStoreConfig):
            raise BadInput("store", found="memory with runtime=ray", needed="a store that workers share: local or s3")
        workers = RayWorkers(self, run, threads)
        try:
            yield workers
        except faults.RayError as error:
            raise DzopError(f"runtime.address={self.address}: {_brief(error)}; run again: the store is kept") from None
        finally:
            workers.close()


@dataclass(eq=False)
class RayWorkers:
    """The workers of one run."""

    runtime: RayRuntime
    run: Context
    threads: int
    _idle: list[Any] = field(default_factory=list)
    _starting: dict[Any, Any] = field(default_factory=dict)
    _site: Any = None
    _most: int = 0
    _began: bool = False

    def map(self, task: str, items: Sequence[Any]) -> Iterator[tuple[Any, Counts]]:
        """As Workers.map."""
        self._start(len(items))
        waiting, lost = deque(items), Counter[Any]()
        busy: dict[Any, tuple[Any, Any]] = {}
        while waiting or busy:
            while waiting and self._idle:
                worker, item = self._idle.pop(), waiting.popleft()
                busy[worker.do.remote(task, item)] = worker, item
            for answer in self._answers(busy):
                worker, item = busy.pop(answer)
                try:
                    counts, fault = ray.get(answer)
                except faults.RayTaskError:
                    raise  # a fault of ours, with its trace
                except (faults.RayActorError, faults.WorkerCrashedError, faults.ObjectLostError) as error:
                    lost[item] += 1
                    if lost[item] > self.runtime.retries:
                        told = f"{task} of {item}: lost {lost[item]} workers, the last with: {_brief(error)}"
                        raise DzopError(f"{told}; often for want of memory: fewer runtime.actors") from None
                    self._say(f"{task} of {item}: its worker was lost; another goes on with it")
                    waiting.appendleft(item)
                    self._hire()
                else:
                    self._idle.append(worker)
                    if fault:
                        raise DzopError(fault)
                    yield item, counts

    def _answers(self, busy: dict[Any, Any]) -> list[Any]:
        """Answers that are there, once one is; workers that have started meanwhile are idle then."""
        asked = [*busy, *self._starting]
        there, _ = ray.wait(asked, num_returns=1, timeout=_PATIENCE_S)
        if not there and not busy:
            self._say(f"no worker has started for {_PATIENCE_S:.0f} s: the cluster has no room, or is busy; waiting")
        for started in [answer for answer in there if answer in self._starting]:
            worker = self._starting.pop(started)
            try:
                fault = ray.get(started)
            except faults.RayActorError as error:
                if isinstance(error.__cause__, faults.RayTaskError):
                    raise
                raise DzopError(f"a worker could not start: {_brief(error)}") from None
            if fault:
                raise DzopError(f"a worker could not start: {fault}")
            self._idle.append(worker)
        return [answer for answer in there if answer in busy]

    # --- starting and ending -----------------------------------------------------------------------------------------

    def _start(self, units: int) -> None:
        """Connect to the cluster, and as many workers as there are units and room for."""
        if not self._began:
            _connect(self.runtime.address)
            self._began = True
            self._most = self._room()
            self._site = ray.put(_site_of(self.run, self.runtime, self.threads))
        for _ in range(min(units, self._most) - len(self._idle) - len(self._starting)):
            self._hire()

    def _hire(self) -> None:
        actor: Any = ray.remote(num_cpus=self.runtime.cpus_per_actor, num_gpus=self._gpus)(Worker)
        worker = actor.remote(self._site)
        self._starting[worker.ready.remote()] = worker

    @property
    def _gpus(self) -> float:
        asked, there = self.runtime.gpus_per_actor, ray.cluster_resources().get("GPU", 0)
        if asked is None:
            return 1.0 if there and self.runtime.device != "cpu" else 0.0
        return asked

    def _room(self) -> int:
        """How many workers the cluster has room for, or are asked for. Raises BadInput where it has less."""
        there = ray.cluster_resources()
        wants = {"CPU": self.runtime.cpus_per_actor, "GPU": self._gpus}
        room = min(int(there.get(name, 0) / amount + 1e-6) for name, amount in wants.items() if amount)
        if room < max(self.runtime.actors, 1):
            has = ", ".join(f"{there.get(name, 0):g} {name}s" for name in wants)
            each = " and ".join(f"{amount:g} {name}" for name, amount in wants.items())
            found = f"{self.runtime.actors or 1} of {each} each on a cluster of {has}"
            raise BadInput("runtime.actors", found=found, needed=f"at most {room}" if room else "less for each of them")
        return self.runtime.actors or room

    def _say(self, text: str) -> None:
        print(text, file=sys.stderr, flush=True)

    def close(self) -> None:
        """End all workers; a cluster of our own ends with them, any other stays."""
        if self._began:
            self._idle.clear()
            self._starting.clear()
            ray.shutdown()


class Worker:
    """An actor: the run's graph in another process, which takes units of work."""

    def __init__(self, site: dict[str, Any]) -> None:
        self.fault, self.graph = "", None
        try:
            self.graph = _graph_of(**site)
        except DzopError as error:
            self.fault = str(error)

    def ready(self) -> str:
        """What kept it from starting, in one line; empty for nothing."""
        return self.fault

    def do(self, work: str, unit: Any) -> tuple[Counts, str]:
        """One unit of work: what was computed for it, or the line that says why not."""
        assert self.graph is not None
        try:
            return self.graph.do(work, unit), ""
        except DzopError as error:
            return {}, str(error)


def _site_of(run: Context, runtime: Runtime, threads: int) -> dict[str, Any]:
    """All that a worker builds the run's graph from."""
    plain = Runtime(**{f.name: getattr(runtime, f.name) for f in fields(Runtime)})
    return {
        "run": (run.stages, run.dataset, run.targets, run.store.config),
        "runtime": replace(plain, progress=False),
        "threads": threads or getattr(runtime, "cpus_per_actor", 1),
        "folder": os.getcwd(),
    }


def _graph_of(run: tuple[Any, ...], runtime: Runtime, threads: int, folder: str) -> Graph:
    if os.path.isdir(folder):
        os.chdir(folder)  # paths in the configuration may be relative
    use_threads(threads)
    stages, dataset, targets, store = run
    graph = Graph(Context(stages, dataset, targets, Store(store), runtime))
    graph.check()
    graph.limit_vram()
    return graph


def _connect(address: str) -> None:
    """Join a cluster, or make one of this machine: no dashboard, no usage report, its ports guarded by a token."""
    if ray.is_initialized():
        return
    _check_reachable(address)
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    chosen: dict[str, Any] = {"address": address}
    if address == "local":
        chosen |= {"include_dashboard": False, "object_store_memory": _STORE_BYTES}
    try:
        ray.init(**chosen, log_to_driver=False, logging_level=logging.ERROR)
    except Exception as error:  # Ray raises bare ones where a node does not start in time
        raise BadInput("runtime.address", found=f"{address} ({_brief(error)})", needed=_ADDRESSES) from None


def _check_reachable(address: str) -> None:
    """Raise BadInput at once where nobody listens, for which Ray takes minutes."""
    host, colon, port = address.removeprefix("ray://").rpartition(":")
    if not colon:
        return
    try:
        socket.create_connection((host, int(port)), timeout=_REACH_S).close()
    except (OSError, ValueError, OverflowError) as error:
        raise BadInput("runtime.address", found=f"{address} ({error})", needed=_ADDRESSES) from None


def _brief(error: BaseException) -> str:
    """The first line of what Ray says, which is often a page."""
    text = str(error).strip()
    return text.splitlines()[0].strip() if text else type(error).__name__
