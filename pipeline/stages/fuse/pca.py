"""query and template features -> one map each, projected together onto their principal axes, layer by layer."""

from __future__ import annotations

from typing import ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.errors import BadInput, NoPose
from pipeline.functional.maps import root_mean_square_norm, upsample
from pipeline.functional.pca import principal_axes
from pipeline.items.features import CropFeatures, FittedArrays, FusedPair
from pipeline.spec import Positive, spec
from pipeline.stages.fuse import Fuser, Layers, finest, pair_maps, sample_cells


@spec
class Pca(Fuser[CropFeatures]):
    """Co-projection: von Gimborn et al., "Feature co-projection"; Zhang et al., "A Tale of Two Features", NeurIPS 2023.

    Per layer, one PCA of the query's and the template's cells together; both maps are projected onto its leading axes,
    upsampled to the finest layer and concatenated.

    ``dim_mode``: ``dim`` is divided equally among the layers (``total``; the deepest get the remainder) or is that of
    each layer (``per_layer``). ``cells``: the cells that the axes are fitted to.
    Not stated in the paper: the mean is subtracted before projecting. ``normalise`` divides each layer's block by the
    root mean square length of its samples: layers of a U-Net differ in scale, and without it the cosine of the
    concatenation is dominated by the layer with the largest values.
    """

    kind: ClassVar[str] = "fuse.pca"
    version: ClassVar[int] = 1
    joint: ClassVar[bool] = True

    layers: Layers = (2, 5, 8, 11)
    dim: Positive = 64
    dim_mode: Literal["total", "per_layer"] = "total"
    cells: Literal["foreground", "all"] = "foreground"
    normalise: bool = True

    def __post_init__(self) -> None:
        if self.dim_mode == "total" and self.dim < len(self.layers):
            needed = f"at least {len(self.layers)}, one for each layer, where dim_mode is total"
            raise BadInput("fuse.dim", found=self.dim, needed=needed)

    def encode(self, crop: CropFeatures, fitted: FittedArrays) -> CropFeatures:
        """The crop's features, unchanged: the axes depend on both images."""
        return crop

    def pair(self, query: CropFeatures, template: CropFeatures) -> FusedPair:
        """Fused maps; ``note`` lists layers whose cells span fewer dimensions than ``dim``.

        Raises NoPose for an empty mask, features that are not finite, and features that are the same in all cells.
        """
        query_maps, template_maps, notes = [], [], []
        cells = finest(query.maps, self.layers)
        masks = (query.mask, template.mask) if self.cells == "foreground" else None
        for layer, dim in zip(self.layers, self.dims(), strict=True):
            q, t = query.maps[layer].float(), template.maps[layer].float()
            sampled = sample_cells(q, t, masks, layer=layer)
            q, t = self._project(sampled, q, t, dim=dim)
            if len(q) < dim:
                notes.append(f"layer {layer}: {len(q)} of {dim} dimensions, {len(sampled)} cells span no more")
            if len(q):
                query_maps.append(upsample(q, cells=cells))
                template_maps.append(upsample(t, cells=cells))
        if not query_maps:
            raise NoPose("fuse", "features are the same in all cells of query and template")
        maps = torch.cat(query_maps), torch.cat(template_maps)
        return pair_maps(*maps, query.mask, template.mask, note="; ".join(notes))

    def dims(self) -> tuple[int, ...]:
        """Dimensions of each layer's block."""
        if self.dim_mode == "per_layer":
            return (self.dim,) * len(self.layers)
        each, left = divmod(self.dim, len(self.layers))
        return tuple(each + (i >= len(self.layers) - left) for i in range(len(self.layers)))

    def _project(
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
        return torch.tensordot(axes.T, query, dims=1) - shift, torch.tensordot(axes.T, template, dims=1) - shift
