"""poses, annotated dataset -> errors of every estimate and the instances found, exactly as BOP scores localisation.

Of every target the ``inst_count`` best-scored estimates count; of its annotated instances the ``inst_count`` most
visible. Estimates of anything that is not a target are left out.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from jaxtyping import Bool, Float, Float32

from pipeline.bop.dataset import Dataset
from pipeline.bop.results import ResultRow
from pipeline.bop.scene import GroundTruth
from pipeline.errors import BadInput
from pipeline.functional.rigid import rotation_angle_deg
from pipeline.items.objects import Mesh, ObjectModel
from pipeline.items.scores import DatasetId, PoseErrors, Scores
from pipeline.items.views import Target
from pipeline.metrics.matching import match_instances, select_best_scored
from pipeline.metrics.pose_error import (
    add,
    adi,
    hull_vertices,
    mspd,
    mssd,
    rotation_error_deg,
    translation_error_mm,
)
from pipeline.metrics.recall import MSPD_PX, TAUS, THETAS
from pipeline.metrics.vsd import vsd
from pipeline.spec import digest
from pipeline.stages.render.raycast import render_depth

SCORES_VERSION = 1
MSPD_WIDTH_PX = 640
PROBES = 128  # vertices that bound MSPD from below; more are slower where they add nothing
VSD_DELTA_MM = {"itodd": 5.0}
"""VSD's delta where BOP's is not 15 mm."""

ImageId = tuple[int, int]
Rows = list[tuple[int, ResultRow]]


@dataclass(frozen=True, eq=False)
class ScoringResult:
    """Errors of each estimate that counts against each instance of its object, and the instances found."""

    errors: tuple[PoseErrors, ...]
    scores: Scores
    models: str


@dataclass(frozen=True, eq=False)
class Scorer:
    """A dataset to score against. ``models``: folder of the meshes that errors are measured on."""

    dataset: Dataset
    targets: Sequence[Target]
    models: str
    vsd_delta_mm: float = 15.0
    with_vsd: bool = True

    @cached_property
    def no_vsd(self) -> str:
        """Why VSD is not available, "" when it is. A missing depth image must never read as an error of 1."""
        if not self.with_vsd:
            return "not asked for"
        missing = [image for image in self.images if not self._has_depth(image)]
        if not missing:
            return ""
        scene_id, im_id = missing[0]
        first = f"the first is scene {scene_id}, image {im_id}"
        return f"{len(missing)} of {len(self.images)} images have no depth image ({first})"

    @cached_property
    def images(self) -> list[ImageId]:
        """Images of the targets."""
        return sorted({(target.scene_id, target.im_id) for target in self.targets})

    @cached_property
    def shape(self) -> Callable[[int], Shape]:
        """An object as errors need it, read once."""
        return lru_cache(maxsize=None)(lambda obj_id: Shape(self.dataset.object_model(obj_id, folder=self.models)))

    def _has_depth(self, image: ImageId) -> bool:
        try:
            self.dataset.depth_path(*image)
        except BadInput:
            return False
        return True

    def score(
        self, rows: Sequence[ResultRow], *, progress: Callable[[int], None] = lambda images: None
    ) -> ScoringResult:
        """Errors and scores of ``rows``; ``PoseErrors.row`` is the index of an estimate in it."""
        estimates: defaultdict[tuple[int, int, int], list[int]] = defaultdict(list)
        for index, row in enumerate(rows):
            estimates[row.scene_id, row.im_id, row.obj_id].append(index)
        by_image: defaultdict[ImageId, list[Target]] = defaultdict(list)
        for target in self.targets:
            by_image[target.scene_id, target.im_id].append(target)
        found: list[tuple[Target, _Found]] = []
        for image in self.images:
            view = _View(self, image, None if self.no_vsd else self.dataset.depth_mm(*image))
            with np.errstate(over="ignore", divide="ignore", invalid="ignore"):  # poses may be anywhere
                found += [(target, self._find(view, target, rows, estimates)) for target in by_image[image]]
            progress(1)
        return ScoringResult(tuple(e for _, f in found for e in f.errors), self._scores(found), self.models)

    def _find(
        self,
        view: _View,
        target: Target,
        rows: Sequence[ResultRow],
        estimates: Mapping[tuple[int, int, int], list[int]],
    ) -> _Found:
        mine = estimates.get((target.scene_id, target.im_id, target.obj_id), [])
        best = [mine[i] for i in select_best_scored([rows[i].score for i in mine], target.inst_count)]
        return _find(view, self.truths(target), self.counted(target), [(index, rows[index]) for index in best])

    def truths(self, target: Target) -> list[GroundTruth]:
        """All annotated instances of a target's object in its image."""
        return [gt for gt in self.dataset.ground_truth(target.scene_id, target.im_id) if gt.obj_id == target.obj_id]

    def counted(self, target: Target) -> list[GroundTruth]:
        """Those that count."""
        where = f"{self.dataset.scene(target.scene_id).folder}, image {target.im_id}"
        return most_visible(self.truths(target), target, where)

    def _scores(self, found: Sequence[tuple[Target, _Found]]) -> Scores:
        ids = [(t.scene_id, t.im_id, t.obj_id, gt.gt_id) for t, f in found for gt in f.truths]
        visible = [np.nan if gt.visib_fract is None else gt.visib_fract for _, f in found for gt in f.truths]
        hits = [np.concatenate([getattr(f, name) for _, f in found]) for name in ("mssd", "mspd", "vsd")]
        scene_id, im_id, obj_id, gt_id = np.array(ids, dtype=np.int64).reshape(-1, 4).T
        surface = None if self.no_vsd else hits[2]
        return Scores(scene_id, im_id, obj_id, gt_id, np.array(visible, float), hits[0], hits[1], surface, self.no_vsd)


