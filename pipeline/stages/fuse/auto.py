"""query and template features -> one map each, in whatever way suits the features."""

from __future__ import annotations

from typing import ClassVar

from pipeline.spec import Spec, spec
from pipeline.stages.extract.embedded import EDGES
from pipeline.stages.fuse import Layers
from pipeline.stages.fuse.learned import Learned
from pipeline.stages.fuse.pca import Pca


@spec
class Auto(Spec):
    """``Learned`` for the features its head was trained on, with edges, ``Pca`` for all others.

    Keys are those of the one taken.
    """

    kind: ClassVar[str] = "fuse.auto"
    version: ClassVar[int] = 1

    layers: Layers = (2, 5, 8, 11)

    def resolve_for(self, model: str) -> Learned | Pca:
        """The variant for features of an extractor's ``model``."""
        return Learned(layers=(*self.layers, EDGES)) if Learned.suits(model) else Pca(layers=self.layers)
