"""fused pair, clusters -> corresponding points, in crop pixels."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.functional.camera import cell_to_px, grid_xy
from pipeline.functional.masks import foreground
from pipeline.items.features import Clusters, FusedPair
from pipeline.items.matches import Correspondences, TrueMatches
from pipeline.spec import Spec


class Corresponder(Spec, ABC):
    """Contract of a correspond variant.

    ``needs_truth``: True for oracles, which receive ``truth``. ``needs_saliency``: True where it reads the pair's
    saliency; the extractor is then asked for SALIENCY_LAYER as well.
    """

    needs_truth: ClassVar[bool] = False
    needs_saliency: ClassVar[bool] = False

    @abstractmethod
    def __call__(
        self, pair: FusedPair, clusters: Clusters, *, crop_size: int, truth: TrueMatches | None = None
    ) -> Correspondences:
        """Matched points, best first within a cluster. Crops have ``crop_size`` pixels a side.

        Raises NoPose when there is none.
        """


def cells_in_pairs(label: Int[Tensor, "h w"], paired: Int[Tensor, " p"]) -> tuple[Int[Tensor, " m"], Int[Tensor, " m"]]:
    """Flat indices of the cells whose cluster is in a pair, and the index of that pair."""
    pair_of = torch.full((int(label.max()) + 2,), -1, dtype=torch.int64, device=label.device)
    pair_of[paired] = torch.arange(len(paired), device=label.device)
    of_cell = pair_of[label.flatten()]  # the background's -1 indexes the last entry, which no cluster has
    cells = foreground(of_cell >= 0)
    return cells, of_cell[cells]


def cell_px(
    cell: Int[Tensor, " m"], *, like: Float[Tensor, "d h w"], crop_size: int, shift: Tensor | float = 0.0
) -> Float[Tensor, "m 2"]:
    """Crop pixels of flat cell indices of a map, moved by ``shift`` cells (m 2)."""
    cells = like.shape[-1]
    return cell_to_px(grid_xy(cell, width=cells).float() + shift, size=crop_size, cells=cells)
