"""mesh -> its outermost points and symmetries, which distances between poses are measured with."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from pipeline.bop.symmetries import SYMMETRIES_VERSION, mesh_symmetries, transforms_of
from pipeline.confidence.evidence import Extent, measure_extent
from pipeline.functional.symmetry import Symmetries
from pipeline.graph.context import Context
from pipeline.store import Ref, make_ref

EXTENT_VERSION = 1


@dataclass(eq=False)
class ExtentNodes:
    """Nodes of objects' extents. Only symmetries that are found in a mesh are worth an entry: finding takes seconds."""

    context: Context

    def ref(self, obj_id: int) -> Ref | None:
        """The entry of an object's extent; None where the dataset states the symmetries."""
        if not self.context.dataset.finds_symmetries:
            return None
        recipe = {"kind": "extent", "version": EXTENT_VERSION, "symmetries": SYMMETRIES_VERSION}
        return make_ref("extents", recipe, {"mesh": self.context.mesh_digest(obj_id)})

    def make(self, obj_id: int) -> None:
        """Measure an object's extent and find its symmetries, where an entry of them is missing."""
        ref = self.ref(obj_id)
        if ref is None or self.context.store.is_complete(ref):
            return
        model = self.context.model(obj_id)
        found = mesh_symmetries(model.mesh, model.diameter_mm)[1]
        document = {
            "points": measure_extent(model).points.tolist(),
            "diameter_mm": model.diameter_mm,
            "discrete": found.discrete.tolist(),
            "axes": found.axes.tolist(),
            "offsets": found.offsets.tolist(),
        }
        self.context.store.put_document(ref, document, rows=1)

    @cached_property
    def read(self) -> Callable[[int], Extent]:
        """An object's extent."""
        return lru_cache(maxsize=None)(self._read)

    def _read(self, obj_id: int) -> Extent:
        ref = self.ref(obj_id)
        if ref is None:
            return measure_extent(self.context.model(obj_id))
        self.make(obj_id)
        stored = self.context.store.read(ref).document
        shapes = {"discrete": (-1, 4, 4), "axes": (-1, 3), "offsets": (-1, 3)}
        found = Symmetries(**{name: np.reshape(stored[name], shape) for name, shape in shapes.items()})
        return Extent(np.array(stored["points"]), transforms_of(found), stored["diameter_mm"])
