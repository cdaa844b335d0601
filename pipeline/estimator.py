"""The Python API: onboard meshes once, then estimate poses from images in memory.

from pipeline import PoseEstimator

estimator = PoseEstimator.from_mesh("mug.ply")
result = estimator(rgb, K, mask=mask)
result = estimator(rgb, K)  # slower: finds the object in the image first
"""

from __future__ import annotations

import weakref
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from os import PathLike
from pathlib import Path
from threading import RLock
from types import TracebackType
from typing import Any

import numpy as np

from pipeline.bop.frame import Frame, parse_depth, parse_image, parse_locations, parse_prior
from pipeline.bop.given import MeshFiles, check_own_camera, parse_K
from pipeline.confidence.calibration import choose_calibration
from pipeline.configuration import build_options, build_stages, build_variant, compose_settings
from pipeline.errors import BadInput
from pipeline.functional.camera import project
from pipeline.functional.rigid import transform
from pipeline.graph import Context, Graph
from pipeline.io.digests import DigestCache, track_files
from pipeline.items.views import Target
from pipeline.outputs.pose_result import PoseResult, result_of
from pipeline.parallel import use_threads
from pipeline.progress import Progress
from pipeline.stages.detect.search import Search
from pipeline.store import MemoryStoreConfig, Store

Mesh = str | PathLike[str]
SCENE_ID, IM_ID = 0, 0
MARGIN = 0.15  # by which the box around a prior is larger than the object, so that it may have moved
MAX_BANKS = 8  # most objects whose templates stay in memory
PLACEHOLDERS = ("dataset=photo", "dataset.mesh=mesh", "dataset.image=image", "dataset.K=[1,1,1,1]")


