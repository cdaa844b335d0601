"""Query features, templates -> pose: each step and the whole, against the plain reference."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from benchmarks import reference
from benchmarks.inputs import SD15, TEMPLATES, Scene, scene
from benchmarks.measure import Figure, Times, interleaved
from benchmarks.presets import PAPER
from pipeline.functional.kmeans import kmeans
from pipeline.functional.masks import cell_mask, foreground
from pipeline.functional.similarity import l2_normalize
from pipeline.route import trace_pose
from pipeline.stages.cluster.kmeans import KMeans
from pipeline.stages.fuse.pca import Pca

FUSE, KMEANS = Pca(), KMeans()  # those of PAPER, with their types


def online(*, device: str, repeats: int) -> list[Figure]:
    """CPU milliseconds (wall on CUDA) of a detection's steps, and the reference's time over ours."""
    made = scene(SD15, device=device)
    contestants = {name: step for pair in steps(made).values() for name, step in pair.items()}
    took = interleaved(contestants, repeats=repeats)
    figures = []
    for name, (ours, plain) in ((name, tuple(pair)) for name, pair in steps(made).items()):
        target = {"retrieval": 5.0, "whole online path": 150.0}.get(name)
        unit_ = "ms wall" if device.startswith("cuda") else "ms of one core"
        what = f"{name}, SD 1.5's channels" + (f", {TEMPLATES} templates" if name == "retrieval" else "")
        figures.append(Figure(what, 1e3 * _seconds(took[ours], device), unit_, "", target))
        ratio = _seconds(took[plain], device) / _seconds(took[ours], device)
        least = 10.0 if name == "whole online path" else None
        figures.append(Figure(f"{name}, times faster", ratio, "x", "the plain reference", least, "more"))
    return figures


def _seconds(times: Times, device: str) -> float:
    return times.wall_s if device.startswith("cuda") else times.cpu_s


def steps(made: Scene) -> dict[str, dict[str, Callable[[], object]]]:
    """Step -> ours and the reference's, on the same inputs."""
    query, bank = made.query, made.bank
    template = bank.view(0)
    pair = PAPER.fuse(query.crop, template.crop)
    clusters = PAPER.cluster(pair)
    matches = PAPER.correspond(pair, clusters, crop_size=PAPER.crop.size)
    cells = l2_normalize(pair.query.float().flatten(1).T[foreground(pair.query_mask)]).contiguous()
    points, px = _points(made)
    plain = Plain(made)
    labels = clusters.query_label.cpu().numpy(), clusters.template_label.cpu().numpy(), clusters.pairs.cpu().numpy()
    maps = pair.query.cpu().numpy(), pair.template.cpu().numpy()
    masks = cell_mask(template.crop.mask, cells=64).cpu().numpy()
    points_np = cells.cpu().numpy()
    assert len(matches.similarity)
    return {
        "retrieval": {
            "match": lambda: PAPER.match(query, bank),
            "plain match": lambda: reference.retrieve(plain.query[2], plain.bank),
        },
        "co-PCA": {
            "fuse": lambda: PAPER.fuse(query.crop, template.crop),
            "plain fuse": lambda: reference.co_project(
                plain.query, plain.view(0)[0], plain.query_mask, plain.view(0)[1], dims=plain.dims
            ),
        },
        "k-means of one side": {
            "k-means": lambda: kmeans(cells, count=KMEANS.count, seed=KMEANS.seed, iterations=KMEANS.iterations),
            "plain k-means": lambda: reference.k_means(
                points_np, count=KMEANS.count, seed=KMEANS.seed, iterations=KMEANS.iterations
            ),
        },
        "clusters": {
            "cluster": lambda: PAPER.cluster(pair),
            "plain cluster": lambda: reference.cluster(*maps, pair.query_mask.cpu().numpy(), masks),
        },
        "correspondences": {
            "correspond": lambda: PAPER.correspond(pair, clusters, crop_size=PAPER.crop.size),
            "plain correspond": lambda: reference.correspond(*maps, masks, *labels, crop_size=PAPER.crop.size),
        },
        "PnP": {
            "solve": lambda: PAPER.solve(points, px, query.K),
            "plain solve": lambda: reference.solve(points, px, query.K),
        },
        "whole online path": {
            "route": lambda: trace_pose(PAPER, query, bank),
            "plain route": plain.pose,
        },
    }


def _points(made: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Correspondences as the solver gets them."""
    best = trace_pose(PAPER, made.query, made.bank).best
    assert best.points_obj is not None
    assert best.query_px_img is not None
    seen = np.isfinite(best.points_obj).all(axis=1)
    return best.points_obj[seen], best.query_px_img[seen]


class Plain:
    """A scene as the reference reads it: numpy arrays, float32."""

    def __init__(self, made: Scene) -> None:
        self.made, query = made, made.query
        self.query = {layer: m.float().cpu().numpy() for layer, m in query.crop.maps.items()}
        self.query_mask = query.crop.mask.cpu().numpy()
        self.bank = made.bank.features.float().cpu().numpy()
        self.dims = dict(zip(FUSE.layers, FUSE.dims(), strict=True))

    def view(self, index: int) -> reference.View:
        """A template, unpacked."""
        t = self.made.bank.view(index)
        features = {layer: m.float().cpu().numpy() for layer, m in t.crop.maps.items()}
        return features, t.crop.mask.cpu().numpy(), t.A_crop_img, t.depth_mm, t.K, t.T_cam_obj

    def pose(self) -> tuple[int, np.ndarray]:
        """The reference's template and pose."""
        q = self.made.query
        return reference.pose(self.query, self.query_mask, q.A_crop_img, q.K, self.bank, self.view, dims=self.dims)
