"""The method on one page: a detection's features and its object's templates -> a pose, or the reason why there is none.

mesh -render-> templates -crop, extract-> template features -fit->     (offline, once for every object)
image -detect, crop, extract-> query features                          (once for every image)
query, templates -match-> template -fuse, cluster, correspond-> points -lift, solve-> hypotheses -choose, refine-> pose
the worthiest poses -render, crop, extract-> templates of this very query -fuse, ..., refine-> pose   (a second look)
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from pipeline.errors import NoPose
from pipeline.fits import Fit, Fitted, chain
from pipeline.functional import camera, rigid
from pipeline.functional.maps import upsample
from pipeline.functional.masks import foreground
from pipeline.functional.pnp import reprojection_error_px
from pipeline.items.features import SALIENCY_LAYER, Clusters, FusedPair
from pipeline.items.matches import Correspondences, TemplateMatch
from pipeline.items.poses import PoseSolution
from pipeline.spec import NonNegative, spec
from pipeline.stages.choose import Chooser
from pipeline.stages.cluster import Clusterer, SidedClusterer
from pipeline.stages.correspond import Corresponder, SalientCorresponder, TruthCorresponder
from pipeline.stages.crop import Cropper
from pipeline.stages.detect import DescribingDetector, Detector
from pipeline.stages.extract import Extractor
from pipeline.stages.fuse import FittedFuser, Fuser, SidedFuser, fused
from pipeline.stages.lift import lift
from pipeline.stages.match import FittedMatcher, Matcher, TruthMatcher
from pipeline.stages.refine import Refiner
from pipeline.stages.render import Renderer
from pipeline.stages.solve import Solver

MIN_POINTS = 4
ONLINE_STAGES = ("match", "fuse", "cluster", "correspond", "solve", "choose", "refine")
"""What a pose depends on beside the features."""


@spec
class SecondLook:
    """How many of the worthiest hypotheses are drawn in their pose, and matched with that picture; 0: none."""

    hypotheses: NonNegative = 0


@dataclass(frozen=True)
class Stages:
    """Which variant at each stage.

    ``fallback``: a template's own pose may stand in for a failed solver. ``second_look``: hypotheses of SecondLook.
    """

    render: Renderer
    extract: Extractor
    crop: Cropper
    match: Matcher
    fuse: Fuser
    cluster: Clusterer
    correspond: Corresponder
    solve: Solver
    choose: Chooser
    refine: Refiner
    detect: Detector | DescribingDetector
    fallback: bool = False
    second_look: int = 0

    @property
    def need_truth(self) -> str:
        """The oracle among the online stages that must be shown the true pose, "" when none is."""
        if isinstance(self.match, TruthMatcher):
            return "match=oracle"
        return "correspond=oracle" if isinstance(self.correspond, TruthCorresponder) else ""

    @property
    def layers(self) -> tuple[int, ...]:
        """Layers the route reads: the template layer, the hyperfeature layers, saliency where it is needed."""
        salient = {SALIENCY_LAYER} if isinstance(self.correspond, SalientCorresponder) else set()
        return tuple(sorted({self.match.layer, *self.fuse.layers} | salient))

    @property
    def fits(self) -> tuple[Fit, ...]:
        """What is fitted to an object's templates, each once, and before it what it stands on."""
        found = [s.fit for s in (self.match, self.fuse) if isinstance(s, (FittedMatcher, FittedFuser))]
        return tuple(dict.fromkeys(part for fit in found for part in chain(fit)))


@dataclass(frozen=True, eq=False)
class Truth:
    """What no method may see: the true pose, and the object's symmetries."""

    T_cam_obj: Float[np.ndarray, "4 4"]
    symmetries: Float[np.ndarray, "s 4 4"]


