"""fused pair, clusters -> corresponding points, in crop pixels: the most salient of the mutual neighbours."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.errors import NoPose
from pipeline.functional.kmeans import kmeans
from pipeline.functional.similarity import l2_normalize, nearest_with_same_label
from pipeline.items.features import Clusters, FusedPair
from pipeline.items.matches import Correspondences, TrueMatches
from pipeline.spec import Fraction, NonNegative, Positive, spec
from pipeline.stages.correspond import Corresponder, cell_px, cells_in_pairs


@spec
class Salient(Corresponder):
    """Mutual nearest neighbours in paired clusters, grouped by k-means; the most salient pair of each group is kept.

    "Best buddies" of Amir et al., "Deep ViT Features as Dense Visual Descriptors", ECCVW 2022, Sec. 4.4, as ZS6D uses
    them (Ausserlechner et al., ICRA 2024). k-means forms ``count`` groups of the concatenated descriptors of query and
    template; a pair's saliency is the mean of its two cells'. Cells below ``threshold`` are background. Unlike ZS6D's
    code, k-means is seeded, and points are the cells' centres, not rounded to pixels.

    ``foreground``: ``mask`` looks for neighbours among the salient cells of paired clusters. ``saliency``, as ZS6D's
    code: among all cells of both crops, whatever masks and clusters say; pairs of two salient cells remain.
    """

    kind: ClassVar[str] = "correspond.salient"
    version: ClassVar[int] = 1
    added: ClassVar[Mapping[str, Any]] = {"foreground": "mask"}
    needs_saliency: ClassVar[bool] = True

    count: Positive = 20
    threshold: Fraction = 0.05
    seed: NonNegative = 0
    foreground: Literal["mask", "saliency"] = "mask"

    def __call__(
        self, pair: FusedPair, clusters: Clusters, *, crop_size: int, truth: TrueMatches | None = None
    ) -> Correspondences:
        """Matched points, most salient first. Raises NoPose when there is none."""
        query_saliency, template_saliency = (_flatten(s) for s in (pair.query_saliency, pair.template_saliency))
        query_cell, query_pair = self._candidates(clusters.query_label, clusters.pairs[:, 0], query_saliency)
        template_cell, template_pair = self._candidates(
            clusters.template_label, clusters.pairs[:, 1], template_saliency
        )
        query = l2_normalize(pair.query.float().flatten(1).T[query_cell])
        template = l2_normalize(pair.template.float().flatten(1).T[template_cell])
        similarity, nearest = nearest_with_same_label(query, query_pair, template, template_pair)
        _, back = nearest_with_same_label(template, template_pair, query, query_pair)
        buddies = (back[nearest] == torch.arange(len(query), device=query.device)) & (similarity > 0)
        buddies &= query_saliency[query_cell] > self.threshold
        buddies &= template_saliency[template_cell[nearest]] > self.threshold
        mutual = buddies.nonzero()[:, 0]
        if not len(mutual):
            raise NoPose("correspond", f"no salient mutual neighbours among {len(query)} and {len(template)} cells")
        other = nearest[mutual]
        saliency = (query_saliency[query_cell[mutual]] + template_saliency[template_cell[other]]) / 2
        group, _ = kmeans(
            torch.cat([query[mutual], template[other]], 1), count=self.count, seed=self.seed, iterations=100
        )
        kept = _best_of_each(group, saliency)
        return Correspondences(
            cell_px(query_cell[mutual[kept]], like=pair.query, crop_size=crop_size),
            cell_px(template_cell[other[kept]], like=pair.template, crop_size=crop_size),
            similarity[mutual[kept]],
            query_pair[mutual[kept]],
        )

    def _candidates(
        self, label: Int[Tensor, "h w"], paired: Int[Tensor, " p"], saliency: Float[Tensor, " k"]
    ) -> tuple[Int[Tensor, " m"], Int[Tensor, " m"]]:
        if self.foreground == "saliency":
            cells = torch.arange(len(saliency), device=saliency.device)
            return cells, torch.zeros_like(cells)
        cells, of_pair = cells_in_pairs(label, paired)
        kept = saliency[cells] > self.threshold
        if not kept.any():
            raise NoPose("correspond", f"none of {len(cells)} cells is more salient than {self.threshold:g}")
        return cells[kept], of_pair[kept]


def _flatten(saliency: Float[Tensor, "h w"] | None) -> Float[Tensor, " k"]:
    assert saliency is not None, "the route adds saliency where needs_saliency is set"
    return saliency.flatten()


def _best_of_each(group: Int[Tensor, " m"], value: Float[Tensor, " m"]) -> Int[Tensor, " k"]:
    """Index of the highest value of each group, highest first, ties by index."""
    order = torch.sort(value, descending=True, stable=True).indices
    first = torch.full((int(group.max()) + 1,), len(group), dtype=torch.int64, device=group.device)
    rank = torch.arange(len(group), device=group.device)
    first.scatter_reduce_(0, group[order], rank, "amin")
    return order[first.sort().values]
