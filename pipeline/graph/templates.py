"""mesh -> templates -> crops -> features -> fits, once per object; and the bank read back from the entries."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, cached_property, lru_cache, partial
from typing import Any

import numpy as np
import torch

from pipeline.errors import DzopError
from pipeline.fits import chain, foreground_cells
from pipeline.functional.camera import crop_camera, resize_affine
from pipeline.functional.resample import resample
from pipeline.functional.rigid import rigid
from pipeline.graph.bank import Matrix, Pose, StoredBank
from pipeline.graph.context import Context, stack_crops, to_half
from pipeline.graph.extents import ExtentNodes
from pipeline.graph.tasks import Advance, Task
from pipeline.graph.timings import timing_key
from pipeline.items.features import CropFeatures, FittedArrays, TemplateCells
from pipeline.items.fit import Fit
from pipeline.items.objects import MeshFacts
from pipeline.items.online import LazyView, TemplateView
from pipeline.items.views import Crops, Geometry, Templates
from pipeline.parallel import ordered_map
from pipeline.stages.crop import HALF
from pipeline.stages.fuse import EncodedMap, coarsen
from pipeline.store import Entry, Layout, Ref, make_ref

VIEWS_PER_BATCH = 8
CROPS_PER_BATCH = 50
RERENDER_SCALE = 2  # side of a rerendered view relative to its crop


@dataclass(eq=False)
class TemplateNodes:
    """Nodes of objects. Methods named by a noun return references to entries; ``make_*`` compute missing entries.

    ``views``: number of full template views that a bank keeps in memory. ``banks``: number of objects whose templates
    are kept in memory.
    """

    context: Context
    views: int = 64
    banks: int = 1

    @cached_property
    def extents(self) -> ExtentNodes:
        """Extents of the objects, with their symmetries."""
        return ExtentNodes(self.context)

    @cached_property
    def templates(self) -> Callable[[int], Ref]:
        """Rendered views of an object."""
        return lru_cache(maxsize=None)(self._templates)

    def _templates(self, obj_id: int) -> Ref:
        recipe = {"kind": "templates", "render": self.context.stages.render.recipe()}
        return make_ref("templates", recipe, {"mesh": self.context.mesh_digest(obj_id)})

    @cached_property
    def mesh_facts(self) -> Callable[[int], MeshFacts]:
        """Warnings about an object's mesh: stored with the templates, else determined from the mesh."""
        return lru_cache(maxsize=None)(self._mesh_facts)

    def _mesh_facts(self, obj_id: int) -> MeshFacts:
        ref = self.templates(obj_id)
        if self.context.store.is_complete(ref):
            stored = self.context.store.read(ref).document.get("mesh")  # missing in entries of older versions
            if stored is not None:
                return MeshFacts(**(stored | {"warnings": tuple(stored["warnings"])}))
        return self.context.model(obj_id).facts

    def crops(self, obj_id: int) -> Ref:
        """Their crops."""
        recipe = {"kind": "template crops", "crop": self.context.stages.crop.recipe()}
        return make_ref("crops", recipe, {"templates": self.templates(obj_id).key})

    def features(self, obj_id: int, layer: int) -> Ref:
        """Their features of one layer."""
        return self.context.features(layer, {"crops": self.crops(obj_id).key})

    def make_templates(self, obj_id: int) -> int:
        """Render an object's missing templates; returns the number of templates."""
        ref = self.templates(obj_id)
        if self.context.store.is_complete(ref):
            rows = self.context.store.read(ref).rows
            self.context.progress.add("templates", reused=rows)
            return rows
        K, T_cam_obj, (height, width) = self.context.stages.render.cameras(self.context.model(obj_id).mesh)
        count = len(T_cam_obj)

        def compute(rows: list[int]) -> dict[str, dict[str, np.ndarray]]:
            rgb, depth_mm = self.context.stages.render.render(
                self.context.model(obj_id).mesh, K, T_cam_obj[rows], (height, width)
            )
            empty = np.flatnonzero(~(depth_mm > 0).any((1, 2)))
            if len(empty):
                raise DzopError(f"object {obj_id}: view {rows[empty[0]]} shows nothing; is the mesh closed and in mm?")
            return {ref.key: {"rgb": rgb, "depth_mm": depth_mm, "T_cam_obj": T_cam_obj[rows]}}

        layout = {
            "rgb": Layout((height, width, 3), "uint8", compress=True),
            "depth_mm": Layout((height, width), "float32", compress=True),
            "T_cam_obj": Layout((4, 4), "float64"),
        }
        document = {"K": K.tolist(), "mesh": asdict(self.context.model(obj_id).facts)}
        self.context.fill(
            "templates", f"render object {obj_id}", {ref: layout}, count, VIEWS_PER_BATCH, compute, document,
            timing=timing_key("templates", self.context.stages),
        )  # fmt: skip
        return count

    def read_views(self, obj_id: int, rows: Sequence[int] | None = None) -> Templates:
        """An object's templates, or some of them."""
        entry = self.context.store.read(self.templates(obj_id))
        depth_mm = entry.array("depth_mm", rows)
        K = np.array(entry.document["K"])
        return Templates(entry.array("rgb", rows), depth_mm, depth_mm > 0, K, entry.array("T_cam_obj", rows))

    def make_crops(self, obj_id: int, count: int) -> None:
        """Crop an object's templates if that is missing."""
        ref = self.crops(obj_id)

        def compute(rows: list[int]) -> dict[str, dict[str, np.ndarray]]:
            views = self.read_views(obj_id, rows)
            h, w = views.mask.shape[1:]
            whole = (-0.5, -0.5, w - 0.5, h - 0.5)
            crop = self.context.stages.crop
            crops = [crop(rgb, mask, whole, views.K) for rgb, mask in zip(views.rgb, views.mask, strict=True)]
            return {ref.key: stack_crops([replace(c, mask=crop.clean_template(c.mask)) for c in crops])}

        self.context.fill(
            "template crops", f"crop object {obj_id}", {ref: self.context.crops_layout()}, count, CROPS_PER_BATCH,
            compute, timing=timing_key("template crops", self.context.stages),
        )  # fmt: skip

    def make_features(self, obj_id: int, count: int, layers: Sequence[int]) -> None:
        """Extract an object's missing template features."""
        refs = {layer: self.features(obj_id, layer) for layer in layers}
        self.context.extract(
            "template features", f"features of object {obj_id}", refs, count, lambda rows: self._crops_of(obj_id, rows)
        )

    def _crops_of(self, obj_id: int, rows: Sequence[int]) -> Crops:
        entry = self.context.store.read(self.crops(obj_id))
        geometry = None
        if self.context.stages.extract.needs_geometry:
            views = self.read_views(obj_id, rows)
            geometry = Geometry(list(views.depth_mm), np.repeat(views.K[None], len(rows), 0), views.T_cam_obj)
        return Crops(entry.array("rgb", rows), entry.array("mask", rows), entry.array("A_crop_img", rows), geometry)

    def fitted(self, obj_id: int, fit: Fit) -> Ref:
        """Arrays of a fit to an object's template features."""
        inputs = {"features": self.features(obj_id, fit.layer).key}
        if fit.base is not None:
            inputs["base"] = self.fitted(obj_id, fit.base).key
        return make_ref("fitted", {"kind": "fitted", "fit": fit.recipe()}, inputs)

    def make_fitted(self, obj_id: int) -> None:
        """Compute an object's missing fits, each after the one it is based on."""
        cells, began = lru_cache(maxsize=1)(lambda layer: self._cells(obj_id, layer)), time.perf_counter()
        missing = [
            fit for fit in self.context.stages.fits if not self.context.store.is_complete(self.fitted(obj_id, fit))
        ]
        for fit in self.context.stages.fits:
            ref, start = self.fitted(obj_id, fit), time.perf_counter()
            if self.context.store.is_complete(ref):
                self.context.progress.add("fits", reused=1)
                continue
            base = {} if fit.base is None else self.read_fitted(obj_id, fit.base, device="cpu")
            arrays = {name: array.numpy() for name, array in fit(cells(fit.layer), base).items()}
            self.context.progress.add("fits", time_s=time.perf_counter() - start)
            self._keep(ref, arrays)
        if missing and len(missing) == len(self.context.stages.fits):
            self.context.timings.add(timing_key("fits", self.context.stages), 1, time.perf_counter() - began)

    def _keep(self, ref: Ref, arrays: dict[str, np.ndarray]) -> None:
        """Store arrays of any shapes as an entry of one row."""

        def compute(rows: list[int]) -> dict[str, dict[str, np.ndarray]]:
            return {ref.key: {name: array[None] for name, array in arrays.items()}}

        layouts = {name: Layout(array.shape, array.dtype.name) for name, array in arrays.items()}
        self.context.fill("fits", "", {ref: layouts}, 1, 1, compute)

    def read_fitted(self, obj_id: int, fit: Fit, *, device: str) -> FittedArrays:
        """Arrays of a fit and of its bases."""
        arrays: dict[str, torch.Tensor] = {}
        for part in chain(fit):
            entry = self.context.store.read(self.fitted(obj_id, part))
            arrays |= {name: torch.from_numpy(entry.array(name)[0]).to(device) for name in entry.arrays}
        return arrays

    def encodings(self, obj_id: int) -> Ref | None:
        """An object's templates as the first look compares them; None where they are not stored."""
        stages = self.context.stages
        if stages.encoding_shape is None:
            return None
        recipe = {"kind": "encodings", "fuse": stages.fuse.recipe(), "block": stages.second_look.block}
        inputs = {f"layer {layer}": self.features(obj_id, layer).key for layer in stages.fuse.layers}
        inputs |= {"crops": self.crops(obj_id).key}
        if stages.fuse.fit is not None:
            inputs["fit"] = self.fitted(obj_id, stages.fuse.fit).key
        return make_ref("encodings", recipe, inputs)

    def encodings_layout(self) -> dict[str, Layout]:
        """Arrays of an encodings entry: the map, channels last, and the mask of its foreground as one more channel."""
        assert self.context.stages.encoding_shape is not None
        d, h, w = self.context.stages.encoding_shape
        return {"maps": Layout((h, w, d + 1), "float16")}

    def make_encodings(self, obj_id: int, count: int) -> None:
        """Encode an object's templates for the first look if that is missing."""
        ref, stages = self.encodings(obj_id), self.context.stages
        if ref is None:
            return
        fuse, block = stages.fuse, stages.second_look.block

        @cache
        def inputs() -> tuple[dict[int, Entry], Entry, FittedArrays]:
            fitted = {} if fuse.fit is None else self.read_fitted(obj_id, fuse.fit, device=self.context.device)
            features, crops, _ = self._open(obj_id)
            return {layer: features[layer] for layer in fuse.layers}, crops, fitted

        def encode(crop: CropFeatures) -> np.ndarray:
            encoded = coarsen(fuse.encode(crop, inputs()[2]), block=block)
            maps = torch.cat([encoded.features, encoded.mask[None]]).movedim(0, -1).contiguous()
            return to_half(maps, "encodings of templates")

        def compute(rows: list[int]) -> dict[str, dict[str, np.ndarray]]:
            features, crops, _ = inputs()
            maps = {layer: self.context.tensor(entry.array("maps", rows)) for layer, entry in features.items()}
            masks = self.context.tensor(crops.array("mask", rows))
            each = [CropFeatures({layer: m[k] for layer, m in maps.items()}, mask) for k, mask in enumerate(masks)]
            return {ref.key: {"maps": np.stack(list(ordered_map(encode, each)))}}

        timing = timing_key("template encodings", stages)
        layouts = {ref: self.encodings_layout()}
        self.context.fill(
            "template encodings", f"encode object {obj_id}", layouts, count, VIEWS_PER_BATCH, compute, timing=timing
        )

    def _cells(self, obj_id: int, layer: int) -> TemplateCells:
        """Features of the foreground cells of an object's templates, float16; maps are read in batches."""
        maps, crops = self.context.store.read(self.features(obj_id, layer)), self.context.store.read(self.crops(obj_id))
        features, template = [], []
        for first in range(0, crops.rows, CROPS_PER_BATCH):
            rows = range(first, min(first + CROPS_PER_BATCH, crops.rows))
            part = foreground_cells(*(torch.from_numpy(e.array(n, rows)) for e, n in ((maps, "maps"), (crops, "mask"))))
            features.append(part.features)
            template.append(part.template + first)
        return TemplateCells(torch.cat(features), torch.cat(template), crops.rows)

    @cached_property
    def onboard_task(self) -> Task[int]:
        """The offline steps, by object."""
        return Task("onboarding", self._onboard, self._is_onboarded)

    def _is_onboarded(self, obj_id: int) -> bool:
        refs = [self.templates(obj_id), self.crops(obj_id)]
        refs += [self.features(obj_id, layer) for layer in self.context.stages.layers]
        refs += [self.fitted(obj_id, fit) for fit in self.context.stages.fits]
        refs += [ref for ref in (self.encodings(obj_id), self.extents.ref(obj_id)) if ref is not None]
        return all(map(self.context.store.is_complete, refs))

    def _onboard(self, obj_id: int, advance: Advance) -> None:
        count = self.make_templates(obj_id)
        self.extents.make(obj_id)
        self.context.models.discard(obj_id)  # also frees the renderer's data, three times the size of the mesh
        self.make_crops(obj_id, count)
        self.make_features(obj_id, count, self.context.stages.layers)
        self.make_fitted(obj_id)
        self.make_encodings(obj_id, count)
        advance(1)

    def feature_bytes(self) -> int:
        """Bytes of the stored features of all objects."""
        refs = [
            self.features(obj_id, layer) for obj_id in self.context.object_ids for layer in self.context.stages.layers
        ]
        return sum(self.context.store.size(ref) or 0 for ref in refs)

    @cached_property
    def bank(self) -> Callable[[int], StoredBank]:
        """An object's templates for the online route; those of the last ``banks`` objects stay in memory."""
        return lru_cache(maxsize=self.banks)(self._bank)

    def _bank(self, obj_id: int) -> StoredBank:
        features, crops, templates = self._open(obj_id)
        encodings = self.encodings(obj_id)
        encoded = None if encodings is None else self.context.store.read(encodings)
        K = np.array(templates.document["K"])

        @lru_cache(maxsize=self.views)
        def view(index: int) -> TemplateView:
            read = self._readers(features, crops, templates, index)
            if encoded is not None:
                read["encoding"] = partial(self._read_encoding, encoded, index)
            return LazyView(K, read)

        @lru_cache(maxsize=4)
        def fitted(fit: Fit) -> FittedArrays:
            return self.read_fitted(obj_id, fit, device=self.context.device)

        @cache
        def maps(layer: int) -> torch.Tensor:
            return self.context.tensor(features[layer].array("maps"))

        return StoredBank(
            layer=self.context.stages.match.layer,
            maps=maps,
            masks=lambda: self.context.tensor(crops.array("mask")),
            view=view,
            render=partial(self._render_view, obj_id),
            poses=lambda: templates.array("T_cam_obj"),
            fitted=fitted,
        )

    def _open(self, obj_id: int) -> tuple[dict[int, Entry], Entry, Entry]:
        """Entries of an object: features by layer, crops and templates."""
        read = self.context.store.read
        features = {layer: read(self.features(obj_id, layer)) for layer in self.context.stages.layers}
        return features, read(self.crops(obj_id)), read(self.templates(obj_id))

    def _readers(
        self, features: Mapping[int, Entry], crops: Entry, templates: Entry, index: int
    ) -> dict[str, Callable[[], Any]]:
        """A reader for each field of a template."""

        def read_crop() -> CropFeatures:
            maps = {layer: self.context.tensor(entry.array("maps", [index])[0]) for layer, entry in features.items()}
            return CropFeatures(maps, self.context.tensor(crops.array("mask", [index])[0]))

        return {
            "crop": read_crop,
            "A_crop_img": lambda: crops.array("A_crop_img", [index])[0],
            "depth_mm": lambda: templates.array("depth_mm", [index])[0],
            "T_cam_obj": lambda: templates.array("T_cam_obj", [index])[0],
        }

    def _read_encoding(self, encodings: Entry, index: int) -> EncodedMap:
        maps = self.context.tensor(encodings.array("maps", [index])[0])
        return EncodedMap(maps[..., :-1].float().movedim(-1, 0), maps[..., -1] > 0)

    def _render_view(self, obj_id: int, T_cam_obj: Pose, A_crop_img: Matrix, K: Matrix) -> TemplateView:
        """Render the object in a pose as the query's crop would show it: at twice the size, then resampled."""
        stages, size = self.context.stages, self.context.stages.crop.size
        K_crop, R_crop_cam = crop_camera(A_crop_img, K)
        A_drawn_crop = resize_affine(float(RERENDER_SCALE))
        K_drawn, T_drawn_obj = A_drawn_crop @ K_crop, rigid(R_crop_cam, np.zeros(3)) @ T_cam_obj
        size_hw = (RERENDER_SCALE * size,) * 2
        rgb, depth_mm = stages.render.render(self.context.model(obj_id).mesh, K_drawn, T_drawn_obj[None], size_hw)
        A_crop_drawn = np.linalg.inv(A_drawn_crop)
        crop = np.rint(resample(rgb[0], A_crop_drawn, size=size)).clip(0, 255).astype(np.uint8)
        mask = stages.crop.clean_template(resample(depth_mm[0] > 0, A_crop_drawn, size=size) >= HALF)
        geometry = Geometry([depth_mm[0]], K_drawn[None], T_drawn_obj[None])
        crops = Crops(crop[None], mask[None], A_crop_drawn[None], geometry)
        features = {
            layer: self.context.tensor(maps[0]) for layer, maps in self.context.maps(crops, stages.layers).items()
        }
        return TemplateView(
            CropFeatures(features, self.context.tensor(mask)), A_crop_drawn, depth_mm[0], K_drawn, T_drawn_obj, rgb=crop
        )
