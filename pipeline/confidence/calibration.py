"""evidence -> the probability that a pose is right: a logistic regression, with its coefficients in a JSON file.

``python -m benchmarks.confidence`` fits it on procedural data and writes the file. A calibration is valid for one
method: with other variants of the stages or other features, the same evidence implies another probability.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter, ValidationError

from pipeline.bop.jsonio import read_json
from pipeline.errors import BadInput
from pipeline.items.poses import Decision, PoseEstimate
from pipeline.method import Stages
from pipeline.spec import digest

SHIPPED = Path(__file__).with_name("calibrations")
CALIBRATED_STAGES = ("extract", "crop", "match", "fuse", "cluster", "correspond", "solve", "choose", "refine")
"""A calibration is valid for one variant of each of these stages."""

_TRANSFORMS: Mapping[str, Callable[[float], float]] = {
    "linear": float,
    "log": lambda value: math.log(max(value, 1e-3)),
}


@dataclass(frozen=True)
class Term:
    """One term of the regression: (transform(evidence[name]) - mean) / scale, times a weight per error threshold.

    Missing evidence counts as the mean.
    """

    name: str
    transform: str
    mean: float
    scale: float
    weight_20: float
    weight_10: float

    def value(self, evidence: Mapping[str, float]) -> float:
        """The standardised value; 0, the mean, if it is missing."""
        if self.name not in evidence:
            return 0.0
        return (_TRANSFORMS[self.transform](evidence[self.name]) - self.mean) / self.scale


@dataclass(frozen=True)
class Calibration:
    """A fitted model. ``kinds`` and ``recipes`` (digests): of the stages that it was fitted with.

    ``bias_20``, ``bias_10``: intercepts for the thresholds of 20 % and 10 % of the diameter. A pose is accepted at a
    confidence of at least ``accept`` and rejected below ``reject``. An alternative is right with
    ``rival_odds * support ** rival_power`` times the probability of the pose. ``command``: wrote the file.
    ``measured``: quality on test scenes.
    """

    kinds: Mapping[str, str]
    recipes: Mapping[str, str]
    terms: tuple[Term, ...]
    bias_20: float
    bias_10: float
    accept: float
    reject: float
    rival_power: float
    rival_odds: float
    command: str
    measured: Mapping[str, Any]

    @property
    def digest(self) -> str:
        """Digest of everything that affects a confidence."""
        content = {name: value for name, value in asdict(self).items() if name not in ("command", "measured")}
        return digest(content | {"terms": [asdict(term) for term in self.terms]})

    def apply(self, estimate: PoseEstimate) -> PoseEstimate:
        """The estimate with confidence, decision, the weights of its alternatives, and the confidence as score.

        A fallback has no evidence: it gets no confidence and score 0, and is rejected.
        """
        if not estimate.evidence:
            return replace(estimate, score=0.0, decision="reject")
        confidence, confidence_10 = self.rate(estimate.evidence)
        return replace(
            estimate,
            score=confidence,
            confidence=confidence,
            confidence_10=confidence_10,
            decision=self.decide(confidence),
            alternatives=self._weigh(estimate, confidence),
        )

    def rate(self, evidence: Mapping[str, float]) -> tuple[float, float]:
        """Confidences of a pose with this evidence: for 20 % and 10 % of the diameter, the second never higher."""
        values = [term.value(evidence) for term in self.terms]
        weights = [(term.weight_20, term.weight_10) for term in self.terms]
        sum_20, sum_10 = np.array(values) @ np.array(weights)
        confidence = _logistic(self.bias_20 + sum_20)
        return confidence, min(confidence, _logistic(self.bias_10 + sum_10))

    def decide(self, confidence: float) -> Decision:
        """What to do with a pose of this confidence."""
        if confidence >= self.accept:
            return "accept"
        return "check" if confidence >= self.reject else "reject"

    def _weigh(self, estimate: PoseEstimate, confidence: float) -> tuple[Any, ...]:
        """The alternatives with their probabilities, which sum to 1 - confidence at most."""
        alternatives = estimate.alternatives
        likely = [confidence * self.rival_odds * min(a.support, 1.0) ** self.rival_power for a in alternatives]
        scale = min(1.0, (1 - confidence) / max(sum(likely), 1e-12))
        return tuple(replace(a, weight=scale * weight) for a, weight in zip(alternatives, likely, strict=True))


def choose_calibration(stages: Stages, choice: str) -> Calibration | None:
    """The calibration of a method. ``choice``: "auto" (one that ships, or None if none fits), "none", or a JSON file.

    Raises BadInput for a file that was fitted with other variants of stages.
    """
    if choice == "none":
        return None
    kinds = identify_variants(stages)
    if choice != "auto":
        chosen = read_calibration(Path(choice).expanduser())
        if other := [name for name in kinds if chosen.kinds.get(name) != kinds[name]]:
            found = f"{choice}, fitted with {chosen.kinds.get(other[0])} as {other[0]}"
            raise BadInput("confidence", found=found, needed=f"a calibration for {kinds[other[0]]}, auto or none")
        return chosen
    shipped = (read_calibration(path) for path in sorted(SHIPPED.glob("*.json")))
    return next((calibration for calibration in shipped if calibration.kinds == kinds), None)


def identify_variants(stages: Stages) -> dict[str, str]:
    """The kind of each stage that a calibration depends on. Reads no weights."""
    kinds = {name: getattr(stages, name).kind for name in CALIBRATED_STAGES}
    return kinds | {"second look": "drawn" if stages.second_look.hypotheses else "none"}


def identify_settings(stages: Stages) -> dict[str, str]:
    """Digest of the recipe of each stage that a calibration depends on. Raises NotDownloaded."""
    recipes = {name: digest(getattr(stages, name).recipe()) for name in CALIBRATED_STAGES}
    return recipes | {"second look": digest(stages.second_look.recipe())}


def describe_confidence(stages: Stages, calibration: Calibration | None, choice: str) -> str:
    """A warning if poses get no confidence, or one that was fitted with other settings; otherwise ""."""
    if choice == "none":
        return ""
    refit = "python -m benchmarks.confidence fits one"
    if calibration is None:
        return f"poses have no confidence: no calibration was fitted for this method and these features; {refit}"
    recipes = identify_settings(stages)
    other = [name for name, recipe in recipes.items() if calibration.recipes.get(name) != recipe]
    if not other:
        return ""
    return f"the confidence was fitted with other settings of {', '.join(other)}; {refit}"


@cache
def read_calibration(path: Path) -> Calibration:
    """The calibration in a JSON file. Raises BadInput."""
    content = read_json(path)
    try:
        return TypeAdapter(Calibration).validate_python(content)
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(map(str, first["loc"])) or "content"
        needed = "a file that python -m benchmarks.confidence wrote"
        raise BadInput(f"{path}, field {field}", found=first["msg"].lower(), needed=needed) from None


def _logistic(x: float) -> float:
    return 1 / (1 + math.exp(-float(np.clip(x, -30, 30))))
