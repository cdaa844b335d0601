"""Accuracy on large photographs with other values of solve.plane.LARGEST_CROP_PX, as a table in Markdown.

The constant is the size of the largest crop whose solver threshold counts pixels of the photograph. Procedural scenes
of a seed that no test uses are rendered with multiples of 640 x 480 pixels. Every value solves the same
correspondences, with 150 templates and the five most similar of them; the rerender is off.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

import pipeline.stages.solve.plane
from pipeline.bop.results import ResultRow
from pipeline.configuration import CONF, build_options, build_stages, build_variant
from pipeline.errors import NoPose
from pipeline.graph import Context, Graph
from pipeline.items.online import Hypothesis, Query
from pipeline.items.scores import Scores
from pipeline.items.views import Detection
from pipeline.metrics.bootstrap import image_index, mean_interval
from pipeline.metrics.recall import instance_recalls
from pipeline.parallel import use_threads
from pipeline.route import Route
from pipeline.scoring import Scorer
from pipeline.store import Store
from pipeline.synthetic.scenes import write_dataset

SEED, OBJECTS, IMAGES, PER_IMAGE = 4711, 6, 12, 5
VALUES = (96.0, 160.0, 240.0, 320.0, math.inf)
USUAL = pipeline.stages.solve.plane.LARGEST_CROP_PX


def benchmark(folder: Path, factors: Sequence[int], extractors: Sequence[str], values: Sequence[float]) -> str:
    """Solve with every value on every size; returns the table."""
    names = ["none" if math.isinf(value) else f"{value:g}" for value in values]
    lines = [f"| Photographs | Crops, px | Features | {' | '.join(names)} |", "|---" * (3 + len(values)) + "|"]
    for factor in factors:
        size_hw = (480 * factor, 640 * factor)
        root = folder / "data" / f"x{factor}"
        if not root.exists():
            write_dataset(root, objects=OBJECTS, images=IMAGES, per_image=PER_IMAGE, seed=SEED, size_hw=size_hw)
        for extract in extractors:
            sides, recalls = _measure(_graph(folder, root, extract), values)
            low, high = np.quantile(sides, [0.1, 0.9])
            cells = " | ".join(_cells(recalls, values))
            lines.append(f"| {size_hw[1]} x {size_hw[0]} | {low:.0f} to {high:.0f} | {extract} | {cells} |")
            print(lines[-1], flush=True)
    return "\n".join(lines)


def _graph(folder: Path, root: Path, extract: str) -> Graph:
    """The default method on one size, with templates and query features in the store."""
    overrides = ["dataset=bop", "dataset.name=large", f"dataset.root={root}", f"extract={extract}", "second_look=none"]
    overrides += ["match.top_k=5", "render.count=150", f"store.root={folder / 'cache'}"]
    overrides += ["threads=1", "runtime.progress=false"]
    with initialize_config_dir(str(CONF), version_base="1.3"):
        values: Any = OmegaConf.to_container(compose("config", overrides), resolve=True)
    options, data = build_options(values), build_variant(values["dataset"], "dataset").open()
    use_threads(options.threads)
    store, runtime = Store(build_variant(values["store"], "store")), build_variant(values["runtime"], "runtime")
    graph = Graph(Context(build_stages(values), data, options.select.targets(data), store, runtime))
    graph.check()
    graph.onboard()
    graph.context.run_task(graph.queries.describe_task, graph.context.image_ids, lambda n: None)
    return graph


def _measure(graph: Graph, values: Sequence[float]) -> tuple[list[float], dict[float, Scores]]:
    """Sides of all crops, photograph pixels, and the scores with each value."""
    rows: dict[float, list[ResultRow]] = {value: [] for value in values}
    sides = []
    for detection, query, hypotheses, route in _traces(graph):
        sides.append(graph.context.stages.crop.size / float(query.A_crop_img[0, 0]))
        for value in values:
            pipeline.stages.solve.plane.LARGEST_CROP_PX = value  # type: ignore[assignment]
            best = route.refine(route.sort([_solve_again(route, h) for h in hypotheses])[0])
            if best.solution is not None:
                ids = detection.scene_id, detection.im_id, detection.obj_id
                rows[value].append(ResultRow(*ids, 1.0, best.solution.T_cam_obj, -1.0))
    pipeline.stages.solve.plane.LARGEST_CROP_PX = USUAL
    scorer = Scorer(graph.context.dataset, graph.context.targets, "models_eval", with_vsd=False)
    return sides, {value: scorer.score(rows[value]).scores for value in values}


def _traces(graph: Graph) -> Iterator[tuple[Detection, Query, list[Hypothesis], Route]]:
    """Each detection with its hypotheses before they are sorted, object by object."""
    stages = graph.context.stages
    for obj_id in graph.context.object_ids:
        bank = graph.templates.bank(obj_id)
        for image in graph.context.image_ids:
            for found in graph.queries.found(image):
                if found.detection.obj_id == obj_id:
                    query, _ = graph.poses.query(found)
                    route = Route(stages, query, bank)
                    match = stages.match(query, bank)
                    chosen = zip(match.index.tolist(), match.score.tolist(), strict=True)
                    yield found.detection, query, [route.solve(Hypothesis(i, score)) for i, score in chosen], route


def _solve_again(route: Route, hypothesis: Hypothesis) -> Hypothesis:
    """The hypothesis with its pose solved under the constant that is set now."""
    if hypothesis.points_obj is None or hypothesis.query_px_img is None:
        return hypothesis
    try:
        return replace(hypothesis, solution=route.solve_pose(hypothesis.points_obj, hypothesis.query_px_img))
    except NoPose as failure:
        return replace(hypothesis, solution=None, failure=failure)


def _cells(scores: dict[float, Scores], values: Sequence[float]) -> Iterator[str]:
    """Mean of AR_MSSD and AR_MSPD, and the paired difference to the usual value with its interval over images."""
    recall = {value: instance_recalls(scores[value])[:, 1:].mean(axis=1) for value in values}
    for value in values:
        if value == USUAL or USUAL not in recall:
            yield f"{recall[value].mean():.3f}"
            continue
        images = image_index(scores[value].scene_id, scores[value].im_id)
        lead = mean_interval(recall[value] - recall[USUAL], images)
        yield f"{recall[value].mean():.3f} ({lead.mean:+.3f} [{lead.low:+.3f}, {lead.high:+.3f}])"


def main() -> None:
    """Parse the options, run the benchmark, print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.solver_plane", description=__doc__)
    add, default = parser.add_argument, "(default: %(default)s)"
    add("--folder", type=Path, default=Path("cache/solver_plane"), help=f"for data and cache {default}")
    add("--factors", type=int, nargs="+", default=[2, 4], help=f"sizes of the photographs {default}")
    add("--extractors", nargs="+", default=["hog", "embedded"], help=f"features {default}")
    add("--values", type=float, nargs="+", default=VALUES, help=f"largest crops, pixels; inf: no rule {default}")
    options = parser.parse_args()
    print("\n" + benchmark(options.folder.resolve(), options.factors, options.extractors, options.values))


if __name__ == "__main__":
    main()
