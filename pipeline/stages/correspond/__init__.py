"""fused pair, clusters -> corresponding points, in crop pixels."""

from __future__ import annotations

from typing import ClassVar, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pipeline.functional.camera import cell_to_px, grid_xy
from pipeline.functional.masks import foreground
from pipeline.items.features import Clusters, FusedPair
from pipeline.items.matches import Correspondences
from pipeline.spec import Variant


class Corresponder(Variant, Protocol):
    """What a correspond variant is. ``crop_size``: side S of the crops in pixels."""

    def __call__(self, pair: FusedPair, clusters: Clusters, *, crop_size: int) -> Correspondences:
        """Matched points, best first within a cluster. Raises NoPose when there is none."""
        ...


@runtime_checkable
class TruthCorresponder(Protocol):
    """An oracle that is told where points truly lie; no other corresponder is."""

    needs_truth: ClassVar[bool]

    def by_truth(
        self, template_px: Float[Tensor, "m 2"], true_px: Float[Tensor, "m 2"], query_mask: Bool[Tensor, "S S"]
    ) -> Correspondences:
        """The pairs that both see."""
        ...


@runtime_checkable
class SalientCorresponder(Protocol):
    """One that reads the pair's saliency: the extractor is asked for SALIENCY_LAYER too."""

    needs_saliency: ClassVar[bool]


def cells_in_pairs(label: Int[Tensor, "h w"], paired: Int[Tensor, " p"]) -> tuple[Int[Tensor, " m"], Int[Tensor, " m"]]:
    """Flat indices of the cells whose cluster is in a pair, and the index of that pair."""
    pair_of = torch.full((int(label.max()) + 2,), -1, dtype=torch.int64, device=label.device)
    pair_of[paired] = torch.arange(len(paired), device=label.device)
    of_cell = pair_of[label.flatten()]  # background, -1, reads the last entry, which no cluster owns
    cells = foreground(of_cell >= 0)
    return cells, of_cell[cells]


def cell_px(
    cell: Int[Tensor, " m"], *, like: Float[Tensor, "d h w"], crop_size: int, shift: Tensor | float = 0.0
) -> Float[Tensor, "m 2"]:
    """Crop pixels of flat cell indices of a map, moved by ``shift`` cells (m 2)."""
    cells = like.shape[-1]
    return cell_to_px(grid_xy(cell, width=cells).float() + shift, size=crop_size, cells=cells)
