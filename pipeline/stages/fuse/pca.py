"""query and template features -> one map each, projected together onto their principal axes, layer by layer."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pipeline.errors import BadInput, NoPose
from pipeline.functional.maps import root_mean_square_norm, upsample
from pipeline.functional.pca import principal_axes
from pipeline.items.features import FusedPair
from pipeline.spec import Positive, Spec, spec
from pipeline.stages.fuse import Layers, finest, fused, samples


@spec
class Pca(Spec):
    """Co-projection: von Gimborn et al., "Feature co-projection"; Zhang et al., "A Tale of Two Features", NeurIPS 2023.

    Per layer, one PCA of the query's and the template's cells together; both maps are projected onto its leading axes,
    upsampled to the finest layer and concatenated.

    ``dim_mode``: ``dim`` is shared equally by the layers (``total``; the deepest take what is left over) or is that of
    each (``per_layer``). ``cells``: which cells the axes are fitted to.
    Where the paper is silent: the projection is of features minus their mean, as everywhere in PCA. ``normalise``
    divides each layer's block by the root mean square length of its samples. Layers of a U-Net differ in scale, and
    without it the cosine of the concatenation is that of the loudest layer; off = concatenated as they come.
    """

    kind: ClassVar[str] = "fuse.pca"
    version: ClassVar[int] = 1

    layers: Layers = (2, 5, 8, 11)
    dim: Positive = 64
    dim_mode: Literal["total", "per_layer"] = "total"
    cells: Literal["foreground", "all"] = "foreground"
    normalise: bool = True

    def __post_init__(self) -> None:
        if self.dim_mode == "total" and self.dim < len(self.layers):
            needed = f"at least {len(self.layers)}, one for each layer, where dim_mode is total"
            raise BadInput("fuse.dim", found=self.dim, needed=needed)

    def __call__(
        self,
        query: Mapping[int, Float[Tensor, "c h w"]],
        template: Mapping[int, Float[Tensor, "c h w"]],
        query_mask: Bool[Tensor, "S S"],
        template_mask: Bool[Tensor, "S S"],
    ) -> FusedPair:
        """Fused maps; ``note`` says where the cells span fewer dimensions than asked for.

        Raises NoPose for an empty mask, features that are not finite, and features that are the same in all cells.
        """
        blocks, notes = [], []
        cells = finest(query, self.layers)
        masks = (query_mask, template_mask) if self.cells == "foreground" else None
        for layer, dim in zip(self.layers, self.dims(), strict=True):
            q, t = query[layer].float(), template[layer].float()
            sampled = samples(q, t, masks, layer=layer)
            block = self._projected(sampled, q, t, dim=dim)
            if len(block[0]) < dim:
                notes.append(f"layer {layer}: {len(block[0])} of {dim} dimensions, {len(sampled)} cells span no more")
            if len(block[0]):
                blocks.append([upsample(side, cells=cells) for side in block])
        if not blocks:
            raise NoPose("fuse", "features are the same in all cells of query and template")
        query_map, template_map = (torch.cat(side) for side in zip(*blocks, strict=True))
        return fused(query_map, template_map, query_mask, template_mask, note="; ".join(notes))

    def dims(self) -> tuple[int, ...]:
        """Dimensions of each layer's block."""
        if self.dim_mode == "per_layer":
            return (self.dim,) * len(self.layers)
        each, left = divmod(self.dim, len(self.layers))
        return tuple(each + (i >= len(self.layers) - left) for i in range(len(self.layers)))

    def _projected(
        self,
        sampled: Float[Tensor, "m c"],
        query: Float[Tensor, "c h w"],
        template: Float[Tensor, "c h w"],
        *,
        dim: int,
    ) -> tuple[Float[Tensor, "k h w"], Float[Tensor, "k h w"]]:
        mean, axes = principal_axes(sampled, dim=dim)
        if self.normalise:
            axes = axes / root_mean_square_norm(sampled @ axes - mean @ axes)
        shift = (mean @ axes)[:, None, None]
        query_block, template_block = (torch.tensordot(axes.T, side, dims=1) - shift for side in (query, template))
        return query_block, template_block
