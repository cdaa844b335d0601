"""Detections whose mask is a guess: try several masks until a pose is good enough; return the best pose."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from itertools import chain

from pipeline.errors import NoPose
from pipeline.hypotheses import mean_cosine
from pipeline.items.online import Clock, Query, TemplateBank, Trace
from pipeline.method import Stages
from pipeline.route import Route, trace_pose


def trace_guesses(stages: Stages, query: Query, bank: TemplateBank) -> Trace:
    """The trace of the mask whose best pose scores highest: mean cosine of the features times number of inliers.

    Stops after the first mask whose mean cosine suffices (Segmenter.is_enough). ``times_s`` sums over all masks tried.
    Raises NoPose with the reason of the first mask if none can be compared with a template.
    """
    if query.others is None:
        return trace_pose(stages, query, bank)
    found: list[tuple[float, Trace]] = []
    failure, clock = None, Clock()
    for guess in chain([query], _time_guesses(query.others(), clock)):
        try:
            trace = trace_pose(stages, guess, bank)
        except NoPose as reason:
            failure = failure or reason
            continue
        similarity = _similarity(stages, guess, bank, trace)
        found.append((similarity * trace.best.inliers, replace(trace, query=guess)))
        if stages.segment.is_enough(similarity):
            break
    if not found:
        raise failure or NoPose("match", "no guess at the mask")
    seconds = Counter(clock.times_s)
    for _, trace in found:
        seconds.update(trace.times_s)
    best = max(found, key=lambda each: each[0])[1]
    return replace(best, times_s=dict(seconds))


def _similarity(stages: Stages, guess: Query, bank: TemplateBank, trace: Trace) -> float:
    """Mean cosine of the features under the best hypothesis; -1 without a pose."""
    if trace.best.pair is None:
        return -1.0
    route = Route(stages, guess, bank)
    return mean_cosine(trace.best, route.geometry(route.view(trace.best), trace.best.pair))


def _time_guesses(guesses: Iterator[Query], clock: Clock) -> Iterator[Query]:
    """Yield the guesses; add the time to make them to ``clock``."""
    while True:
        with clock("guess mask"):
            guess = next(guesses, None)
        if guess is None:
            return
        yield guess
