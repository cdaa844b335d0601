"""What a worker process needs to hold a run's graph: made by the process that was started, used in the worker."""

from __future__ import annotations

import os
from dataclasses import fields, replace
from typing import Any

from pipeline.graph import Context, Graph
from pipeline.io.digests import track_files, tracked_digests
from pipeline.parallel import use_threads
from pipeline.spec import Runtime
from pipeline.store import Store


def worker_setup(run: Context, runtime: Runtime, threads: int) -> dict[str, Any]:
    """Arguments of ``build_graph``, which are sent to a worker. ``threads`` of the worker."""
    local = Runtime(**{f.name: getattr(runtime, f.name) for f in fields(Runtime)})
    return {
        "run": (run.stages, run.dataset, run.targets, run.store.config),
        "runtime": replace(local, progress=False),
        "threads": threads,
        "folder": os.getcwd(),
        "digests": tracked_digests(),
        "lease": run.store.lease.name if run.store.lease else "",
    }


def build_graph(
    run: tuple[Any, ...], runtime: Runtime, threads: int, folder: str, digests: dict[str, str], lease: str
) -> Graph:
    """The run's graph, checked, for as long as this process lives: a worker serves one run. Raises DzopError."""
    if os.path.isdir(folder):
        os.chdir(folder)  # paths in the configuration may be relative
    track_files(known=digests).__enter__()
    use_threads(threads)
    stages, dataset, targets, config = run
    store = Store(config)
    store.join_lease(lease)
    graph = Graph(Context(stages, dataset, targets, store, runtime))
    graph.check()
    graph.limit_vram()
    return graph
