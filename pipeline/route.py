"""The method on one page: a detection's features and its object's templates -> a pose, or the reason why there is none.

mesh -render-> templates -crop, extract-> template features -fit->     (offline, once per object)
image -detect, crop, extract-> query features                          (once per image)
query, templates -match-> template -fuse, cluster, correspond-> points -lift, solve-> hypotheses -choose, refine-> pose
hypotheses -render, crop, extract-> templates in the estimated poses -fuse, ..., refine-> pose     (rerender)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.errors import NoPose
from pipeline.functional import camera, rigid
from pipeline.functional.crop_pose import pose_in_image
from pipeline.functional.maps import upsample
from pipeline.functional.masks import foreground
from pipeline.functional.pnp import reprojection_error_px
from pipeline.hypotheses import fit_to_mask, mean_cosine, select_distinct, select_matched
from pipeline.items.features import SALIENCY_LAYER, Clusters, FusedPair, PairGeometry
from pipeline.items.matches import Correspondences, TrueMatches
from pipeline.items.online import Clock, Hypothesis, Query, TemplateBank, TemplateView, Trace
from pipeline.items.poses import PoseSolution
from pipeline.method import Stages
from pipeline.stages.cluster import require_cells
from pipeline.stages.fuse import coarsen_pair, encode_view
from pipeline.stages.lift import lift
from pipeline.stages.solve.plane import refit_in_crop, solver_plane

MIN_POINTS = 4


def trace_pose(stages: Stages, query: Query, bank: TemplateBank) -> Trace:
    """Estimate the pose of one detection.

    Raises NoPose when no template can be compared. A hypothesis that fails keeps its reason.
    """
    route = Route(stages, query, bank)
    with route.clock("match"):
        match = stages.match(query, bank)
    candidates = zip(match.index.tolist(), match.score.tolist(), strict=True)
    compared = [route.compare(Hypothesis(index, score)) for index, score in candidates]
    matched = select_matched(compared, count=stages.second_look.solved)
    hypotheses = route.sort([route.solve(h) for h in matched])
    if stages.second_look.hypotheses:
        hypotheses = route.look_again(hypotheses)
    hypotheses[0] = route.refine(hypotheses[0])
    return Trace(match, tuple(hypotheses), route.clock.times_s)


@dataclass(frozen=True, eq=False)
class Route:
    """One detection on its way through the online stages."""

    stages: Stages
    query: Query
    bank: TemplateBank
    clock: Clock = field(default_factory=Clock)

    def compare(self, start: Hypothesis) -> Hypothesis:
        """Find the correspondences of a hypothesis, or record why it has none."""
        parts: dict[str, Any] = {}
        try:
            with self.clock("read template"):
                template = self.view(start)
            with self.clock("fuse"):
                pair = parts["pair"] = self.fuse(template)
            with self.clock("cluster"):
                clusters = parts["clusters"] = self.cluster(template, pair)
            with self.clock("correspond"):
                parts["matches"] = self.correspond(template, pair, clusters)
        except NoPose as failure:
            parts["failure"] = failure
        return replace(start, **parts)

    def solve(self, start: Hypothesis) -> Hypothesis:
        """Estimate the pose of a hypothesis from its correspondences, or record why it has none."""
        if start.matches is None:
            return start
        parts: dict[str, Any] = {}
        try:
            with self.clock("lift"):
                parts["points_obj"], parts["query_px_img"] = self.lift(self.view(start), start.matches)
            with self.clock("solve"):
                parts["solution"] = self.solve_pose(parts["points_obj"], parts["query_px_img"])
        except NoPose as failure:
            parts["failure"] = failure
        return replace(start, **parts)

    def look_again(self, hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
        """Rerender distinct hypotheses, best first, until one convinces."""
        look, K_crop, seen = self.stages.second_look, self.query.K_crop, dict[Hypothesis, Hypothesis]()
        apart_px = look.apart * self.stages.crop.size
        for h in select_distinct(hypotheses, K_crop, count=look.hypotheses, apart_px=apart_px):
            seen[h] = self.rerender(h)
            if self.is_convincing(seen[h]):
                break
        return [*self.sort(list(seen.values())), *(h for h in hypotheses if h not in seen)]

    def is_convincing(self, hypothesis: Hypothesis) -> bool:
        """Whether a rerendered hypothesis looks so similar to the query that no other one is rendered."""
        view, pair = hypothesis.rerendered, hypothesis.pair
        if view is None or pair is None:
            return False
        with self.clock("choose"):
            return mean_cosine(hypothesis, self.geometry(view, pair)) >= self.stages.second_look.enough

    def rerender(self, first: Hypothesis) -> Hypothesis:
        """Match again with a view rendered in the hypothesis's pose; the first hypothesis where that fails.

        The view is rendered as the query's crop would show the object, so it has the query's scale, position and
        viewpoint: correspondences are short, and its outline is that of the estimated pose.
        """
        if first.solution is None:
            return first
        with self.clock("rerender"):
            view = self.bank.render(first.solution.T_cam_obj, self.query.A_crop_img, self.query.K)
        start = Hypothesis(first.template_id, first.template_score, rerendered=view, first=first)
        second = self.solve(self.compare(start))
        return first if second.solution is None else second

    def view(self, hypothesis: Hypothesis) -> TemplateView:
        """The view that a hypothesis is matched with."""
        return hypothesis.rerendered or self.bank.view(hypothesis.template_id)

    def fuse(self, template: TemplateView) -> FusedPair:
        """Maps of query and template in one space, with saliency where the extractor gave it."""
        fuse, block = self.stages.fuse, self.block(template)
        if fuse.joint:
            pair = coarsen_pair(fuse.pair(self.query.crop, template.crop), block=block)
        else:
            views = (self.query, template)
            pair = fuse.pair(*(encode_view(view, fuse, self.bank.fitted, block=block) for view in views))
        if SALIENCY_LAYER not in self.query.crop.maps:
            return pair
        cells = pair.query.shape[-1]
        salient = [upsample(x.crop.maps[SALIENCY_LAYER].float(), cells=cells)[0] for x in (self.query, template)]
        return replace(pair, query_saliency=salient[0], template_saliency=salient[1])

    def block(self, template: TemplateView) -> int:
        """Side of the blocks of cells that are compared: 1 for a view that was rendered for this query."""
        return 1 if template.rgb is not None else self.stages.second_look.block

    def cluster(self, template: TemplateView, pair: FusedPair) -> Clusters:
        """Clusters of both maps, each computed once where its map does not depend on the other image."""
        cluster, key = self.stages.cluster, (self.stages.fuse, self.stages.cluster, self.block(template))
        if self.stages.fuse.joint:
            return cluster(pair)
        require_cells(pair)
        query = self.query.memo.get(key, lambda: cluster.encode(pair.query, pair.query_mask))
        return cluster.pair(query, template.memo.get(key, lambda: cluster.encode(pair.template, pair.template_mask)))

    def correspond(self, template: TemplateView, pair: FusedPair, clusters: Clusters) -> Correspondences:
        """Corresponding points in crop pixels; an oracle receives the true ones."""
        truth = self._true_matches(template, pair) if self.stages.correspond.needs_truth else None
        return self.stages.correspond(pair, clusters, crop_size=self.stages.crop.size, truth=truth)

    def lift(
        self, template: TemplateView, matches: Correspondences
    ) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 2"]]:
        """Object points (mm, NaN off the object) and the pixels of the query's image that they correspond to."""
        template_px = matches.template_px.double().cpu().numpy()
        query_px = matches.query_px.double().cpu().numpy()
        points_obj = lift(template_px, template.A_crop_img, template.depth_mm, template.K, template.T_cam_obj)
        return points_obj, camera.apply_homography(np.linalg.inv(self.query.A_crop_img), query_px)

    def solve_pose(self, points_obj: Float[np.ndarray, "m 3"], query_px_img: Float[np.ndarray, "m 2"]) -> PoseSolution:
        """The pose of the points on the object, solved in the solver's pixel frame; its error is in image pixels."""
        query = self.query
        on_object = np.isfinite(points_obj).all(1)
        if on_object.sum() < MIN_POINTS:
            raise NoPose("lift", f"{on_object.sum()} correspondences lie on the object, PnP needs {MIN_POINTS}")
        A_plane_img, K_plane, R_plane_cam = solver_plane(self.stages.solve.plane, query, self.stages.crop.size)
        px_plane = camera.apply_homography(A_plane_img, query_px_img[on_object])
        solution = self.stages.solve(points_obj[on_object], px_plane, K_plane)
        inliers = np.zeros(len(on_object), bool)
        inliers[on_object] = solution.inliers
        T_cam_obj = pose_in_image(solution.T_cam_obj, R_plane_cam)
        if self.stages.solve.refits:
            points, px = points_obj[on_object], query_px_img[on_object]
            T_cam_obj = refit_in_crop(self.stages.solve, query, points, px, T_cam_obj)
        error_px = reprojection_error_px(points_obj[inliers], query_px_img[inliers], query.K, T_cam_obj)
        return PoseSolution(T_cam_obj, inliers, float(np.sqrt(np.mean(error_px**2))))

    def sort(self, hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
        """The hypotheses with their scores, highest first; ties keep their order."""
        with self.clock("choose"):
            scored = [replace(h, score=self.score(h)) for h in hypotheses]
            return sorted(scored, key=lambda h: h.score or 0.0, reverse=True)

    def score(self, hypothesis: Hypothesis) -> float:
        """Score of a hypothesis; -1, below all others, where it has no pose."""
        if hypothesis.solution is None or hypothesis.pair is None:
            return -1.0
        geometry = self.geometry(self.view(hypothesis), hypothesis.pair)
        truth = self.query.truth if self.stages.choose.needs_truth else None
        return self.stages.choose(hypothesis.solution.T_cam_obj, hypothesis.inliers, geometry, truth)

    def refine(self, hypothesis: Hypothesis) -> Hypothesis:
        """The hypothesis with its pose refined. Inliers stay those of the solver, because the score uses them."""
        solution, pair = hypothesis.solution, hypothesis.pair
        if solution is None or pair is None or hypothesis.points_obj is None or hypothesis.query_px_img is None:
            return hypothesis
        with self.clock("refine"):
            geometry = self.geometry(self.view(hypothesis), pair)
            start = fit_to_mask(hypothesis, self.query, solution.T_cam_obj, weight=self.stages.second_look.outline)
            T_cam_obj = self.stages.refine(start, geometry)
        if np.array_equal(T_cam_obj, solution.T_cam_obj):
            return hypothesis
        points_obj, px_img = hypothesis.points_obj[solution.inliers], hypothesis.query_px_img[solution.inliers]
        error_px = reprojection_error_px(points_obj, px_img, self.query.K, T_cam_obj)
        root_mean_square = float(np.sqrt(np.mean(error_px**2)))
        return replace(hypothesis, solution=PoseSolution(T_cam_obj, solution.inliers, root_mean_square))

    def geometry(self, template: TemplateView, pair: FusedPair) -> PairGeometry:
        """The pair with object points of the template's cells and the camera of the query's crop."""
        _, points_obj = self._template_cells(template, pair)
        return PairGeometry(pair, points_obj, self.query.K_crop, self.stages.crop.size)

    def _template_cells(
        self, template: TemplateView, pair: FusedPair
    ) -> tuple[Float[Tensor, "m 2"], Float[np.ndarray, "m 3"]]:
        """Crop pixels and object points (mm, NaN off the object) of the centres of the template's foreground cells."""
        cells = pair.template_mask.shape[-1]
        cell_xy = camera.grid_xy(foreground(pair.template_mask), width=cells)
        template_px = camera.cell_to_px(cell_xy.double(), size=self.stages.crop.size, cells=cells)
        px = template_px.cpu().numpy()
        return template_px, lift(px, template.A_crop_img, template.depth_mm, template.K, template.T_cam_obj)

    def _true_matches(self, template: TemplateView, pair: FusedPair) -> TrueMatches | None:
        query = self.query
        if query.truth is None:
            return None
        template_px, points_obj = self._template_cells(template, pair)
        true_px_img = camera.project(query.K, rigid.transform(query.truth.T_cam_obj, points_obj))
        true_px = torch.from_numpy(camera.apply_homography(query.A_crop_img, true_px_img)).to(template_px.device)
        return TrueMatches(template_px, true_px, query.crop.mask)
