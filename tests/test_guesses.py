"""A detection with several guesses at its mask: which is traced, and which answers."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from presets import QUICK

import pipeline.guesses
from pipeline.errors import NoPose
from pipeline.guesses import trace_guesses
from pipeline.items.features import CropFeatures
from pipeline.items.matches import TemplateMatch
from pipeline.items.online import Hypothesis, Query, Trace
from pipeline.items.poses import PoseSolution
from pipeline.stages.segment.grabcut import Grabcut

STAGES = replace(QUICK, segment=Grabcut(enough=0.6))
MATCH = TemplateMatch(torch.tensor([0]), torch.tensor([1.0]), 0.0)


class Bank:
    """Stands for templates: similarity and inliers of each guess's best pose, None where it cannot be compared."""

    def __init__(self, outcomes: dict[int, tuple[float | None, int]]) -> None:
        self.outcomes = outcomes


def query(number: int) -> Query:
    return Query(CropFeatures({}, torch.ones(4, 4, dtype=torch.bool)), number * np.eye(3), np.eye(3))


@pytest.fixture
def traced(monkeypatch) -> list[int]:
    """Numbers of the guesses that were traced."""
    seen: list[int] = []

    def trace(stages, guess, bank):
        number = int(guess.A_crop_img[0, 0])
        seen.append(number)
        similarity, inliers = bank.outcomes[number]
        if similarity is None:
            raise NoPose("match", f"guess {number}")
        solution = PoseSolution(np.eye(4), np.ones(inliers, bool), 1.0)
        best = Hypothesis(number, similarity, solution=solution)
        return Trace(MATCH, (best,), {"match": 0.1})

    monkeypatch.setattr(pipeline.guesses, "trace_pose", trace)
    monkeypatch.setattr(pipeline.guesses, "_similarity", lambda stages, guess, bank, trace: trace.best.template_score)
    return seen


def run(outcomes: dict[int, tuple[float | None, int]]) -> Trace:
    others = [query(n) for n in outcomes if n > 1]
    return trace_guesses(STAGES, replace(query(1), others=lambda: iter(others)), Bank(outcomes))


def test_a_given_mask_is_traced_once(traced):
    trace = trace_guesses(STAGES, query(1), Bank({1: (0.1, 5)}))
    assert traced == [1]
    assert trace.query is None


def test_no_guess_follows_one_that_convinces(traced):
    trace = run({1: (0.5, 9), 2: (0.7, 5), 3: (0.9, 99)})
    assert traced == [1, 2]
    assert trace.best.template_id == 1  # 0.5 x 9 against 0.7 x 5


def test_the_best_guess_answers_with_its_crop_and_the_seconds_of_all(traced):
    trace = run({1: (0.5, 9), 2: (0.3, 40), 3: (0.2, 10)})
    assert traced == [1, 2, 3]
    assert trace.query is not None
    assert trace.query.A_crop_img[0, 0] == 2
    assert trace.times_s["match"] == pytest.approx(0.3)
    assert "guess mask" in trace.times_s


def test_guesses_without_a_template_are_passed_over_and_the_first_reason_is_given(traced):
    assert run({1: (None, 0), 2: (0.4, 7)}).best.template_id == 2
    with pytest.raises(NoPose, match="guess 1"):
        run({1: (None, 0), 2: (None, 0)})