@dataclass(frozen=True, eq=False)
class Query:
    """One detection: features by layer, its crop, and its camera. ``truth``: None but for an oracle that needs it.

    ``own``: what stages made of the query alone, by stage, kept for the next template.
    """

    features: Mapping[int, Float[Tensor, "c h w"]]
    mask: Bool[Tensor, "S S"]
    A_crop_img: Float[np.ndarray, "3 3"]
    K: Float[np.ndarray, "3 3"]
    truth: Truth | None = None
    own: dict[object, Any] = field(default_factory=dict, init=False, repr=False)


@dataclass(frozen=True, eq=False)
class TemplateView:
    """One template as correspondences need it. ``rgb``: its crop, where it was drawn for a query and is not stored.

    ``own``: what stages made of the template alone, by stage, kept for the next query.
    """

    features: Mapping[int, Float[Tensor, "c h w"]]
    mask: Bool[Tensor, "S S"]
    A_crop_img: Float[np.ndarray, "3 3"]
    depth_mm: Float[np.ndarray, "H W"]
    K: Float[np.ndarray, "3 3"]
    T_cam_obj: Float[np.ndarray, "4 4"]
    rgb: UInt8[np.ndarray, "S S 3"] | None = None
    own: dict[object, Any] = field(default_factory=dict, init=False, repr=False)


class TemplateBank(Protocol):
    """An object's templates: features of the match layer, crop masks and poses of all of them, any view in full."""

    @property
    def features(self) -> Float[Tensor, "n c h w"]:
        """Features of the match layer."""
        ...

    @property
    def mask(self) -> Bool[Tensor, "n S S"]:
        """Masks of the crops."""
        ...

    @property
    def T_cam_obj(self) -> Float[np.ndarray, "n 4 4"]:
        """Poses of all templates."""
        ...

    def view(self, index: int) -> TemplateView:
        """Everything about one template."""
        ...

    def draw(
        self,
        T_cam_obj: Float[np.ndarray, "4 4"],
        A_crop_img: Float[np.ndarray, "3 3"],
        K: Float[np.ndarray, "3 3"],
    ) -> TemplateView:
        """The object in a pose, as a crop of an image of K shows it, with its features."""
        ...

    def fitted(self, fit: Fit) -> Fitted:
        """What was fitted to the templates."""
        ...


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """What one template led to; ``solution`` None with the ``failure`` that stopped it.

    ``drawn``: the view that it was matched with at a second look, from where ``template_id`` had led to.
    """

    template_id: int
    template_score: float
    pair: FusedPair | None = None
    clusters: Clusters | None = None
    matches: Correspondences | None = None
    points_obj: Float[np.ndarray, "m 3"] | None = None
    query_px_img: Float[np.ndarray, "m 2"] | None = None
    solution: PoseSolution | None = None
    failure: NoPose | None = None
    drawn: TemplateView | None = None

    @property
    def inliers(self) -> int:
        """Correspondences that support the pose."""
        return int(self.solution.inliers.sum()) if self.solution else 0

    @property
    def notes(self) -> tuple[str, ...]:
        """What stages clamped or skipped."""
        said = (self.pair and self.pair.note, self.clusters and self.clusters.note)
        return tuple(note for note in said if note)


@dataclass(frozen=True, eq=False)
class Trace:
    """The whole online route of one detection: the matched templates and one hypothesis each, best first."""

    match: TemplateMatch
    hypotheses: tuple[Hypothesis, ...]
    times_s: Mapping[str, float]

    @property
    def best(self) -> Hypothesis:
        """The worthiest; of equals the better template. Nothing here sees ground truth."""
        return self.hypotheses[0]


@dataclass
class Clock:
    """Seconds by stage."""

    times_s: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Add the block's seconds to ``stage``."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.times_s[stage] = self.times_s.get(stage, 0.0) + time.perf_counter() - start


