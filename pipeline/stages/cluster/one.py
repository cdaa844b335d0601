"""fused pair -> one cluster that is the whole foreground."""

from __future__ import annotations

from typing import ClassVar

import torch

from pipeline.errors import NoPose
from pipeline.items.features import Clusters, FusedPair
from pipeline.spec import Spec, spec


@spec
class One(Spec):
    """Clustering off: any cell of the query may match any cell of the template."""

    kind: ClassVar[str] = "cluster.one"
    version: ClassVar[int] = 1

    def __call__(self, pair: FusedPair) -> Clusters:
        """Label 0 inside the masks. Raises NoPose for a mask without a cell."""
        for name, mask in (("query", pair.query_mask), ("template", pair.template_mask)):
            if not mask.any():
                raise NoPose("cluster", f"{name} mask has no cell")
        both = torch.zeros(1, 2, dtype=torch.int64, device=pair.query.device)
        return Clusters(pair.query_mask.long() - 1, pair.template_mask.long() - 1, both)
