"""fused pair, clusters -> corresponding points, in crop pixels: matches whose cycle ends near its start."""

from __future__ import annotations

from typing import ClassVar, Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.errors import NoPose
from pipeline.functional.camera import grid_xy
from pipeline.functional.similarity import l2_normalize, nearest_with_same_label
from pipeline.items.features import Clusters, FusedPair
from pipeline.items.matches import Correspondences, TrueMatches
from pipeline.spec import Positive, spec
from pipeline.stages.correspond import Corresponder, cell_px, cells_in_pairs


@spec
class Cyclic(Corresponder):
    """Cyclic buddies (Goodwin et al., "Zero-Shot Category-Level Object Pose Estimation", ECCV 2022, section 3.2).

    A cycle goes from a query cell to its nearest template cell, and from there to the nearest query cell. Its cyclic
    distance is that between the first and the last cell: 0 for mutual nearest neighbours. The ``count`` query cells of
    smallest cyclic distance are kept, ties by similarity. Neighbours are searched in the paired cluster only; FoundPose
    uses cluster=one (Örnek et al., ECCV 2024, section
    3.4). ``metric``: Euclidean distance of features (FoundPose's code) or cosine. Points are the cells' centres.
    """

    kind: ClassVar[str] = "correspond.cyclic"
    version: ClassVar[int] = 1

    count: Positive = 300
    metric: Literal["euclidean", "cosine"] = "euclidean"

    def __call__(
        self, pair: FusedPair, clusters: Clusters, *, crop_size: int, truth: TrueMatches | None = None
    ) -> Correspondences:
        """Matched points, by cluster pair, smallest cyclic distance first. Raises NoPose when there is none."""
        query_cell, query_pair = cells_in_pairs(clusters.query_label, clusters.pairs[:, 0])
        template_cell, template_pair = cells_in_pairs(clusters.template_label, clusters.pairs[:, 1])
        if len(query_cell) == 0 or len(template_cell) == 0:
            raise NoPose("correspond", f"{len(clusters.pairs)} cluster pairs, none with cells on both sides")
        query, template = (
            features.float().flatten(1).T[cell]
            for features, cell in ((pair.query, query_cell), (pair.template, template_cell))
        )
        forth = self._nearest(query, query_pair, template, template_pair)
        back = self._nearest(template, template_pair, query, query_pair)
        xy = grid_xy(query_cell, width=pair.query.shape[-1]).float()
        off_cells = torch.linalg.vector_norm(xy - xy[back[forth]], dim=1)
        similarity = (l2_normalize(query) * l2_normalize(template[forth])).sum(1)
        kept = self._best(off_cells, similarity, query_pair, candidate=torch.isin(query_pair, template_pair))
        if len(kept) == 0:
            raise NoPose("correspond", f"{len(clusters.pairs)} cluster pairs, none with cells on both sides")
        return Correspondences(
            cell_px(query_cell[kept], like=pair.query, crop_size=crop_size),
            cell_px(template_cell[forth[kept]], like=pair.template, crop_size=crop_size),
            similarity[kept],
            query_pair[kept],
        )

    def _nearest(
        self, a: Float[Tensor, "m c"], a_label: Int[Tensor, " m"], b: Float[Tensor, "n c"], b_label: Int[Tensor, " n"]
    ) -> Int[Tensor, " m"]:
        """Index of the row of b nearest to each row of a among those of its label; 0 where there is none."""
        if self.metric == "cosine":
            return nearest_with_same_label(l2_normalize(a), a_label, l2_normalize(b), b_label)[1]
        # |a - b|^2 = |a|^2 - 2 (a.b - |b|^2 / 2); one more channel: largest product = least distance
        a_one = torch.cat([a, torch.ones_like(a[:, :1])], dim=1)
        b_half = torch.cat([b, -(b * b).sum(1, keepdim=True) / 2], dim=1)
        return nearest_with_same_label(a_one, a_label, b_half, b_label)[1]

    def _best(
        self,
        off_cells: Float[Tensor, " m"],
        similarity: Float[Tensor, " m"],
        group: Int[Tensor, " m"],
        *,
        candidate: Tensor,
    ) -> Int[Tensor, " k"]:
        """Indices of the ``count`` best candidates, then by group; ties of both numbers by index."""
        index = candidate.nonzero()[:, 0]
        index = index[torch.sort(similarity[index], descending=True, stable=True).indices]
        index = index[torch.sort(off_cells[index], stable=True).indices][: self.count]
        return index[torch.sort(group[index], stable=True).indices]
