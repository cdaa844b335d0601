"""template features -> the principal axes of an object's foreground."""

from __future__ import annotations

from typing import ClassVar

from jaxtyping import Float
from torch import Tensor

from pipeline.errors import DzopError
from pipeline.fits import Fit, Fitted
from pipeline.functional.pca import principal_axes_in_blocks, project_onto_axes
from pipeline.items.features import TemplateCells
from pipeline.spec import NonNegative, Positive, Spec, spec


@spec
class Projection(Spec):
    """PCA of the foreground of all templates of an object (Örnek et al., "FoundPose", ECCV 2024, section 3.1).

    Exact and of all descriptors, where the released code draws 100,000 of them.
    """

    kind: ClassVar[str] = "fit.projection"
    version: ClassVar[int] = 1

    layer: NonNegative
    dim: Positive

    @property
    def base(self) -> Fit | None:
        """Nothing but features."""
        return None

    def array_bytes(self, channels: int, templates: int) -> int:
        """Mean and axes."""
        return 4 * channels * (1 + min(self.dim, channels))

    def __call__(self, cells: TemplateCells, base: Fitted) -> dict[str, Tensor]:
        """``mean`` (c) and ``axes`` (c k), k smaller than ``dim`` where the cells span no more."""
        mean, axes = principal_axes_in_blocks(cells.features.cpu(), dim=self.dim)
        if axes.shape[1] == 0:
            raise DzopError(f"features of layer {self.layer} are the same in all {len(cells.features)} template cells")
        return {"mean": mean, "axes": axes}


def on_axes(maps: Float[Tensor, "c h w"], fitted: Fitted) -> Float[Tensor, "k h w"]:
    """A map projected onto a Projection's axes."""
    cells = project_onto_axes(maps.flatten(1).T, fitted["mean"], fitted["axes"])
    return cells.T.unflatten(1, maps.shape[1:])
