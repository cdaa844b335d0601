"""query and template features -> one map each, by the variant that suits the features."""

from __future__ import annotations

from typing import ClassVar

from pipeline.spec import Spec, spec
from pipeline.stages.fuse import Layers
from pipeline.stages.fuse.learned import LAYERS, Learned
from pipeline.stages.fuse.pca import Pca


@spec
class Auto(Spec):
    """``Learned`` with gradient histograms for the features its head was trained on, ``Pca`` for all others.

    Keys are those of the chosen variant.
    """

    kind: ClassVar[str] = "fuse.auto"
    version: ClassVar[int] = 1

    layers: Layers = LAYERS

    def resolve_for(self, model: str) -> Learned | Pca:
        """The variant for features of an extractor's ``model``."""
        if not Learned.suits(model):
            return Pca(layers=self.layers)
        return Learned() if self.layers == LAYERS else Learned(layers=self.layers)  # whose check names valid ones
