"""Fit the confidence of a method's poses on procedural scenes, and measure it on scenes of other seeds.

    python -m benchmarks.confidence                              # the default method; writes the file that ships
    python -m benchmarks.confidence method=dzop --out dzop.json  # another method; use it with confidence=dzop.json

A pose is right if its MSSD is below 20 % (or 10 %) of the diameter. Detections are those of a simulated detector; some
are of an object that is not in the image. Prints tables in Markdown. Runs are cached.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from hydra import compose, initialize_config_dir
from jaxtyping import Bool, Float
from omegaconf import OmegaConf
from scipy.optimize import minimize
from scipy.special import expit, logsumexp

from benchmarks.accuracy import path_override
from benchmarks.run_pool import run_all
from benchmarks.validation import Case, read_cases, write_validation
from pipeline.bop.dataset import open_dataset
from pipeline.confidence.calibration import SHIPPED, Calibration, Term, identify_settings, identify_variants
from pipeline.configuration import CONF, build_stages
from pipeline.errors import BadInput, DzopError
from pipeline.io.files import write_json
from pipeline.items.poses import PoseEstimate
from pipeline.items.records import answer_from_record
from pipeline.metrics.pose_error import hull_vertices, mssd
from pipeline.metrics.reliability import calibration_error, ranking_auc

FIT_SEEDS, TEST_SEEDS = (11, 13), (12,)
OBJECTS, IMAGES = 10, 48
VIEWS = 300
LIMITS = (0.2, 0.1)
"""Of the diameter: a pose with a smaller MSSD is right."""
ACCEPT_FROM, REJECT_BELOW = 0.9, 0.2
"""Thresholds of the decision, fixed: one fitted to a share of right poses does not hold on other seeds."""
TERMS = (
    ("inliers", "log", 1),
    ("inlier_ratio", "linear", 1),
    ("reprojection", "log", -1),
    ("similarity", "linear", 1),
    ("cosine", "linear", 1),
    ("coverage", "linear", 1),
    ("agreeing", "linear", 1),
    ("rival", "linear", -1),
    ("overlap", "linear", 1),
    ("explained", "linear", 1),
    ("visible", "linear", 1),
    ("moved", "log", -1),
    ("template_score", "linear", 1),
    ("template_margin", "log", 1),
    ("crop_px", "log", 1),
)
"""Name of the evidence, its transform, and the sign of its weight: 1 if larger values speak for the pose, or -1."""
STRENGTH = 0.3
"""Inverse of L2 regularisation, as C in scikit-learn's LogisticRegression; cross-validated over objects."""


@dataclass(frozen=True, eq=False)
class Example:
    """A pose with its error over the diameter, infinite if the detection has another object's mesh.

    ``rivals``: the errors of its alternatives.
    """

    estimate: PoseEstimate
    case: Case
    error: float
    rivals: tuple[float, ...]


def collect(folder: Path, seed: int, overrides: Sequence[str]) -> list[Example]:
    """Make the scenes of a seed, estimate poses, and measure their errors."""
    root = folder / "data" / f"{seed}_{OBJECTS}_{IMAGES}"
    if not (root / "cases.json").is_file():
        write_validation(root, seed=seed, objects=OBJECTS, images=IMAGES)
    out = folder / "results" / f"{seed}"
    data = ["dataset=bop", "dataset.name=confidence", path_override("dataset.root", root), f"render.count={VIEWS}"]
    asked = ["detect=json", path_override("detect.path", root / "detections.json"), "detect.keep=all"]
    places = [path_override("out", out), path_override("store.root", folder / "cache"), "confidence=none", "threads=1"]
    quiet = ["step=estimate", "overlays=false", "gallery=0", "runtime.progress=false"]
    run_all({("confidence", f"seed {seed}"): [*data, *asked, *places, *quiet, *overrides]}, jobs=1)
    newest = max(out.glob("*/*/poses.json"), key=lambda path: path.stat().st_mtime)
    records = json.loads(newest.read_text())["answers"]
    return _measure(root, [{name: value for name, value in r.items() if name != "errors"} for r in records])


def _measure(root: Path, records: Sequence[Mapping[str, Any]]) -> list[Example]:
    data = open_dataset(root, name="confidence", targets="test_targets_bop19.json")
    models = {k: data.object_model(k, folder="models_eval") for k in data.object_ids}
    hulls = {k: hull_vertices(model.mesh.vertices) for k, model in models.items()}
    cases = {(c.im_id, c.obj_id, c.nth): c for c in read_cases(root)}
    examples = []
    for answer in map(answer_from_record, records):
        if not isinstance(answer, PoseEstimate):
            continue
        case, model = cases[answer.im_id, answer.obj_id, answer.detection_id], models[answer.obj_id]
        poses = [answer.T_cam_obj, *(alternative.T_cam_obj for alternative in answer.alternatives)]
        errors = [np.inf] * len(poses)
        if case.T_cam_obj is not None:
            T_true, hull = np.array(case.T_cam_obj), hulls[answer.obj_id]
            errors = [mssd(T, T_true, hull, model.symmetries) / model.diameter_mm for T in poses]
        examples.append(Example(answer, case, float(errors[0]), tuple(errors[1:])))
    return examples


