"""template features -> the principal axes of an object's foreground."""

from __future__ import annotations

from typing import ClassVar

from jaxtyping import Float
from torch import Tensor

from pipeline.errors import DzopError
from pipeline.functional.pca import principal_axes_in_blocks, project_onto_axes
from pipeline.items.features import FittedArrays, TemplateCells
from pipeline.items.fit import Fit
from pipeline.spec import NonNegative, Positive, Spec, spec


@spec
class Projection(Spec):
    """PCA of the foreground of all templates of an object (Örnek et al., "FoundPose", ECCV 2024, section 3.1).

    Exact, and of all descriptors; the released code samples 100,000.
    """

    kind: ClassVar[str] = "fit.projection"
    version: ClassVar[int] = 1

    layer: NonNegative
    dim: Positive

    @property
    def base(self) -> Fit | None:
        """None: it is fitted to features."""
        return None

    def array_bytes(self, channels: int, templates: int) -> int:
        """Mean and axes."""
        return 4 * channels * (1 + min(self.dim, channels))

    def __call__(self, cells: TemplateCells, base: FittedArrays) -> dict[str, Tensor]:
        """``mean`` (c) and ``axes`` (c k); k is below ``dim`` where the cells span fewer dimensions."""
        mean, axes = principal_axes_in_blocks(cells.features.cpu(), dim=self.dim)
        if axes.shape[1] == 0:
            raise DzopError(f"features of layer {self.layer} are the same in all {len(cells.features)} template cells")
        return {"mean": mean, "axes": axes}


def project_map(maps: Float[Tensor, "c h w"], fitted: FittedArrays) -> Float[Tensor, "k h w"]:
    """A map projected onto the axes of a Projection."""
    cells = project_onto_axes(maps.flatten(1).T, fitted["mean"], fitted["axes"])
    return cells.T.unflatten(1, maps.shape[1:])