def truth_digest(scorer: Scorer) -> str:
    """Digest of the targets and of all that is annotated of them: scores of equal digests may be compared."""
    asked = [
        [t.scene_id, t.im_id, t.obj_id, t.inst_count, scorer.dataset.K(t.scene_id, t.im_id).tolist()]
        + [[gt.gt_id, gt.visib_fract, gt.T_cam_obj.tolist()] for gt in scorer.truths(t)]
        for t in scorer.targets
    ]
    return digest(asked)


def dataset_id(scorer: Scorer) -> DatasetId:
    """Which dataset and targets were scored."""
    data, objects = scorer.dataset, sorted({target.obj_id for target in scorer.targets})
    asked = sum(len(scorer.counted(target)) for target in scorer.targets)
    return DatasetId(data.name, data.split, truth_digest(scorer), asked, len(scorer.images), tuple(objects))


class Shape:
    """An object's mesh with the vertices that errors can be measured on."""

    def __init__(self, model: ObjectModel) -> None:
        self.vertices = model.mesh.vertices
        self.model = replace(model, mesh=Mesh(self.vertices, model.mesh.faces))  # of all objects at once: no textures
        self.hull = hull_vertices(self.vertices)
        self.probes = self.hull[np.linspace(0, len(self.hull) - 1, min(PROBES, len(self.hull))).astype(int)]


@dataclass(frozen=True, eq=False)
class _View:
    """One image as errors need it. ``depth_mm`` None: VSD is not computed."""

    scorer: Scorer
    image: ImageId
    depth_mm: Float32[np.ndarray, "H W"] | None

    @cached_property
    def K(self) -> Float[np.ndarray, "3 3"]:
        return self.scorer.dataset.K(*self.image)

    @cached_property
    def to_640(self) -> float:
        return MSPD_WIDTH_PX / self.scorer.dataset.image_width(*self.image)

    def drawn(self, obj_id: int, T_cam_obj: Float[np.ndarray, "4 4"]) -> Float32[np.ndarray, "H W"] | None:
        """Depth map of an object, where VSD is computed."""
        if self.depth_mm is None:
            return None
        return render_depth(self.scorer.shape(obj_id).model.mesh, self.K, T_cam_obj[None], self.depth_mm.shape)[0]


@dataclass(frozen=True, eq=False)
class _Found:
    """One target: the instances that count, the thresholds at which each was found, and all errors."""

    truths: list[GroundTruth]
    errors: list[PoseErrors]
    mssd: Bool[np.ndarray, "g 10"]
    mspd: Bool[np.ndarray, "g 10"]
    vsd: Bool[np.ndarray, "g 10 10"]


