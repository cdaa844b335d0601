"""Estimates of a whole dataset -> errors and scores."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float

from pipeline.bop.dataset import Dataset
from pipeline.bop.results import ResultRow
from pipeline.bop.scene import GroundTruth
from pipeline.errors import BadInput
from pipeline.items.errors import PoseErrors
from pipeline.items.scores import Scores
from pipeline.items.views import Target
from pipeline.metrics.matching import match_instances, select_best_scored
from pipeline.metrics.recall import MSPD_PX, TAUS, THETAS
from pipeline.scoring.pose_errors import ScoredImage, ScoringMesh, compute_pose_errors

SCORES_VERSION = 1
VSD_DELTA_MM = {"itodd": 5.0}
"""VSD's delta of the datasets for which BOP does not use 15 mm."""

ImageId = tuple[int, int]
IndexedRows = list[tuple[int, ResultRow]]
"""Estimates with their indices in the results file."""


@dataclass(frozen=True, eq=False)
class ScoringResult:
    """Errors of each scored estimate against each instance of its object, and the resulting scores."""

    errors: tuple[PoseErrors, ...]
    scores: Scores
    models: str


@dataclass(frozen=True, eq=False)
class TargetResult:
    """One target: the scored instances, the thresholds at which each was found, and all errors."""

    instances: list[GroundTruth]
    errors: list[PoseErrors]
    mssd: Bool[np.ndarray, "g 10"]
    mspd: Bool[np.ndarray, "g 10"]
    vsd: Bool[np.ndarray, "g 10 10"]


@dataclass(frozen=True, eq=False)
class Scorer:
    """Scores estimates on the targets of a dataset. ``models``: folder of the meshes that errors are measured on."""

    dataset: Dataset
    targets: Sequence[Target]
    models: str
    vsd_delta_mm: float = 15.0
    with_vsd: bool = True
    _meshes: dict[int, ScoringMesh] = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def no_vsd(self) -> str:
        """Why VSD is not computed; "" if it is.

        It is skipped for all targets if any lacks a depth image, which must not count as an error of 1. This text is
        part of the cache key of scores.
        """
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
        """Images of the targets, sorted."""
        return sorted({(target.scene_id, target.im_id) for target in self.targets})

    def mesh(self, obj_id: int) -> ScoringMesh:
        """The mesh that errors of an object are measured on; read once."""
        if obj_id not in self._meshes:
            self._meshes[obj_id] = ScoringMesh(self.dataset.object_model(obj_id, folder=self.models))
        return self._meshes[obj_id]

    def all_instances(self, target: Target) -> list[GroundTruth]:
        """All annotated instances of a target's object in its image."""
        return [gt for gt in self.dataset.ground_truth(target.scene_id, target.im_id) if gt.obj_id == target.obj_id]

    def scored_instances(self, target: Target) -> list[GroundTruth]:
        """The instances of a target that scores count."""
        where = f"{self.dataset.scene(target.scene_id).folder}, image {target.im_id}"
        return select_most_visible(self.all_instances(target), target, where)

    def score(
        self, rows: Sequence[ResultRow], *, progress: Callable[[int], None] = lambda images: None
    ) -> ScoringResult:
        """Errors and scores of estimates. ``PoseErrors.row`` is an estimate's index in ``rows``."""
        estimates: defaultdict[tuple[int, int, int], list[int]] = defaultdict(list)
        for index, row in enumerate(rows):
            estimates[row.scene_id, row.im_id, row.obj_id].append(index)
        by_image: defaultdict[ImageId, list[Target]] = defaultdict(list)
        for target in self.targets:
            by_image[target.scene_id, target.im_id].append(target)
        results: list[tuple[Target, TargetResult]] = []
        for image_id in self.images:
            image = self._read_image(image_id)
            with np.errstate(over="ignore", divide="ignore", invalid="ignore"):  # wrong estimates may overflow
                for target in by_image[image_id]:
                    results.append((target, self._score_target(image, target, rows, estimates)))
            progress(1)
        errors = tuple(error for _, result in results for error in result.errors)
        return ScoringResult(errors, self._merge_scores(results), self.models)

    def _read_image(self, image_id: ImageId) -> ScoredImage:
        depth_mm = None if self.no_vsd else self.dataset.depth_mm(*image_id)
        return ScoredImage(self.dataset, image_id, depth_mm, self.vsd_delta_mm)

    def _has_depth(self, image_id: ImageId) -> bool:
        try:
            self.dataset.depth_path(*image_id)
        except BadInput:
            return False
        return True

    def _score_target(
        self,
        image: ScoredImage,
        target: Target,
        rows: Sequence[ResultRow],
        estimates: Mapping[tuple[int, int, int], list[int]],
    ) -> TargetResult:
        candidates = estimates.get((target.scene_id, target.im_id, target.obj_id), [])
        best = select_best_scored([rows[i].score for i in candidates], target.inst_count)
        chosen = [(candidates[i], rows[candidates[i]]) for i in best]
        errors = self._errors(image, self.all_instances(target), chosen)
        return find_instances(self.scored_instances(target), chosen, errors)

    def _errors(self, image: ScoredImage, truths: Sequence[GroundTruth], rows: IndexedRows) -> list[PoseErrors]:
        """Errors of every estimate against every instance."""
        if not rows:
            return []
        depths_mm = [image.render_depth(self.mesh(gt.obj_id), gt.T_cam_obj) for gt in truths]
        return [
            compute_pose_errors(image, self.mesh(row.obj_id), index, row, gt, depth_mm)
            for index, row in rows
            for gt, depth_mm in zip(truths, depths_mm, strict=True)
        ]

    def _merge_scores(self, results: Sequence[tuple[Target, TargetResult]]) -> Scores:
        ids = [(t.scene_id, t.im_id, t.obj_id, gt.gt_id) for t, result in results for gt in result.instances]
        scene_id, im_id, obj_id, gt_id = np.array(ids, dtype=np.int64).reshape(-1, 4).T
        visible = [gt.visib_fract for _, result in results for gt in result.instances]
        visib_fract = np.array([np.nan if v is None else v for v in visible], float)
        mssd, mspd, vsd = (np.concatenate([getattr(r, name) for _, r in results]) for name in ("mssd", "mspd", "vsd"))
        vsd_or_none = None if self.no_vsd else vsd
        return Scores(scene_id, im_id, obj_id, gt_id, visib_fract, mssd, mspd, vsd_or_none, self.no_vsd)


