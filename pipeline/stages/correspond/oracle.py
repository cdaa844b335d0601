"""true pose -> corresponding points: an upper bound for every matching of points, never a result."""

from __future__ import annotations

from typing import ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pipeline.errors import BadInput, NoPose
from pipeline.items.features import Clusters, FusedPair
from pipeline.items.matches import Correspondences
from pipeline.spec import Spec, spec


@spec
class Oracle(Spec):
    """Where the template's cells truly lie in the query, as far as its mask reaches; hidden backs are not left out."""

    kind: ClassVar[str] = "correspond.oracle"
    version: ClassVar[int] = 1
    needs_truth: ClassVar[bool] = True

    def __call__(self, pair: FusedPair, clusters: Clusters, *, crop_size: int) -> Correspondences:
        """Not without the truth."""
        raise BadInput("correspond=oracle", found="features", needed="the true pose, from detections of ground truth")

    def by_truth(
        self, template_px: Float[Tensor, "m 2"], true_px: Float[Tensor, "m 2"], query_mask: Bool[Tensor, "S S"]
    ) -> Correspondences:
        """Those of the pairs whose point is on the query's mask; NaN is on none. Raises NoPose when none is."""
        pixel = torch.where(torch.isfinite(true_px), true_px, torch.full_like(true_px, -1e6)).round().long()
        size = query_mask.shape[-1]
        inside = ((pixel >= 0) & (pixel < size)).all(-1)
        x, y = pixel.clamp(0, size - 1).unbind(-1)
        kept = inside & query_mask[y, x]
        if not bool(kept.any()):
            raise NoPose("correspond", "no point of the template truly lies on the query's mask")
        count = int(kept.sum())
        return Correspondences(
            true_px[kept], template_px[kept], torch.ones(count), torch.zeros(count, dtype=torch.int64)
        )