def _find(view: _View, truths: Sequence[GroundTruth], counted: list[GroundTruth], rows: Rows) -> _Found:
    """``truths``: all instances of the target's object; ``rows``: its estimates that count, best score first."""
    depths = [view.drawn(gt.obj_id, gt.T_cam_obj) if rows else None for gt in truths]
    errors = [
        pose_errors(view, index, row, gt, depth)
        for index, row in rows
        for gt, depth in zip(truths, depths, strict=True)
    ]
    of = {(e.row, e.gt_id): e for e in errors}
    table = [[of[index, gt.gt_id] for gt in counted] for index, _ in rows]
    shape = (len(rows), len(counted))
    relative = np.array([[e.mssd_mm / e.diameter_mm for e in line] for line in table]).reshape(shape)
    shift = np.array([[e.mspd_px for e in line] for line in table]).reshape(shape)
    surface = np.array([[e.vsd or np.ones(len(TAUS)) for e in line] for line in table]).reshape(*shape, len(TAUS))
    by_tau = [_hits(surface[..., tau], THETAS) for tau in range(len(TAUS))]
    return _Found(
        counted, errors, _hits(relative, THETAS), _hits(shift, MSPD_PX.astype(float)), np.stack(by_tau, axis=1)
    )


def pose_errors(
    view: _View, index: int, row: ResultRow, gt: GroundTruth, truth_depth: Float32[np.ndarray, "H W"] | None
) -> PoseErrors:
    """Every error of one estimate against one instance."""
    shape, T_est, T_gt = view.scorer.shape(row.obj_id), row.T_cam_obj, gt.T_cam_obj
    model = shape.model
    turned = T_gt[None, :3, :3] @ model.symmetries[:, :3, :3]
    angle = rotation_angle_deg(np.broadcast_to(T_est[:3, :3], turned.shape), turned).min()
    return PoseErrors(
        row=index,
        gt_id=gt.gt_id,
        diameter_mm=model.diameter_mm,
        vsd=_surface_errors(view, row, truth_depth),
        mssd_mm=mssd(T_est, T_gt, shape.hull, model.symmetries),
        mspd_px=view.to_640 * mspd(T_est, T_gt, view.K, shape.vertices, model.symmetries, shape.probes),
        add_mm=add(T_est, T_gt, shape.vertices),
        adi_mm=adi(T_est, T_gt, shape.vertices),
        rotation_deg=rotation_error_deg(T_est, T_gt),
        symmetric_rotation_deg=float(angle),
        translation_mm=translation_error_mm(T_est, T_gt),
    )


def _surface_errors(
    view: _View, row: ResultRow, truth_depth: Float32[np.ndarray, "H W"] | None
) -> tuple[float, ...] | None:
    seen = view.drawn(row.obj_id, row.T_cam_obj)
    if view.depth_mm is None or truth_depth is None or seen is None:
        return None
    diameter, delta = view.scorer.shape(row.obj_id).model.diameter_mm, view.scorer.vsd_delta_mm
    errors = vsd(seen, truth_depth, view.depth_mm, view.K, diameter_mm=diameter, delta_mm=delta, taus=TAUS)
    return tuple(errors.tolist())


def most_visible(truths: Sequence[GroundTruth], target: Target, where: str) -> list[GroundTruth]:
    """The instances that count: the ``inst_count`` most visible ones, as BOP takes them.

    Raises BadInput when there are more and scene_gt_info.json does not say how visible each is.
    """
    if len(truths) <= target.inst_count:
        return list(truths)
    if any(gt.visib_fract is None for gt in truths):
        found = f"{len(truths)} instances of object {target.obj_id} for a target of {target.inst_count}, no visib_fract"
        raise BadInput(where, found=found, needed="scene_gt_info.json, to take the most visible")
    chosen = sorted(truths, key=lambda gt: -float(gt.visib_fract or 0))[: target.inst_count]
    return sorted(chosen, key=lambda gt: gt.gt_id)


def _hits(errors: Float[np.ndarray, "e g"], thresholds: Float[np.ndarray, " k"]) -> Bool[np.ndarray, "g k"]:
    """Which instances are found at each threshold."""
    found = np.zeros((errors.shape[1], len(thresholds)), dtype=bool)
    for k, threshold in enumerate(thresholds):
        for _, gt in match_instances(errors, threshold):
            found[gt, k] = True
    return found