def fit(examples: Sequence[Example], kinds: Mapping[str, str], recipes: Mapping[str, str], command: str) -> Calibration:
    """Fit the calibration of a method to its poses."""
    available = {name for example in examples for name in example.estimate.evidence}
    chosen = [(name, transform, sign) for name, transform, sign in TERMS if name in available]
    terms = [_standardise(Term(name, transform, 0.0, 1.0, 0.0, 0.0), examples) for name, transform, _ in chosen]
    x, signs = _values(terms, examples), [sign for *_, sign in chosen]
    (bias_20, *w_20), (bias_10, *w_10) = (fit_signed(x, right(examples, limit), signs) for limit in LIMITS)
    rival_power, rival_odds = fit_rivals(examples)
    weights = zip(terms, w_20, w_10, strict=True)
    fitted = [replace(term, weight_20=round(float(a), 5), weight_10=round(float(b), 5)) for term, a, b in weights]
    fitted = [term for term in fitted if term.weight_20 or term.weight_10]
    return Calibration(
        kinds=kinds,
        recipes=recipes,
        terms=tuple(fitted),
        bias_20=round(float(bias_20), 5),
        bias_10=round(float(bias_10), 5),
        accept=ACCEPT_FROM,
        reject=REJECT_BELOW,
        rival_power=rival_power,
        rival_odds=rival_odds,
        command=command,
        measured={},
    )


def fit_signed(
    x: Float[np.ndarray, "n k"], correct: Bool[np.ndarray, " n"], signs: Sequence[int]
) -> Float[np.ndarray, " k+1"]:
    """Bias and weights of a logistic regression whose weights have the given signs or are 0.

    A weight of the other sign would fit peculiarities of the training scenes.
    """
    y = np.where(correct, 1.0, -1.0)

    def loss(w: Float[np.ndarray, " k+1"]) -> tuple[float, Float[np.ndarray, " k+1"]]:
        z = y * (x @ w[1:] + w[0])
        pull = -y * expit(-z)
        value = np.logaddexp(0, -z).sum() + 0.5 / STRENGTH * (w[1:] ** 2).sum()
        return float(value), np.concatenate([[pull.sum()], x.T @ pull + w[1:] / STRENGTH])

    bounds = [(None, None), *((0, None) if sign > 0 else (None, 0) for sign in signs)]
    found = minimize(loss, np.zeros(x.shape[1] + 1), jac=True, bounds=bounds, method="L-BFGS-B")
    return np.asarray(found.x)


def _standardise(term: Term, examples: Sequence[Example]) -> Term:
    raw = np.array([term.value(e.estimate.evidence) for e in examples if term.name in e.estimate.evidence])
    return replace(term, mean=round(float(raw.mean()), 6), scale=round(float(max(raw.std(), 1e-6)), 6))


def _values(terms: Sequence[Term], examples: Sequence[Example]) -> Float[np.ndarray, "n k"]:
    return np.array([[term.value(e.estimate.evidence) for term in terms] for e in examples])


def fit_rivals(examples: Sequence[Example]) -> tuple[float, float]:
    """``rival_power`` and ``rival_odds`` of a calibration, by maximum likelihood (conditional logit).

    Uses the poses of which exactly one, or one of its alternatives, is right. Without any, no alternative is likely.
    """
    sets: list[tuple[int, Float[np.ndarray, " k"]]] = []
    for e in examples:
        is_right = [error < LIMITS[0] for error in (e.error, *e.rivals)]
        if e.rivals and sum(is_right) == 1:
            support = np.array([alternative.support for alternative in e.estimate.alternatives])
            sets.append((is_right.index(True), np.log(np.clip(support, 1e-3, 1.0))))
    if not sets:
        return 1.0, 0.0

    def loss(w: Float[np.ndarray, " 2"]) -> float:
        logits = [np.concatenate([[0.0], w[0] * log_support - w[1]]) for _, log_support in sets]
        return float(sum(logsumexp(z) - z[chosen] for z, (chosen, _) in zip(logits, sets, strict=True)))

    power, minus_log_odds = minimize(loss, [4.0, 1.0], bounds=[(0, 50), (0, 10)], method="L-BFGS-B").x
    return round(float(power), 2), round(float(np.exp(-minus_log_odds)), 3)


