"""The contract of an extractor: what an extract variant offers before and after its weights are loaded."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Protocol

from pipeline.backbones.batching import Footprint, Passes
from pipeline.items.features import FeatureMaps
from pipeline.items.views import Crops
from pipeline.spec import Runtime, Spec


class Backbone(Protocol):
    """An extractor with its weights in memory.

    A call should have ``passes.batch`` crops. ``passes.run`` computes them so that no byte depends on batch or threads.
    """

    passes: Passes

    def __call__(self, crops: Crops, layers: Sequence[int]) -> FeatureMaps:
        """Maps of the given layers, float32 or the spec's dtype, on the runtime's device."""
        ...


class Extractor(Spec, ABC):
    """Contract of an extract variant: its name, shapes and memory are known before any weight is loaded."""

    @property
    def needs_geometry(self) -> bool:
        """True for oracles: their crops carry Geometry."""
        return False

    @property
    def notice(self) -> str:
        """A caveat about the features, printed at the head of every run; "" for none."""
        return ""

    @property
    @abstractmethod
    def model(self) -> str:
        """Short name of model and weights for the store's path, e.g. ``stable_diffusion-1a2b3c4d``."""

    @property
    def timestep(self) -> int:
        """Diffusion timestep; 0 for models without one."""
        return 0

    @abstractmethod
    def feature_shape(self, layer: int) -> tuple[int, int, int]:
        """(c, h, w) of one crop's map. Raises BadInput for a layer that does not exist."""

    def footprint(self, layers: Sequence[int], crop_size: int, device: str = "cpu") -> Footprint | None:
        """Memory of passes that compute ``layers`` for crops of that size on "cpu" or "cuda".

        None: unknown, so that memory budgets do not count it. Raises BadInput for weights that cannot be found.
        """
        return None

    @abstractmethod
    def load(self, runtime: Runtime) -> Backbone:
        """Weights into memory. Raises BadInput for weights that are missing or of another class."""