def find_instances(instances: list[GroundTruth], rows: IndexedRows, errors: list[PoseErrors]) -> TargetResult:
    """Instances matched to a correct estimate, for each threshold; ``rows`` are sorted by score, best first."""
    of = {(e.row, e.gt_id): e for e in errors}
    table = [[of[index, gt.gt_id] for gt in instances] for index, _ in rows]
    shape = (len(rows), len(instances))
    relative_mssd = np.array([[e.mssd_mm / e.diameter_mm for e in line] for line in table]).reshape(shape)
    mspd_px = np.array([[e.mspd_px for e in line] for line in table]).reshape(shape)
    vsd = np.array([[e.vsd or np.ones(len(TAUS)) for e in line] for line in table]).reshape(*shape, len(TAUS))
    found_by_tau = [_found_by_threshold(vsd[..., tau], THETAS) for tau in range(len(TAUS))]
    return TargetResult(
        instances,
        errors,
        _found_by_threshold(relative_mssd, THETAS),
        _found_by_threshold(mspd_px, MSPD_PX.astype(float)),
        np.stack(found_by_tau, axis=1),
    )


def select_most_visible(truths: Sequence[GroundTruth], target: Target, where: str) -> list[GroundTruth]:
    """The ``inst_count`` most visible instances, which BOP scores, in the order of the annotations.

    Raises BadInput if there are more and scene_gt_info.json does not say how visible each one is.
    """
    if len(truths) <= target.inst_count:
        return list(truths)
    if any(gt.visib_fract is None for gt in truths):
        found = f"{len(truths)} instances of object {target.obj_id} for a target of {target.inst_count}, no visib_fract"
        raise BadInput(where, found=found, needed="scene_gt_info.json, to take the most visible")
    chosen = sorted(truths, key=lambda gt: -float(gt.visib_fract or 0))[: target.inst_count]
    return sorted(chosen, key=lambda gt: gt.gt_id)


def _found_by_threshold(
    errors: Float[np.ndarray, "e g"], thresholds: Float[np.ndarray, " k"]
) -> Bool[np.ndarray, "g k"]:
    found = np.zeros((errors.shape[1], len(thresholds)), dtype=bool)
    for k, threshold in enumerate(thresholds):
        for _, gt in match_instances(errors, threshold):
            found[gt, k] = True
    return found