def trace_pose(stages: Stages, query: Query, bank: TemplateBank) -> Trace:
    """The online route. Raises NoPose when no template can be compared; one that leads nowhere keeps its reason."""
    clock = Clock()
    with clock("match"):
        match = _match(stages, query, bank)
    ranked = zip(match.index.tolist(), match.score.tolist(), strict=True)
    hypotheses = [_hypothesis(stages, query, bank, Hypothesis(index, score), clock) for index, score in ranked]
    _sort(stages, query, bank, hypotheses, clock)
    if stages.second_look:
        most = min(stages.second_look, len(hypotheses))
        looked = [_looked_again(stages, query, bank, h, clock) for h in hypotheses[:most]]
        _sort(stages, query, bank, looked, clock)
        hypotheses[:most] = looked
    hypotheses[0] = _refined(stages, query, bank, hypotheses[0], clock)
    return Trace(match, tuple(hypotheses), clock.times_s)


def retrace_pose(stages: Stages, query: Query, bank: TemplateBank, template_id: int, score: float) -> Hypothesis:
    """What one template led to, refined, as it was in the trace that chose it."""
    clock = Clock()
    found = _hypothesis(stages, query, bank, Hypothesis(template_id, score), clock)
    if stages.second_look:
        found = _looked_again(stages, query, bank, found, clock)
    return _refined(stages, query, bank, found, clock)


def _sort(stages: Stages, query: Query, bank: TemplateBank, hypotheses: list[Hypothesis], clock: Clock) -> None:
    """Worthiest first; equals stay in their order."""
    if len(hypotheses) > 1:
        with clock("choose"):
            hypotheses.sort(key=lambda h: -_worth(stages, query, bank, h))


def _looked_again(stages: Stages, query: Query, bank: TemplateBank, first: Hypothesis, clock: Clock) -> Hypothesis:
    """The hypothesis that a view drawn in the first one's pose leads to; the first where that leads nowhere.

    Drawn as the query's own crop would show it, the view has the query's scale and place and no template's error of
    view: what is left to match is near, and outlines are those of the pose itself.
    """
    if first.solution is None:
        return first
    with clock("draw"):
        drawn = bank.draw(first.solution.T_cam_obj, query.A_crop_img, query.K)
    start = Hypothesis(first.template_id, first.template_score, drawn=drawn)
    second = _hypothesis(stages, query, bank, start, clock)
    return first if second.solution is None else second


def _match(stages: Stages, query: Query, bank: TemplateBank) -> TemplateMatch:
    if isinstance(stages.match, TruthMatcher) and query.truth is not None:
        return stages.match.by_truth(query.truth.T_cam_obj, query.truth.symmetries, bank.T_cam_obj)
    features = query.features[stages.match.layer]
    if isinstance(stages.match, FittedMatcher):
        return stages.match.by_fitted(features, query.mask, bank.fitted(stages.match.fit))
    return stages.match(features, query.mask, bank.features, bank.mask)


def _hypothesis(stages: Stages, query: Query, bank: TemplateBank, start: Hypothesis, clock: Clock) -> Hypothesis:
    """``start`` with what its view leads to."""
    parts: dict[str, object] = {}
    try:
        with clock("read template"):
            template = _view(bank, start)
        with clock("fuse"):
            pair = _with_saliency(_fused(stages, query, template, bank), query, template)
            parts["pair"] = pair
        with clock("cluster"):
            clusters = _clustered(stages, query, template, pair)
            parts["clusters"] = clusters
        with clock("correspond"):
            matches = _matched(stages, query, template, pair, clusters)
            parts["matches"] = matches
        with clock("lift"):
            points_obj, query_px_img = _lifted(matches, query, template)
            parts |= {"points_obj": points_obj, "query_px_img": query_px_img}
        with clock("solve"):
            seen = np.isfinite(points_obj).all(1)
            if seen.sum() < MIN_POINTS:
                raise NoPose("lift", f"{seen.sum()} correspondences lie on the object, PnP needs {MIN_POINTS}")
            parts["solution"] = _solved(stages, query, points_obj, query_px_img, seen)
    except NoPose as failure:
        parts["failure"] = failure
    return replace(start, **parts)  # type: ignore[arg-type]


def _view(bank: TemplateBank, found: Hypothesis) -> TemplateView:
    return bank.view(found.template_id) if found.drawn is None else found.drawn


