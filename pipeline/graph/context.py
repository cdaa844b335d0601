"""Shared state of a run's nodes: stages, data, store and backbone. Runs tasks and fills entries."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Protocol, TypeVar

import numpy as np
import torch
from jaxtyping import Float

from pipeline.bop.dataset import Dataset
from pipeline.confidence.calibration import Calibration
from pipeline.errors import BadInput, DzopError
from pipeline.graph.lru import LRUCache
from pipeline.graph.tasks import Advance, Item, Task, Workers
from pipeline.graph.timings import Timings, timing_key
from pipeline.io.digests import unchanged_files
from pipeline.items.objects import ObjectModel
from pipeline.items.views import Crop, Crops, Target
from pipeline.method import Stages
from pipeline.parallel import one_thread_per_kernel
from pipeline.progress import Progress
from pipeline.spec import Runtime
from pipeline.stages.detect import Detector
from pipeline.stages.extract import Backbone
from pipeline.store import Layout, Ref, Store, make_ref

MESHES_BYTES = 256 << 20  # limit for all meshes in memory

Loaded = TypeVar("Loaded", covariant=True)
ImageId = tuple[int, int]
"""(scene_id, im_id)"""


class Loadable(Protocol[Loaded]):
    """A spec with weights to load: an extractor or a proposer."""

    def load(self, runtime: Runtime) -> Loaded:
        """Load the weights into memory."""
        ...


@dataclass(eq=False)
class Context:
    """Shared state of one run's nodes: stages, data, store and step counts.

    ``workers`` run tasks in other processes; None runs everything in this one. ``calibration`` gives poses a
    confidence; None if there is none for these stages.
    """

    stages: Stages
    dataset: Dataset
    targets: Sequence[Target]
    store: Store
    runtime: Runtime
    progress: Progress = field(default_factory=Progress)
    workers: Workers | None = None
    calibration: Calibration | None = None
    _mesh_digests: dict[int, str] = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def object_ids(self) -> list[int]:
        """Ids of the targets' objects, sorted."""
        return sorted({target.obj_id for target in self.targets})

    @cached_property
    def image_ids(self) -> list[ImageId]:
        """Ids of the targets' images, sorted."""
        return sorted({(target.scene_id, target.im_id) for target in self.targets})

    # --- loaded once -------------------------------------------------------------------------------------------------

    @cached_property
    def models(self) -> LRUCache[int, ObjectModel]:
        """Meshes in memory, bounded so that memory does not grow with the number of objects."""
        return LRUCache(self.dataset.object_model, _mesh_bytes, MESHES_BYTES)

    def model(self, obj_id: int) -> ObjectModel:
        """Mesh and symmetries of an object."""
        return self.models(obj_id)

    def mesh_digest(self, obj_id: int) -> str:
        """Digest of an object's mesh file, used in keys so that the mesh need not be parsed."""
        if obj_id not in self._mesh_digests:
            self._mesh_digests[obj_id] = self.dataset.mesh_digest(obj_id)
        return self._mesh_digests[obj_id]

    @cached_property
    def timings(self) -> Timings:
        """Seconds per row measured on this machine."""
        return Timings(self.store.backend.folder, self.device)

    @cached_property
    def backbone(self) -> Backbone:
        """The extractor with its weights, loaded when the first feature is missing."""
        return self.load(self.stages.extract)

    def load(self, weights: Loadable[Loaded]) -> Loaded:
        """Load weights. Raises FileChanged if the files differ from those that keys were made from."""
        with unchanged_files():
            return weights.load(self.runtime)

    @cached_property
    def device(self) -> str:
        """Torch's name of the device for tensors."""
        return self.runtime.torch_device()

    def K(self, image: ImageId) -> Float[np.ndarray, "3 3"]:
        """Camera matrix of an image, px."""
        return self.dataset.K(*image)

    def tensor(self, values: np.ndarray) -> torch.Tensor:
        """Copy an array to the device."""
        return torch.from_numpy(np.ascontiguousarray(values)).to(self.device)

    def with_images(self, dataset: Dataset, store: Store, detect: Detector | None = None) -> Context:
        """A context for other images of the same objects, which shares loaded weights and meshes.

        ``detect`` replaces the detector.
        """
        stages = self.stages if detect is None else replace(self.stages, detect=detect)
        other = replace(
            self, stages=stages, dataset=dataset, targets=dataset.targets, store=store, progress=Progress(False)
        )
        vars(other).update({name: getattr(self, name) for name in ("backbone", "models", "device")})
        other._mesh_digests.update(self._mesh_digests)
        return other

    # --- tasks -------------------------------------------------------------------------------------------------------

    @one_thread_per_kernel()
    def run_task(self, task: Task[Item], items: Sequence[Item], advance: Advance) -> None:
        """Run a task for every item, in this process or in workers. Complete items are never sent to a worker."""
        workers = self.workers
        remote = [] if workers is None else [item for item in items if not task.done(item)]
        for item in set(items).difference(remote) if remote else items:
            task.do(item, advance)
        if workers is None or not remote:
            return
        for item, counts in workers.map(task.name, remote):
            self.progress.merge(counts)
            if not task.done(item):
                found = f"{task.name} of {item} reported done by a worker, but missing in {self.store.place}"
                raise BadInput("runtime", found=found, needed="workers that share the run's files and store")
            advance(task.size(item))

    # --- entries of one kind -----------------------------------------------------------------------------------------

    def features(self, layer: int, inputs: Mapping[str, str]) -> Ref:
        """Entry of one layer's features of some crops, with a readable path."""
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

    @one_thread_per_kernel()
    def fill(
        self,
        step: str,
        title: str,
        refs: Mapping[Ref, Mapping[str, Layout]],
        rows: int,
        batch: int,
        compute: Callable[[list[int]], Any],
        document: Mapping[str, Any] | None = None,
        timing: str = "",
    ) -> None:
        """Compute the missing rows of entries and count them under ``step``.

        ``title`` is the text of a progress bar, "" for none. ``timing`` is the key under which the seconds per row
        are saved for plans, "" to save none.
        """
        if all(self.store.is_complete(ref) for ref in refs):
            self.progress.add(step, reused=rows)
            return
        with self.progress.bar(rows, title, "row") as advance:
            filled = self.store.fill(refs, rows=rows, batch=batch, compute=compute, document=document, advance=advance)
        self.progress.add(step, computed=filled.computed, reused=filled.reused, time_s=filled.time_s)
        if timing and filled.computed:
            self.timings.add(timing, filled.computed, filled.time_s)

    def extract(
        self, step: str, title: str, refs: Mapping[int, Ref], rows: int, crops: Callable[[list[int]], Crops]
    ) -> None:
        """Extract the layers that are missing, all of them in one pass. ``crops`` reads the crops of some rows."""
        missing = {layer: ref for layer, ref in refs.items() if not self.store.is_complete(ref)}
        if not missing:
            self.progress.add(step, reused=rows)
            return

        def compute(batch: list[int]) -> dict[str, dict[str, np.ndarray]]:
            maps = self.maps(crops(batch), tuple(missing))
            return {ref.key: {"maps": maps[layer]} for layer, ref in missing.items()}

        layouts = {ref: self.features_layout(layer) for layer, ref in missing.items()}
        batch = self.backbone.passes.batch  # load the weights now, so that they do not count as time of a row
        timing = timing_key("features", self.stages, list(missing))
        self.fill(step, title, layouts, rows, batch, compute, timing=timing)

    def maps(self, crops: Crops, layers: Sequence[int]) -> dict[int, np.ndarray]:
        """Feature maps of crops by layer, float16 on the CPU, as they are stored."""
        maps = self.backbone(crops, layers)
        return {layer: to_half(maps[layer], f"layer {layer}: features") for layer in layers}


def stack_crops(crops: Sequence[Crop]) -> dict[str, np.ndarray]:
    """Rows of a crops entry, one per crop."""
    return {name: np.stack([getattr(crop, name) for crop in crops]) for name in ("rgb", "mask", "A_crop_img")}


def _mesh_bytes(model: ObjectModel) -> int:
    mesh = model.mesh
    arrays = (mesh.vertices, mesh.faces, mesh.colours, mesh.uv, mesh.texture)
    return sum(array.nbytes for array in arrays if array is not None)


def to_half(maps: torch.Tensor, what: str) -> np.ndarray:
    """Convert to float16 on the CPU. Raises DzopError on overflow, since infinite features lead to wrong poses."""
    half = maps.half()
    if not torch.isfinite(half).all():
        needed = "try extract.dtype=float32 or another layer"
        raise DzopError(f"{what} are not finite in float16; {needed}")
    return half.cpu().numpy()