class PoseEstimator:
    """Estimates poses of one or several objects, whose templates are rendered once and cached.

    It shares cached templates with ``dzop dataset=photo`` and returns identical poses. Thread-safe: concurrent calls
    run one after the other. Also a context manager; ``close`` frees the memory. Invalid input raises
    ``pipeline.DzopError``, whose message is one line: where the problem is, what was found, what is needed.
    """

    def __init__(self, meshes: Mapping[str, Mesh], *, settings: Sequence[str] = (), cache: Mesh | None = None) -> None:
        """As ``from_mesh`` with several meshes."""
        if not meshes:
            raise BadInput("meshes", found="none", needed="at least one mesh")
        self.names = tuple(meshes)
        self._lock, self._open = RLock(), ExitStack()
        with self._open as opening:
            self._graph = self._onboard([Path(path).expanduser() for path in meshes.values()], settings, cache)
            self._open = opening.pop_all()
        weakref.finalize(self, self._open.close)  # at exit, too, while the threads that renew leases still run

    @classmethod
    def from_mesh(
        cls, mesh: Mesh | Mapping[str, Mesh], *, settings: Sequence[str] = (), cache: Mesh | None = None
    ) -> PoseEstimator:
        """An estimator for one mesh file in millimetres, or for several by name. Renders templates that are not cached.

        ``settings``: as on the command line, such as ``["method=zs6d", "dataset.scale=1000"]``. ``cache``: folder
        that stores the templates; by default ``cache`` in the current folder. Raises DzopError.
        """
        meshes = mesh if isinstance(mesh, Mapping) else {Path(mesh).stem: mesh}
        return cls(meshes, settings=settings, cache=cache)

    def __call__(
        self,
        rgb: np.ndarray,
        K: Any,
        *,
        mask: np.ndarray | None = None,
        bbox: Sequence[float] | None = None,
        name: str | None = None,
        depth_mm: np.ndarray | None = None,
        prior: PoseResult | np.ndarray | None = None,
    ) -> PoseResult:
        """The pose of one object in an image.

        ``rgb``: h x w x 3, uint8. ``K``: 3 x 3, or fx, fy, cx, cy, in pixels of this image. ``mask``: h x w, 0 outside
        the object, or ``bbox``: x, y, width, height; with neither, the object is searched for in the whole image, as by
        ``detect=search``. ``name``: the object, if the estimator has several. ``depth_mm``: h x w, registered to the
        image, 0 where unknown; the pose is fitted to it. ``prior``: the result of the frame before, or its T_cam_obj
        (4 x 4, mm). It is followed if the image confirms it, which is faster; otherwise all templates are searched.
        With a prior and neither mask nor bbox, the object is sought in the box around the prior.
        """
        if mask is not None and bbox is not None:
            raise BadInput("mask, bbox", found="both", needed="one of them, or neither to search for the object")
        if name is None and len(self.names) > 1:
            raise BadInput("name", found="nothing", needed=f"one of {', '.join(self.names)}")
        asked, rgb = self.names[0] if name is None else name, parse_image(rgb)
        if mask is None and bbox is None and (T_cam_obj := _prior_pose(prior)) is not None:
            bbox = self._box_around(asked, T_cam_obj, K, (rgb.shape[0], rgb.shape[1]))
        given = bbox if mask is None else np.asarray(mask)  # None where there is neither
        return self.find(rgb, K, {asked: given}, depth_mm=depth_mm, priors={asked: [prior]})[0]

    def find(
        self,
        rgb: np.ndarray,
        K: Any,
        locations: Mapping[str, Any],
        *,
        depth_mm: np.ndarray | None = None,
        priors: Mapping[str, Sequence[PoseResult | np.ndarray | None]] | None = None,
    ) -> tuple[PoseResult, ...]:
        """The poses of several objects or instances in one image, in the order of ``locations``.

        ``locations``: object name -> mask, box [x, y, width, height], or a list of these for several instances; None
        for all of them to search for each object in the whole image. ``depth_mm``: as in ``__call__``. ``priors``:
        object name -> one prior per instance, as in ``__call__``.
        """
        frame = self._frame(parse_image(rgb), K, locations)
        if priors is not None:
            frame = replace(frame, priors=self._priors(priors))
        if depth_mm is not None:
            frame = replace(frame, depth=parse_depth(depth_mm, (frame.rgb.shape[0], frame.rgb.shape[1])))
        with self._lock:
            return self._estimate(frame, list(locations))

    def close(self) -> None:
        """Free the templates and the model. The cache on disk is kept; the estimator cannot be used afterwards."""
        with self._lock:
            self._open.close()
            del self._graph

    def __enter__(self) -> PoseEstimator:
        """The estimator."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Close the estimator."""
        self.close()

    def _onboard(self, paths: Sequence[Path], settings: Sequence[str], cache: Mesh | None) -> Graph:
        """The graph of the meshes, with all templates onboarded."""
        values = compose_settings([*PLACEHOLDERS, *settings])
        if cache is not None:
            values["store"]["root"] = str(cache)
        options, runtime = build_options(values), build_variant(values["runtime"], "runtime")
        use_threads(options.threads)
        store = Store(build_variant(values["store"], "store"))
        folder = store.backend.folder
        with track_files(None if folder is None else DigestCache(folder / ".digests")):
            stages, photo = build_stages(values), build_variant(values["dataset"], "dataset")
            meshes = MeshFiles(tuple(paths), photo.scale, photo.simplify, self.names, photo.units)
            dataset = _make_frame(meshes, tuple(Target(SCENE_ID, IM_ID, n + 1) for n in range(len(paths))))
            calibration = choose_calibration(stages, options.confidence)
            progress = Progress(runtime.progress)
            context = Context(stages, dataset, dataset.targets, store, runtime, progress, calibration=calibration)
            self._open.enter_context(store.in_use())
            graph = Graph(context)
            graph.templates.banks = min(len(paths), MAX_BANKS)
            graph.check()
            graph.limit_vram()
            graph.onboard()
            _ = context.backbone, [graph.templates.extents.read(obj_id) for obj_id in context.object_ids]
        return graph

    def _check_names(self, names: Sequence[str]) -> None:
        unknown = [name for name in names if name not in self.names]
        if unknown or not names:
            found = repr(unknown[0]) if unknown else "no object"
            raise BadInput("name", found=found, needed=f"one of {', '.join(self.names)}")

    def _frame(self, rgb: np.ndarray, K: Any, locations: Mapping[str, Any]) -> Frame:
        self._check_names(list(locations))
        size_hw = (rgb.shape[0], rgb.shape[1])
        camera_matrix = _parse_camera(K, size_hw)
        if len({given is None for given in locations.values()}) > 1:
            needed = "all of them, or none, to search for every object"
            raise BadInput("locations", found="some without mask or box", needed=needed)
        located = {
            self.names.index(name) + 1: () if given is None else parse_locations(given, size_hw)
            for name, given in locations.items()
        }
        targets = tuple(Target(SCENE_ID, IM_ID, obj_id, max(1, len(at))) for obj_id, at in sorted(located.items()))
        dataset = self._graph.context.dataset
        assert isinstance(dataset, Frame)
        return replace(dataset, targets=targets, rgb=rgb, camera_matrix=camera_matrix, locations=located)

    def _priors(self, given: Mapping[str, Sequence[Any]]) -> dict[int, list[np.ndarray | None]]:
        self._check_names(list(given))
        priors = {self.names.index(name) + 1: [_prior_pose(one) for one in ones] for name, ones in given.items()}
        has_prior = any(T_cam_obj is not None for ones in priors.values() for T_cam_obj in ones)
        if has_prior and not self._graph.context.stages.second_look.hypotheses:
            needed = "method=dzop_x or second_look=drawn, which render the object in a pose"
            raise BadInput("prior", found="with second_look=none", needed=needed)
        return priors

    def _box_around(self, name: str, T_cam_obj: np.ndarray, K: Any, size_hw: tuple[int, int]) -> list[float]:
        """The box [x, y, width, height] around an object in its expected pose, grown by MARGIN of its longer side."""
        self._check_names([name])
        camera_matrix, (h, w) = _parse_camera(K, size_hw), size_hw
        points_obj = self._graph.templates.extents.read(self.names.index(name) + 1).points
        px = project(camera_matrix, transform(T_cam_obj, points_obj))
        low, high = px.min(axis=0), px.max(axis=0)
        grown = MARGIN * float((high - low).max())
        low, high = np.maximum(low - grown, 0), np.minimum(high + grown, (w, h))
        if (high <= low).any():
            raise BadInput("prior", found="a pose outside the image", needed="mask or bbox, or no prior")
        return [*low.tolist(), *(high - low).tolist()]

    def _estimate(self, frame: Frame, names: Sequence[str]) -> tuple[PoseResult, ...]:
        detect = None if any(frame.locations.values()) else Search()
        context = self._graph.context.with_images(frame, Store(MemoryStoreConfig()), detect)
        graph = Graph(context, self._graph.templates)
        if graph.detections.searches:
            graph.detections.searches.check()
        warnings, image = graph.warnings(), frame.image(SCENE_ID, IM_ID)
        results: dict[str, list[PoseResult]] = {name: [] for name in names}
        for answer in graph.poses.estimate():
            name, model = self.names[answer.obj_id - 1], context.model(answer.obj_id)
            mesh = str(frame.model_path(answer.obj_id))
            results[name].append(result_of(answer, name, mesh=mesh, image=image, model=model, warnings=warnings))
        return tuple(result for name in names for result in results[name])


def _make_frame(meshes: MeshFiles, targets: tuple[Target, ...]) -> Frame:
    return Frame("frame", Path(), "test", "", {}, targets, meshes=meshes, simplify=meshes.simplify)


def _parse_camera(K: Any, size_hw: tuple[int, int]) -> np.ndarray:
    """The camera matrix (3 3), px. Raises BadInput."""
    try:
        numbers = np.asarray(K, dtype=np.float64)
    except (TypeError, ValueError):
        raise BadInput("K", found=repr(K)[:60], needed="[fx,fy,cx,cy] or a 3 x 3 matrix") from None
    camera_matrix = parse_K(np.atleast_1d(numbers).tolist(), "K")
    check_own_camera(camera_matrix, size_hw, "K")
    return camera_matrix


def _prior_pose(given: Any) -> np.ndarray | None:
    """T_cam_obj (4 4), mm, of a result or a matrix; None for a result without a pose, or one to reject."""
    if isinstance(given, PoseResult):
        given = None if given.decision == "reject" else given.T_cam_obj
    return None if given is None else parse_prior(given)
