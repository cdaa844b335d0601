"""query and template features -> one map each, in whatever way suits the features."""

from __future__ import annotations

from typing import ClassVar

from pipeline.spec import Spec, spec
from pipeline.stages.fuse import Layers
from pipeline.stages.fuse.learned import LAYERS, Learned
from pipeline.stages.fuse.pca import Pca


@spec
class Auto(Spec):
    """``Learned`` for the features its head was trained on, with edges, ``Pca`` for all others.

    Keys are those of the one taken.
    """

    kind: ClassVar[str] = "fuse.auto"
    version: ClassVar[int] = 1

    layers: Layers = LAYERS

    def resolve_for(self, model: str) -> Learned | Pca:
        """The variant for features of an extractor's ``model``."""
        if not Learned.suits(model):
            return Pca(layers=self.layers)
        return Learned() if self.layers == LAYERS else Learned(layers=self.layers)  # which its check refuses by name
