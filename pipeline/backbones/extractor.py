"""The contract of an extractor: what an extract variant offers before and after its weights are loaded."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Protocol

from pipeline.backbones.batching import Footprint
from pipeline.items.features import FeatureMaps
from pipeline.items.views import Crops
from pipeline.spec import Runtime, Variant


class Backbone(Protocol):
    """An extractor with its weights in memory. ``batch``: how many crops to pass in one call."""

    batch: int

    def __call__(self, crops: Crops, layers: Sequence[int]) -> FeatureMaps:
        """Maps of the given layers, float32 or the spec's dtype, on the runtime's device."""
        ...


class Extractor(Variant, Protocol):
    """A spec that knows the shapes of its feature maps, and its weights' digest, before any weight is loaded.

    ``needs_geometry``: True for oracles alone; their crops carry Geometry. ``notice``: a caveat about the features that
    is printed at the head of every run, "" for none.
    """

    needs_geometry: ClassVar[bool]
    notice: ClassVar[str]

    @property
    def model(self) -> str:
        """Short name of model and weights for the store's path, e.g. ``stable_diffusion-1a2b3c4d``."""
        ...

    @property
    def timestep(self) -> int:
        """Diffusion timestep; 0 for models without one."""
        ...

    def feature_shape(self, layer: int) -> tuple[int, int, int]:
        """(c, h, w) of one crop's map. Raises BadInput for a layer that does not exist."""
        ...

    def footprint(self, layers: Sequence[int], crop_size: int, device: str) -> Footprint | None:
        """Memory of passes that compute ``layers`` for crops of that size on "cpu" or "cuda"; None: unknown.

        Optional, see ``footprint_of``. Raises BadInput for weights that cannot be found.
        """
        ...

    def load(self, runtime: Runtime) -> Backbone:
        """Weights into memory. Raises BadInput for weights that are missing or of another class."""
        ...


def footprint_of(extractor: Extractor, layers: Sequence[int], crop_size: int, device: str) -> Footprint | None:
    """The extractor's footprint; None where it is unknown, which a variant says by returning None or having no method.

    Extractors of unknown size run without a memory budget.
    """
    method = getattr(extractor, "footprint", None)
    return None if method is None else method(layers, crop_size, device)