def _fused(stages: Stages, query: Query, template: TemplateView, bank: TemplateBank) -> FusedPair:
    sides = query.features, template.features, query.mask, template.mask
    if isinstance(stages.fuse, FittedFuser):
        return stages.fuse.by_fitted(*sides, bank.fitted(stages.fuse.fit))
    if isinstance(stages.fuse, SidedFuser):
        if stages.fuse not in query.own:
            query.own[stages.fuse] = stages.fuse.side(query.features)
        return fused(query.own[stages.fuse], stages.fuse.side(template.features), query.mask, template.mask)
    return stages.fuse(*sides)


def _clustered(stages: Stages, query: Query, template: TemplateView, pair: FusedPair) -> Clusters:
    if not isinstance(stages.cluster, SidedClusterer) or not isinstance(stages.fuse, SidedFuser):
        return stages.cluster(pair)
    made = stages.fuse, stages.cluster
    if made not in query.own:
        query.own[made] = stages.cluster.side("query", pair.query, pair.query_mask)
    if made not in template.own:
        template.own[made] = stages.cluster.side("template", pair.template, pair.template_mask)
    return stages.cluster.paired(query.own[made], template.own[made])


def _with_saliency(pair: FusedPair, query: Query, template: TemplateView) -> FusedPair:
    """The pair with the saliency of its cells, where the extractor was asked for it."""
    if SALIENCY_LAYER not in query.features:
        return pair
    cells = pair.query.shape[-1]
    seen = [upsample(side.features[SALIENCY_LAYER].float(), cells=cells)[0] for side in (query, template)]
    return replace(pair, query_saliency=seen[0], template_saliency=seen[1])


def _matched(
    stages: Stages, query: Query, template: TemplateView, pair: FusedPair, clusters: Clusters
) -> Correspondences:
    """Corresponding points; the true ones for an oracle."""
    if not isinstance(stages.correspond, TruthCorresponder) or query.truth is None:
        return stages.correspond(pair, clusters, crop_size=stages.crop.size)
    template_px, points_obj = _template_cells(stages, template, pair)
    true_px_img = camera.project(query.K, rigid.transform(query.truth.T_cam_obj, points_obj))
    true_px = torch.from_numpy(camera.apply_homography(query.A_crop_img, true_px_img)).to(template_px.device)
    return stages.correspond.by_truth(template_px, true_px, query.mask)


def _template_cells(
    stages: Stages, template: TemplateView, pair: FusedPair
) -> tuple[Float[Tensor, "m 2"], Float[np.ndarray, "m 3"]]:
    """Crop pixels and object points (mm, NaN off the object) of the centres of the template's foreground cells."""
    cells = pair.template_mask.shape[-1]
    cell_xy = camera.grid_xy(foreground(pair.template_mask), width=cells)
    template_px = camera.cell_to_px(cell_xy.double(), size=stages.crop.size, cells=cells)
    px = template_px.cpu().numpy()
    return template_px, lift(px, template.A_crop_img, template.depth_mm, template.K, template.T_cam_obj)


def _worth(stages: Stages, query: Query, bank: TemplateBank, found: Hypothesis) -> float:
    """What choose makes of a hypothesis; less than of any other where there is no pose."""
    if found.solution is None or found.pair is None:
        return -1.0
    _, points_obj = _template_cells(stages, _view(bank, found), found.pair)
    K_crop, size = query.A_crop_img @ query.K, stages.crop.size
    return stages.choose(found.solution.T_cam_obj, found.inliers, found.pair, points_obj, K_crop, crop_size=size)


