"""fused pair -> k-means clusters of query and template, matched by the cosine of their centres."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pipeline.functional.camera import grid_xy
from pipeline.functional.epipolar import PlanarMode, epipolar_inliers
from pipeline.functional.kmeans import kmeans
from pipeline.functional.masks import foreground
from pipeline.functional.similarity import l2_normalize, mutual_nearest
from pipeline.items.features import ClusteredMap, Clusters
from pipeline.spec import NonNegative, Positive, PositiveFloat, spec
from pipeline.stages.cluster import Clusterer


@spec
class KMeans(Clusterer):
    """Matched clusters (von Gimborn et al., "Cluster-wise correspondence estimation").

    The foreground cells of each image, scaled to unit length so that distance means cosine, are grouped into ``count``
    clusters; clusters whose centres are mutual nearest neighbours form a pair. ``epipolar`` drops pairs whose mean
    positions (in cells) lie more than ``threshold_cells`` off the epipolar lines of one fundamental matrix. ``planar``
    says what happens where a near-planar set does not determine that matrix: the check is skipped, or runs with the
    matrix that was found (the paper has no such test), or with a homography. ``note`` says why a check was skipped:
    for a near-planar set, or for fewer than 8 pairs.
    """

    kind: ClassVar[str] = "cluster.kmeans"
    version: ClassVar[int] = 1
    added: ClassVar[Mapping[str, Any]] = {"planar": "skip"}

    count: Positive = 200
    iterations: Positive = 20
    seed: NonNegative = 0
    epipolar: bool = True
    threshold_cells: PositiveFloat = 2.0
    epipolar_iterations: Positive = 1000
    planar: PlanarMode = "skip"

    def encode(self, features: Float[Tensor, "d h w"], mask: Bool[Tensor, "h w"]) -> ClusteredMap:
        """k-means clusters of the foreground cells, fewer than ``count`` where there are fewer distinct cells."""
        cells = foreground(mask)
        points = l2_normalize(features.float().flatten(1).T[cells])
        of_cell, centre = kmeans(points, count=self.count, seed=self.seed, iterations=self.iterations)
        label = torch.full_like(mask, -1, dtype=torch.int64)
        label.view(-1)[cells] = of_cell
        return ClusteredMap(label, centre)

    def pair(self, query: ClusteredMap, template: ClusteredMap) -> Clusters:
        """Labels of both, the clusters that correspond, and what was clamped or skipped."""
        pairs = mutual_nearest(l2_normalize(query.centre) @ l2_normalize(template.centre).T)
        notes = [
            f"{name}: {len(clustered.centre)} of {self.count} clusters"
            for name, clustered in (("query", query), ("template", template))
            if len(clustered.centre) < self.count
        ]
        if self.epipolar:
            positions = [_mean_xy(query.label)[pairs[:, 0].cpu()], _mean_xy(template.label)[pairs[:, 1].cpu()]]
            keep, skipped = self._check_epipolar(*(p.numpy() for p in positions))
            pairs = pairs if keep is None else pairs[torch.from_numpy(keep).to(pairs.device)]
            notes += [f"epipolar check skipped: {skipped}"] if skipped else []
        return Clusters(query.label, template.label, pairs, note="; ".join(notes))

    def _check_epipolar(
        self, query_xy: Float[np.ndarray, "p 2"], template_xy: Float[np.ndarray, "p 2"]
    ) -> tuple[Bool[np.ndarray, " p"] | None, str]:
        return epipolar_inliers(
            query_xy, template_xy, threshold=self.threshold_cells, iterations=self.epipolar_iterations, seed=self.seed,
            planar=self.planar,
        )  # fmt: skip


def _mean_xy(label: Int[Tensor, "h w"]) -> Float[Tensor, "k 2"]:
    """Mean position (x, y) of each cluster's cells, in cells."""
    flat = label.flatten().cpu()
    cells = (flat >= 0).nonzero()[:, 0]
    of_cell, xy = flat[cells], grid_xy(cells, width=label.shape[1]).double()
    total = torch.zeros(int(of_cell.max()) + 1, 2, dtype=torch.float64).index_add_(0, of_cell, xy)
    return total / torch.bincount(of_cell)[:, None]
