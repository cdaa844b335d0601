"""A detection with its features -> pose by method=dzop_x, templates onboarded: time of a pose and of its stages."""

from __future__ import annotations

import tempfile
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from benchmarks.measure import Measurement
from pipeline.configuration import CONF, build_stages, build_variant
from pipeline.graph import Context, Graph
from pipeline.parallel import one_thread_per_kernel
from pipeline.progress import Progress
from pipeline.route import trace_pose
from pipeline.store import Store

DEMO = ("dataset=demo", "dataset.objects=2", "dataset.images=4", "dataset.per_image=2", "render.count=60")
LMO = ("dataset=lmo", "select.sample=20")
_EVERY = 4  # of LM-O's targets, one in four is measured, once: minutes instead of a quarter of an hour


@one_thread_per_kernel()
def default_pose(*, device: str, repeats: int, lmo: Path | None = None) -> list[Measurement]:
    """Milliseconds of one core: for a pose, for each of its stages, and for what a template costs once.

    ``lmo``: folder of LM-O, for poses in 20 of its photographs with true masks instead of the demo.
    """
    with tempfile.TemporaryDirectory() as name:
        graph = _open(Path(name), device, DEMO if lmo is None else (*LMO, f"dataset.root={lmo}"))
        views = graph.context.stages.render.count_views()
        assert views is not None  # of templates in a folder it is not known
        templates = len(graph.context.object_ids) * views
        start = time.process_time()
        graph.onboard()
        onboarded = time.process_time() - start
        encoded = graph.context.progress.step("template encodings").time_s
        seconds, stages = _time_poses(graph, *((repeats, 1) if lmo is None else (1, _EVERY)))
    unit = "ms of one core"
    return [
        Measurement("a pose of dzop_x, templates onboarded", 1e3 * float(np.median(seconds)), unit),
        *(
            Measurement(f"  of which {stage}", 1e3 * float(np.median(s)), "ms of wall time")
            for stage, s in stages.items()
        ),
        Measurement("a template onboarded, once", 1e3 * onboarded / templates, unit),
        Measurement("  of which its encoding for the first look", 1e3 * encoded / templates, "ms of wall time"),
    ]


def _open(folder: Path, device: str, data: tuple[str, ...]) -> Graph:
    places = (f"dataset.root={folder / 'data'}", f"store.root={folder / 'cache'}", f"runtime.device={device}")
    with initialize_config_dir(str(CONF), version_base="1.3"):
        values = OmegaConf.to_container(compose("config", [*places, *data]), resolve=True)
    assert isinstance(values, dict)
    dataset = build_variant(values["dataset"], "dataset").open()
    store, runtime = Store(build_variant(values["store"], "store")), build_variant(values["runtime"], "runtime")
    stages = build_stages(values)  # type: ignore[arg-type]
    graph = Graph(Context(stages, dataset, dataset.targets, store, runtime, Progress(False)))
    graph.check()
    return graph


def _time_poses(graph: Graph, repeats: int, every: int) -> tuple[list[float], dict[str, list[float]]]:
    """CPU seconds of poses, and wall seconds of every stage; a query that was seen before is read anew.

    ``every``: 1 measures all detections, n one in n.
    """
    graph.detect()
    seconds, stages = list[float](), defaultdict[str, list[float]](list)
    for image in graph.context.image_ids:
        graph.queries.make_features(image, graph.queries.make_crops(image))
    for round_ in range(repeats + 1):
        for image in graph.context.image_ids:
            for found in graph.queries.found(image)[image[1] % every :: every]:
                query, bank = graph.poses.query(found)[0], graph.templates.bank(found.detection.obj_id)
                start = time.process_time()
                trace = trace_pose(graph.context.stages, query, bank)
                if round_:  # the first warms caches
                    seconds.append(time.process_time() - start)
                    for stage, time_s in trace.times_s.items():
                        stages[stage].append(time_s)
    return seconds, stages
