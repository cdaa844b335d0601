"""Detections with a prior, such as the pose in the frame before: follow it; search all templates if that fails."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from pipeline.errors import NoPose
from pipeline.functional.rigid import rotation_between
from pipeline.guesses import trace_guesses
from pipeline.items.matches import TemplateMatch
from pipeline.items.online import Hypothesis, Prior, Query, TemplateBank, Trace
from pipeline.method import Stages
from pipeline.route import Route

TRACKING_VERSION = 1
"""Raise it when a prior leads to other poses."""
NEAREST = 8
"""A prior is followed along those of this many templates nearest to its view that the matcher finds without it."""
TRIED = 4
"""Most templates whose poses are solved; the best one is rendered. A search of all templates solves twice as many."""


def trace_detection(stages: Stages, query: Query, bank: TemplateBank) -> Trace:
    """The trace of a detection: from its prior if there is one and the images confirm it, else from all templates.

    A prior is confirmed if some of the templates near its view are among those that the matcher finds without it, and
    the pose that they lead to is convincing (Route.is_convincing). Otherwise, the better score decides. Raises NoPose
    as trace_guesses.
    """
    if query.prior is None:
        return trace_guesses(stages, query, bank)
    route = Route(stages, query, bank)
    followed = _follow(route, query.prior)
    if followed is None:
        return _add_times(trace_guesses(stages, query, bank), route)
    if followed.is_confirmed:
        return Trace(followed.match, (route.refine(followed.hypothesis),), route.clock.times_s)
    return _choose(route, followed, _search(route))


@dataclass(frozen=True, eq=False)
class _Followed:
    """The hypothesis that a prior leads to, with its score, and the templates that match the query."""

    hypothesis: Hypothesis
    match: TemplateMatch
    is_confirmed: bool


def _follow(route: Route, prior: Prior) -> _Followed | None:
    """Solve from the matched templates near the prior's view, and render the best pose; None if that fails."""
    with route.clock("match"):
        match = route.stages.match(route.query, route.bank)
    nearest = set(nearest_views(prior.T_cam_obj, prior.symmetries, route.bank.T_cam_obj, count=NEAREST).tolist())
    matched = zip(match.index.tolist(), match.score.tolist(), strict=True)
    near = [Hypothesis(index, score) for index, score in matched if index in nearest][:TRIED]
    if not near:
        return None
    found = route.rerender(route.sort([route.solve(route.compare(hypothesis)) for hypothesis in near])[0])
    if found.solution is None or found.rerendered is None:
        return None
    return _Followed(replace(found, score=route.score(found)), match, route.is_convincing(found))


def nearest_views(
    T_cam_obj: Float[np.ndarray, "4 4"],
    symmetries: Float[np.ndarray, "s 4 4"],
    T_templates: Float[np.ndarray, "n 4 4"],
    *,
    count: int,
) -> Int[np.ndarray, " k"]:
    """The templates whose rotation is nearest to that of a pose or of one of its symmetric copies, nearest first.

    The rotation is taken relative to the viewing ray: it determines what a crop shows.
    """
    R_view_obj = rotation_between(T_cam_obj[:3, 3], np.array([0.0, 0.0, 1.0])) @ T_cam_obj[:3, :3]
    copies = R_view_obj @ symmetries[:, :3, :3]
    cosine = T_templates[:, :3, :3].reshape(-1, 9) @ copies.reshape(-1, 9).T  # trace(A.T @ B) grows as the angle falls
    return np.argsort(-cosine.max(axis=1), kind="stable")[:count]


def _search(route: Route) -> Trace | None:
    try:
        return trace_guesses(route.stages, route.query, route.bank)
    except NoPose:
        return None


def _choose(route: Route, followed: _Followed, searched: Trace | None) -> Trace:
    """The search's trace, with the followed hypothesis first if its score is higher."""
    if searched is None:
        return Trace(followed.match, (route.refine(followed.hypothesis),), route.clock.times_s)
    if searched.best.solution is not None and (searched.best.score or 0.0) >= (followed.hypothesis.score or 0.0):
        return _add_times(searched, route)
    hypotheses = (route.refine(followed.hypothesis), *searched.hypotheses)
    return _add_times(Trace(followed.match, hypotheses, searched.times_s), route)


def _add_times(trace: Trace, route: Route) -> Trace:
    return replace(trace, times_s=dict(Counter(trace.times_s) + Counter(route.clock.times_s)))
