"""Query features, templates -> pose: time of each step and of the online path, compared with the plain reference."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from benchmarks import reference
from benchmarks.inputs import SD15, TEMPLATES, Scene, scene
from benchmarks.measure import Measurement, Times, time_interleaved
from benchmarks.presets import PAPER
from pipeline.functional.kmeans import kmeans
from pipeline.functional.masks import cell_mask, foreground
from pipeline.functional.similarity import l2_normalize
from pipeline.route import trace_pose
from pipeline.stages.cluster.kmeans import KMeans
from pipeline.stages.fuse.pca import Pca

FUSE, KMEANS = Pca(), KMeans()  # those of PAPER, with their types
TARGETS_MS = {"retrieval": 5.0, "online path": 150.0}
TARGET_SPEEDUP = {"online path": 10.0}

Step = Callable[[], object]
Pair = tuple[Step, Step]
"""The pipeline's version of a step and the reference's, on the same inputs."""


def online(*, device: str, repeats: int) -> list[Measurement]:
    """Milliseconds per step for one detection (CPU time; wall time on CUDA), and the speed-up over the reference."""
    made = scene(SD15, device=device)
    pairs = steps(made)
    candidates = {(name, k): step for name, pair in pairs.items() for k, step in enumerate(pair)}
    times = time_interleaved(candidates, repeats=repeats)
    unit = "ms wall" if device.startswith("cuda") else "ms of one core"
    measurements = []
    for name in pairs:
        ours, plain = (_seconds(times[name, k], device) for k in range(2))
        what = f"{name}, SD 1.5's channels" + (f", {TEMPLATES} templates" if name == "retrieval" else "")
        measurements += [
            Measurement(what, 1e3 * ours, unit, "", TARGETS_MS.get(name)),
            Measurement(
                f"{name}, times faster", plain / ours, "x", "the plain reference", TARGET_SPEEDUP.get(name), "more"
            ),
        ]
    return measurements


def _seconds(times: Times, device: str) -> float:
    return times.wall_s if device.startswith("cuda") else times.cpu_s


def steps(made: Scene) -> dict[str, Pair]:
    """All steps of the online path, and the path as a whole, by name."""
    plain = Plain(made)
    return _template_steps(made, plain) | _pair_steps(made) | {"online path": (_online_path(made), plain.pose)}


def _online_path(made: Scene) -> Step:
    return lambda: trace_pose(PAPER, made.query, made.bank)


def _template_steps(made: Scene, plain: Plain) -> dict[str, Pair]:
    """Retrieval of a template and fusion with it."""
    query, bank, template = made.query, made.bank, made.bank.view(0)
    return {
        "retrieval": (
            lambda: PAPER.match(query, bank),
            lambda: reference.retrieve(plain.query[2], plain.bank),
        ),
        "co-PCA": (
            lambda: PAPER.fuse(query.crop, template.crop),
            lambda: reference.co_project(
                plain.query, plain.view(0)[0], plain.query_mask, plain.view(0)[1], dims=plain.dims
            ),
        ),
    }


def _pair_steps(made: Scene) -> dict[str, Pair]:
    """The steps after fusion, on query and best template."""
    template = made.bank.view(0)
    pair = PAPER.fuse(made.query.crop, template.crop)
    clusters = PAPER.cluster(pair)
    crop_size = PAPER.crop.size
    assert len(PAPER.correspond(pair, clusters, crop_size=crop_size).similarity)
    cells = l2_normalize(pair.query.float().flatten(1).T[foreground(pair.query_mask)]).contiguous()
    points, px = _solver_inputs(made)
    labels = clusters.query_label.cpu().numpy(), clusters.template_label.cpu().numpy(), clusters.pairs.cpu().numpy()
    maps = pair.query.cpu().numpy(), pair.template.cpu().numpy()
    query_mask, template_mask = pair.query_mask.cpu().numpy(), cell_mask(template.crop.mask, cells=64).cpu().numpy()
    cells_np = cells.cpu().numpy()
    kmeans_options = {"count": KMEANS.count, "seed": KMEANS.seed, "iterations": KMEANS.iterations}
    return {
        "k-means of one crop": (
            lambda: kmeans(cells, **kmeans_options),
            lambda: reference.k_means(cells_np, **kmeans_options),
        ),
        "clusters": (
            lambda: PAPER.cluster(pair),
            lambda: reference.cluster(*maps, query_mask, template_mask),
        ),
        "correspondences": (
            lambda: PAPER.correspond(pair, clusters, crop_size=crop_size),
            lambda: reference.correspond(*maps, template_mask, *labels, crop_size=crop_size),
        ),
        "PnP": (
            lambda: PAPER.solve(points, px, made.query.K),
            lambda: reference.solve(points, px, made.query.K),
        ),
    }


def _solver_inputs(made: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Object points (mm) and image pixels of the best hypothesis."""
    best = trace_pose(PAPER, made.query, made.bank).best
    assert best.points_obj is not None
    assert best.query_px_img is not None
    known = np.isfinite(best.points_obj).all(axis=1)
    return best.points_obj[known], best.query_px_img[known]


class Plain:
    """A scene as the reference reads it: numpy arrays, float32."""

    def __init__(self, made: Scene) -> None:
        self.made, query = made, made.query
        self.query = {layer: m.float().cpu().numpy() for layer, m in query.crop.maps.items()}
        self.query_mask = query.crop.mask.cpu().numpy()
        self.bank = made.bank.features.float().cpu().numpy()
        self.dims = dict(zip(FUSE.layers, FUSE.dims(), strict=True))

    def view(self, index: int) -> reference.View:
        """A template's features, mask, A_crop_img, depth (mm), K and T_cam_obj."""
        t = self.made.bank.view(index)
        features = {layer: m.float().cpu().numpy() for layer, m in t.crop.maps.items()}
        return features, t.crop.mask.cpu().numpy(), t.A_crop_img, t.depth_mm, t.K, t.T_cam_obj

    def pose(self, reading: reference.Reading = reference.DZOP) -> tuple[int, np.ndarray]:
        """The reference's template and pose."""
        q, masked = self.made.query, (self.query, self.query_mask)
        return reference.pose(*masked, q.A_crop_img, q.K, self.bank, self.view, dims=self.dims, reading=reading)
