"""query and template features -> one map each, projected onto the principal axes of the object's templates."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, ClassVar

import torch
from jaxtyping import Bool, Float
from pydantic import Field
from torch import Tensor

from pipeline.errors import NoPose
from pipeline.fits import Fitted, fitted_to, foreground_cells
from pipeline.fits.projection import Projection, on_axes
from pipeline.items.features import FusedPair
from pipeline.spec import NonNegative, Positive, Spec, spec
from pipeline.stages.fuse import fused


@spec
class TemplatePca(Spec):
    """One layer, projected by a PCA that was fitted offline to the foreground of all templates of the object.

    Örnek et al., "FoundPose", ECCV 2024, section 3.1. Unlike fuse=pca, every pair of an object meets in one space, and
    nothing is decomposed online. ``layers`` names a single layer.
    """

    kind: ClassVar[str] = "fuse.template_pca"
    version: ClassVar[int] = 1

    layers: Annotated[tuple[NonNegative, ...], Field(min_length=1, max_length=1)] = (11,)
    dim: Positive = 256

    @property
    def fit(self) -> Projection:
        """The axes."""
        return Projection(layer=self.layers[0], dim=self.dim)

    def __call__(
        self,
        query: Mapping[int, Float[Tensor, "c h w"]],
        template: Mapping[int, Float[Tensor, "c h w"]],
        query_mask: Bool[Tensor, "S S"],
        template_mask: Bool[Tensor, "S S"],
    ) -> FusedPair:
        """As ``by_fitted``, fitted here and now to the one template that it is given."""
        maps = template[self.layers[0]]
        arrays = fitted_to(self.fit, foreground_cells(maps[None], template_mask[None]))
        on_device = {name: array.to(maps.device) for name, array in arrays.items()}
        return self.by_fitted(query, template, query_mask, template_mask, on_device)

    def by_fitted(
        self,
        query: Mapping[int, Float[Tensor, "c h w"]],
        template: Mapping[int, Float[Tensor, "c h w"]],
        query_mask: Bool[Tensor, "S S"],
        template_mask: Bool[Tensor, "S S"],
        fitted: Fitted,
    ) -> FusedPair:
        """Fused maps; ``note`` says where the templates span fewer dimensions than asked for.

        Raises NoPose for an empty mask and for features that are not finite.
        """
        layer, kept = self.layers[0], fitted["axes"].shape[1]
        if not all(bool(torch.isfinite(side[layer]).all()) for side in (query, template)):
            raise NoPose("fuse", f"features of layer {layer} are not finite")
        query_map, template_map = (on_axes(side[layer], fitted) for side in (query, template))
        note = f"layer {layer}: {kept} of {self.dim} dimensions, the templates span no more" if kept < self.dim else ""
        return fused(query_map, template_map, query_mask, template_mask, note=note)
