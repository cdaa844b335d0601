"""crops -> feature maps by layer."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Protocol

from pipeline.items.features import FeatureMaps
from pipeline.items.views import Crops
from pipeline.spec import Runtime, Variant


class Backbone(Protocol):
    """An extractor with its weights in memory. ``batch``: how many crops one call should get."""

    batch: int

    def __call__(self, crops: Crops, layers: Sequence[int]) -> FeatureMaps:
        """Maps of the given layers, float32 or the spec's dtype, on the runtime's device."""
        ...


class Extractor(Variant, Protocol):
    """What an extract variant is: a spec that can say what it would give before any weight is loaded.

    ``needs_geometry``: True only for oracles; their crops carry Geometry. ``notice``: what a user must know of the
    features before trusting a number ("" when there is nothing), printed at the head of every run.
    """

    needs_geometry: ClassVar[bool]
    notice: ClassVar[str]

    @property
    def model(self) -> str:
        """Short name of model and weights for the store's path, e.g. ``stable_diffusion-1a2b3c4d``."""
        ...

    @property
    def timestep(self) -> int:
        """Diffusion timestep; 0 for models that have none."""
        ...

    def feature_shape(self, layer: int) -> tuple[int, int, int]:
        """(c, h, w) of one crop's map. Raises BadInput for a layer that does not exist."""
        ...

    def load(self, runtime: Runtime) -> Backbone:
        """Weights into memory. Raises BadInput for weights that are missing or of another class."""
        ...
