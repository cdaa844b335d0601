"""What every node needs: stages, dataset, store, the backbone loaded once, and the two ways to fill entries."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from pipeline.bop.dataset import Dataset
from pipeline.errors import BadInput, DzopError
from pipeline.graph.lru import Kept
from pipeline.graph.tasks import Advance, Unit, Work, Workers
from pipeline.graph.timings import Rates, work_of
from pipeline.items.objects import ObjectModel
from pipeline.items.views import Crops, Target
from pipeline.progress import Progress
from pipeline.route import Stages
from pipeline.spec import Runtime
from pipeline.stages.extract import Backbone
from pipeline.store import Layout, Ref, Store, make_ref

MESHES_BYTES = 256 << 20

ImageId = tuple[int, int]
"""(scene_id, im_id)"""


@dataclass(eq=False)
class Context:
    """One run: its stages, data, store and progress. ``workers``: who does its work, None for this process alone."""

    stages: Stages
    dataset: Dataset
    targets: Sequence[Target]
    store: Store
    runtime: Runtime
    progress: Progress = field(default_factory=Progress)
    workers: Workers | None = None

    @cached_property
    def object_ids(self) -> list[int]:
        """Objects of the targets."""
        return sorted({target.obj_id for target in self.targets})

    @cached_property
    def image_ids(self) -> list[ImageId]:
        """Images of the targets."""
        return sorted({(target.scene_id, target.im_id) for target in self.targets})

    @cached_property
    def model(self) -> Kept[int, ObjectModel]:
        """An object's mesh; the last ones stay in memory, so that it does not grow with the number of objects."""
        return Kept(self._model, _mesh_bytes, MESHES_BYTES)

    def _model(self, obj_id: int) -> ObjectModel:
        model = self.dataset.object_model(obj_id)
        if model.mesh.digest != self.mesh_digest(obj_id):
            found = "other bytes than when its key was made"
            raise BadInput(self.dataset.model_path(obj_id), found=found, needed="a mesh that no one writes meanwhile")
        return model

    @cached_property
    def mesh_digest(self) -> Callable[[int], str]:
        """Digest of an object's mesh, which keys are made from; the mesh itself is read where something is computed."""
        return lru_cache(maxsize=None)(self.dataset.mesh_digest)

    @cached_property
    def rates(self) -> Rates:
        """Seconds of rows as they were measured on this machine."""
        return Rates(self.store.backend.folder, self.device)

    @cached_property
    def backbone(self) -> Backbone:
        """The extractor with its weights, loaded when the first feature is missing."""
        return self.stages.extract.load(self.runtime)

    @cached_property
    def device(self) -> str:
        """Where tensors live."""
        return self.runtime.torch_device()

    def K(self, image: ImageId) -> Float[np.ndarray, "3 3"]:
        """Camera matrix of an image."""
        return self.dataset.K(*image)

    def tensor(self, values: np.ndarray) -> torch.Tensor:
        """Stored values on the device."""
        return torch.from_numpy(np.ascontiguousarray(values)).to(self.device)

    def each(self, work: Work[Unit], units: Sequence[Unit], advance: Advance) -> None:
        """Do every unit of work, here or by the run's workers; what is there already never leaves this process."""
        away = [] if self.workers is None else [unit for unit in units if not work.done(unit)]
        for unit in units if not away else set(units).difference(away):
            work.do(unit, advance)
        for unit, counts in self.workers.each(work.name, away) if self.workers and away else ():
            self.progress.merge(counts)
            if not work.done(unit):
                found = f"that a worker has finished {work.name} of {unit}, and nothing of it in {self.store.place}"
                raise BadInput("runtime", found=found, needed="workers that see the same files and the same store")
            advance(work.size(unit))

    # --- entries of one kind -----------------------------------------------------------------------------------------

    def features(self, layer: int, inputs: Mapping[str, str]) -> Ref:
        """Features of one layer of some crops, at a path a person can read."""
        extract = self.stages.extract
        recipe = {"kind": "features", "extract": extract.recipe(), "layer": layer}
        return make_ref(f"features/{extract.model}/t{extract.timestep}/layer{layer}", recipe, inputs)

    def features_layout(self, layer: int) -> dict[str, Layout]:
        """Arrays of a features entry."""
        return {"maps": Layout(self.stages.extract.feature_shape(layer), "float16")}

    def crops_layout(self) -> dict[str, Layout]:
        """Arrays of a crops entry."""
        size = self.stages.crop.size
        return {
            "rgb": Layout((size, size, 3), "uint8", compress=True),
            "mask": Layout((size, size), "bool", compress=True),
            "A_crop_img": Layout((3, 3), "float64"),
        }

    # --- filling -----------------------------------------------------------------------------------------------------

    def fill(
        self,
        step: str,
        title: str,
        refs: Mapping[Ref, Mapping[str, Layout]],
        rows: int,
        batch: int,
        compute: Callable[[list[int]], Any],
        document: Mapping[str, Any] | None = None,
        work: str = "",
    ) -> None:
        """Fill entries and count them, with a bar when the step has a title of its own.

        ``work``: what decides the seconds of a row, for plans; "" where nobody asks.
        """
        if all(self.store.is_complete(ref) for ref in refs):
            self.progress.add(step, reused=rows)
            return
        with self.progress.bar(rows, title, "row") as advance:
            filled = self.store.fill(refs, rows=rows, batch=batch, compute=compute, document=document, advance=advance)
        self.progress.add(step, computed=filled.computed, reused=filled.reused, time_s=filled.time_s)
        if work and filled.computed:
            self.rates.note(work, filled.computed, filled.time_s)

    def extract(
        self, step: str, title: str, refs: Mapping[int, Ref], rows: int, crops: Callable[[list[int]], Crops]
    ) -> None:
        """Features of the layers that are missing, in as few passes as possible: one for all of them."""
        missing = {layer: ref for layer, ref in refs.items() if not self.store.is_complete(ref)}
        if not missing:
            self.progress.add(step, reused=rows)
            return

        def compute(batch: list[int]) -> dict[str, dict[str, np.ndarray]]:
            maps = self.maps(crops(batch), tuple(missing))
            return {ref.key: {"maps": maps[layer]} for layer, ref in missing.items()}

        layouts = {ref: self.features_layout(layer) for layer, ref in missing.items()}
        batch = self.backbone.batch  # loads the weights: their seconds are no part of a row's
        work = work_of("features", self.stages, list(missing))
        self.fill(step, title, layouts, rows, self.runtime.batch or batch, compute, work=work)

    def maps(self, crops: Crops, layers: Sequence[int]) -> dict[int, np.ndarray]:
        """Feature maps of crops as they are stored: float16, on the CPU."""
        maps = self.backbone(crops, layers)
        return {layer: _half(maps[layer], layer) for layer in layers}


def stacked(crops: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> dict[str, np.ndarray]:
    """Rows of a crops entry from what the crop stage returns."""
    rgb, mask, A_crop_img = (np.stack(parts) for parts in zip(*crops, strict=True))
    return {"rgb": rgb, "mask": mask, "A_crop_img": A_crop_img}


def _mesh_bytes(model: ObjectModel) -> int:
    mesh = model.mesh
    arrays = (mesh.vertices, mesh.faces, mesh.colours, mesh.uv, mesh.texture)
    return sum(array.nbytes for array in arrays if array is not None)


def _half(maps: torch.Tensor, layer: int) -> np.ndarray:
    """float16 on the CPU. Raises DzopError where a value does not fit: infinite features would give wrong poses."""
    half = maps.half()
    if not torch.isfinite(half).all():
        raise DzopError(
            f"layer {layer}: features are not finite in float16; try extract.dtype=float32 or another layer"
        )
    return half.cpu().numpy()
