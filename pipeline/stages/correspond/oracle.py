"""true pose -> corresponding points: an upper bound for corresponders, not a method."""

from __future__ import annotations

from typing import ClassVar

import torch

from pipeline.errors import BadInput, NoPose
from pipeline.items.features import Clusters, FusedPair
from pipeline.items.matches import Correspondences, TrueMatches
from pipeline.spec import spec
from pipeline.stages.correspond import Corresponder


@spec
class Oracle(Corresponder):
    """True positions of the template's cells in the query, inside its mask; occluded points are not excluded."""

    kind: ClassVar[str] = "correspond.oracle"
    version: ClassVar[int] = 1
    needs_truth: ClassVar[bool] = True

    def __call__(
        self, pair: FusedPair, clusters: Clusters, *, crop_size: int, truth: TrueMatches | None = None
    ) -> Correspondences:
        """The true pairs whose query point lies on the query's mask. Raises NoPose when none does."""
        if truth is None:
            needed = "the true pose, from detections of ground truth"
            raise BadInput("correspond=oracle", found="features", needed=needed)
        finite = torch.where(torch.isfinite(truth.query_px), truth.query_px, torch.full_like(truth.query_px, -1e6))
        pixel, size = finite.round().long(), truth.query_mask.shape[-1]
        inside = ((pixel >= 0) & (pixel < size)).all(-1)
        x, y = pixel.clamp(0, size - 1).unbind(-1)
        kept = inside & truth.query_mask[y, x]
        if not bool(kept.any()):
            raise NoPose("correspond", "no point of the template truly lies on the query's mask")
        count = int(kept.sum())
        ones, cluster = torch.ones(count), torch.zeros(count, dtype=torch.int64)
        return Correspondences(truth.query_px[kept], truth.template_px[kept], ones, cluster)
