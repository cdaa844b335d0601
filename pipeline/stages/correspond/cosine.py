"""fused pair, clusters -> corresponding points, in crop pixels: the most similar cells of paired clusters."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pipeline.errors import NoPose
from pipeline.functional.similarity import best_per_group, l2_normalize, nearest_rows, nearest_with_same_label
from pipeline.functional.subpixel import neighbourhood_shift
from pipeline.items.features import Clusters, FusedPair
from pipeline.items.matches import Correspondences, TrueMatches
from pipeline.spec import Positive, spec
from pipeline.stages.correspond import Corresponder, cell_px, cells_in_pairs


@spec
class Cosine(Corresponder):
    """Each query cell's most similar template cell inside the paired cluster, the ``per_cluster`` best of each pair.

    von Gimborn et al., "Semantic Correspondence Estimation" ("mutual semantic correspondences"; top 10).
    ``per_cluster`` keeps large clusters from outvoting small ones; a single cluster pair keeps all of its matches.
    ``mutual``: keep mutual nearest neighbours only. ``kernel``: side, in cells, of the neighbourhood that gives the
    template's point its sub-pixel position (functional.subpixel); 1 = off, the cell's centre. ``subtract_own_shift``:
    subtract the shift that the template cell's own feature gives; False is the equation as printed.
    """

    kind: ClassVar[str] = "correspond.cosine"
    version: ClassVar[int] = 1
    added: ClassVar[Mapping[str, Any]] = {"subtract_own_shift": True}

    per_cluster: Positive = 10
    mutual: bool = True
    kernel: Literal[1, 3, 5, 7] = 3
    subtract_own_shift: bool = True

    def __call__(
        self, pair: FusedPair, clusters: Clusters, *, crop_size: int, truth: TrueMatches | None = None
    ) -> Correspondences:
        """Matched points, by cluster pair, best first. Raises NoPose when there is none."""
        query_cell, query_pair = cells_in_pairs(clusters.query_label, clusters.pairs[:, 0])
        template_cell, template_pair = cells_in_pairs(clusters.template_label, clusters.pairs[:, 1])
        if len(query_cell) == 0 or len(template_cell) == 0:
            raise NoPose("correspond", f"{len(clusters.pairs)} cluster pairs, none with cells on both sides")
        query = l2_normalize(pair.query.float().movedim(0, -1).flatten(0, 1)[query_cell])
        template = l2_normalize(pair.template.float().movedim(0, -1)).contiguous()
        inside = template.flatten(0, 1).index_select(0, template_cell)
        similarity, nearest, candidate = self._nearest(query, query_pair, inside, template_pair, len(clusters.pairs))
        limit = self.per_cluster if len(clusters.pairs) > 1 else len(query)
        kept = best_per_group(similarity, query_pair, candidate, count=limit)
        if len(kept) == 0:
            raise NoPose("correspond", f"no cells of {len(clusters.pairs)} cluster pairs have a positive cosine")
        template_kept = template_cell[nearest[kept]]
        shift = neighbourhood_shift(
            query[kept], template, pair.template_mask, template_kept,
            kernel=self.kernel, subtract_own=self.subtract_own_shift,
        )  # fmt: skip
        return Correspondences(
            cell_px(query_cell[kept], like=pair.query, crop_size=crop_size),
            cell_px(template_kept, like=pair.template, crop_size=crop_size, shift=shift),
            similarity[kept],
            query_pair[kept],
        )

    def _nearest(
        self,
        query: Float[Tensor, "m c"],
        query_pair: Int[Tensor, " m"],
        template: Float[Tensor, "n c"],
        template_pair: Int[Tensor, " n"],
        pairs: int,
    ) -> tuple[Float[Tensor, " m"], Int[Tensor, " m"], Bool[Tensor, " m"]]:
        """For each query cell: cosine with, and index of, its most similar template cell, and whether it may match."""
        if self.mutual and pairs == 1:
            similarity, nearest, mutual = nearest_rows(query, template)
            return similarity, nearest, mutual & (similarity > 0)
        similarity, nearest = nearest_with_same_label(query, query_pair, template, template_pair)
        candidate = similarity > 0
        if self.mutual:
            _, back = nearest_with_same_label(template, template_pair, query, query_pair)
            candidate &= back[nearest] == torch.arange(len(query), device=query.device)
        return similarity, nearest, candidate