def right(examples: Sequence[Example], limit: float = LIMITS[0]) -> Bool[np.ndarray, " n"]:
    """Whether each pose is right."""
    return np.array([e.error < limit for e in examples])


def confidences(calibration: Calibration, examples: Sequence[Example]) -> Float[np.ndarray, " n"]:
    """Confidence of each pose; 0 if unknown."""
    return np.array([calibration.apply(e.estimate).confidence or 0.0 for e in examples])


def measure(confidence: Float[np.ndarray, " n"], examples: Sequence[Example], accept: float) -> dict[str, float]:
    """AUC of all poses and of those with the right mesh, calibration error, and shares of accepted poses."""
    correct, true_mesh = right(examples), np.array([e.case.T_cam_obj is not None for e in examples])
    chosen = confidence >= accept
    old = np.array([e.estimate.score for e in examples])
    found = {
        "poses": float(len(examples)),
        "right": float(correct.mean()),
        "AUC": ranking_auc(confidence, correct),
        "AUC of the right mesh": ranking_auc(confidence[true_mesh], correct[true_mesh]),
        "AUC of the former score": ranking_auc(old, correct),
        "calibration error": calibration_error(confidence, correct),
        "accepted": float(chosen.mean()),
        "right among accepted": float(correct[chosen].mean()) if chosen.any() else 1.0,
        "accepted of the right ones": float(chosen[correct].mean()),
    }
    if not true_mesh.all():
        found["accepted of wrong meshes"] = float(chosen[~true_mesh].mean())
    return {name: round(value, 4) for name, value in found.items()}


def coverage_table(confidence: Float[np.ndarray, " n"], examples: Sequence[Example], accept: float) -> str:
    """A Markdown table: shares of right and accepted poses by visible fraction, for the right mesh."""
    lines = ["| visible | poses | right | accepted | right among accepted |", "|---" * 5 + "|"]
    for low, high in ((0.0, 0.4), (0.4, 0.6), (0.6, 0.8), (0.8, 1.01)):
        at = np.array([e.case.T_cam_obj is not None and low <= e.case.visible < high for e in examples])
        if not at.any():
            continue
        correct, chosen = right(examples)[at], confidence[at] >= accept
        among = f"{correct[chosen].mean():.3f}" if chosen.any() else "-"
        shares = f"{correct.mean():.3f} | {chosen.mean():.3f} | {among}"
        lines.append(f"| {low:.0%} to {min(high, 1):.0%} | {at.sum()} | {shares} |")
    return "\n".join(lines)


def benchmark(folder: Path, out: Path, overrides: Sequence[str]) -> str:
    """Fit on the seeds for fitting, measure on those for testing, write the calibration; returns tables in Markdown."""
    stages = _stages(overrides)
    kinds, recipes = identify_variants(stages), identify_settings(stages)
    fitting = [e for seed in FIT_SEEDS for e in collect(folder, seed, overrides)]
    testing = [e for seed in TEST_SEEDS for e in collect(folder, seed, overrides)]
    written = [] if out == SHIPPED / "dzop_x.json" else ["--out", str(out)]
    command = " ".join(["python -m benchmarks.confidence", *overrides, *written])
    calibration = fit(fitting, kinds, recipes, command)
    confidence = confidences(calibration, testing)
    measured = measure(confidence, testing, calibration.accept)
    calibration = replace(calibration, measured=measured)
    write_json(out, asdict(calibration))
    lines = ["| measured on seeds never used to fit | value |", "|---|---|"]
    lines += [f"| {name} | {value:g} |" for name, value in measured.items()]
    table = coverage_table(confidence, testing, calibration.accept)
    return "\n".join([*lines, "", table, "", f"accepted from {calibration.accept:g}; written {out}"])


def _stages(overrides: Sequence[str]) -> Any:
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("config", [*overrides])
    return build_stages(OmegaConf.to_container(config, resolve=True))  # type: ignore[arg-type]


def main() -> None:
    """Parse the options, fit, measure, print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.confidence", description=__doc__)
    add, default = parser.add_argument, "(default: %(default)s)"
    add("--folder", type=Path, default=Path("cache/confidence"), help=f"for scenes, cache and results {default}")
    add("--out", type=Path, default=SHIPPED / "dzop_x.json", help=f"file of the calibration {default}")
    add("overrides", nargs="*", help="the method, such as method=dzop")
    options = parser.parse_intermixed_args()
    if options.overrides and options.out == SHIPPED / "dzop_x.json":
        parser.error("--out: found nothing, needs a file for the calibration of another method than the default")
    try:
        print(benchmark(options.folder.resolve(), options.out, options.overrides))
    except (DzopError, BadInput) as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