def _refined(stages: Stages, query: Query, bank: TemplateBank, best: Hypothesis, clock: Clock) -> Hypothesis:
    """The hypothesis with its pose refined; its inliers stay the solver's, its reprojection is that of the new pose.

    Inliers say how many correspondences agree on a pose, which is what scores go by; a refinement by other means than
    correspondences has no say in that.
    """
    if best.solution is None or best.pair is None or best.points_obj is None or best.query_px_img is None:
        return best
    with clock("refine"):
        _, points_obj = _template_cells(stages, _view(bank, best), best.pair)
        K_crop = query.A_crop_img @ query.K
        T_cam_obj = stages.refine(best.solution.T_cam_obj, best.pair, points_obj, K_crop, crop_size=stages.crop.size)
    if np.array_equal(T_cam_obj, best.solution.T_cam_obj):
        return best
    rows = best.solution.inliers
    error = reprojection_error_px(best.points_obj[rows], best.query_px_img[rows], query.K, T_cam_obj)
    root_mean_square = float(np.sqrt(np.mean(error**2)))
    return replace(best, solution=PoseSolution(T_cam_obj, rows, root_mean_square))


def _lifted(
    matches: Correspondences, query: Query, template: TemplateView
) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 2"]]:
    """Object points (mm, NaN off the object) and the query's full-image pixels they correspond to."""
    template_px = matches.template_px.double().cpu().numpy()
    query_px = matches.query_px.double().cpu().numpy()
    points_obj = lift(template_px, template.A_crop_img, template.depth_mm, template.K, template.T_cam_obj)
    return points_obj, camera.apply_homography(np.linalg.inv(query.A_crop_img), query_px)


def _solved(
    stages: Stages,
    query: Query,
    points_obj: Float[np.ndarray, "m 3"],
    query_px_img: Float[np.ndarray, "m 2"],
    seen: Bool[np.ndarray, " m"],
) -> PoseSolution:
    """The pose of the points seen, solved in the plane that the solver asks for; errors are in the query image."""
    points, px_img, inliers = points_obj[seen], query_px_img[seen], np.zeros(len(seen), bool)
    if stages.solve.plane == "image":
        solution = stages.solve(points, px_img, query.K)
        inliers[seen] = solution.inliers
        return PoseSolution(solution.T_cam_obj, inliers, solution.reprojection_px)
    K_crop, R_crop_cam = camera.crop_camera(query.A_crop_img, query.K)
    solution = stages.solve(points, camera.apply_homography(query.A_crop_img, px_img), K_crop)
    inliers[seen] = solution.inliers
    T_cam_obj = rigid.rigid(R_crop_cam.T, np.zeros(3)) @ solution.T_cam_obj
    error_px = reprojection_error_px(points_obj[inliers], query_px_img[inliers], query.K, T_cam_obj)
    return PoseSolution(T_cam_obj, inliers, float(np.sqrt(np.mean(error_px**2))))


def template_pose(query: Query, template: TemplateView) -> Float[np.ndarray, "4 4"]:
    """T_cam_obj from a template alone: its rotation, and the translation that fits place and size of the crop.

    In the cameras whose pictures the two crops are (camera.crop_camera): the object's origin keeps its place in the
    crop; depth scales with the focal length; the rotation is turned with the viewing ray, so that the object looks the
    same from its new place.
    """
    K_query, R_query_cam = camera.crop_camera(query.A_crop_img, query.K)
    K_template, R_template_cam = camera.crop_camera(template.A_crop_img, template.K)
    T_template_obj = rigid.rigid(R_template_cam, np.zeros(3)) @ template.T_cam_obj
    t = T_template_obj[:3, 3]
    origin_crop = camera.project(K_template, t)
    depth = t[2] * K_query[0, 0] / K_template[0, 0]
    position = camera.unproject(K_query, origin_crop[None], np.array([depth]))[0]
    turn = rigid.rotation_between(t, position)
    return rigid.rigid(R_query_cam.T, np.zeros(3)) @ rigid.rigid(turn @ T_template_obj[:3, :3], position)


def to_device(features: Mapping[int, np.ndarray], device: str) -> dict[int, Tensor]:
    """Stored maps as float32 tensors on a device."""
    return {layer: torch.from_numpy(maps).to(device).float() for layer, maps in features.items()}
