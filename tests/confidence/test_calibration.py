import json
from dataclasses import asdict, replace

import numpy as np
import pytest

from pipeline.confidence.calibration import (
    Calibration,
    Term,
    choose_calibration,
    describe_confidence,
    identify_settings,
    identify_variants,
    read_calibration,
)
from pipeline.configuration import build_stages
from pipeline.errors import BadInput
from pipeline.items.poses import Alternative, PoseEstimate

EYE = np.eye(4)
TERMS = (Term("inliers", "log", 5.0, 1.0, 2.0, 1.0), Term("cosine", "linear", 0.5, 0.1, 1.0, 1.0))


def calibration(**changed) -> Calibration:
    return replace(
        Calibration(kinds={}, recipes={}, terms=TERMS, bias_20=0.0, bias_10=-1.0, accept=0.9, reject=0.2,
                    rival_power=2.0, rival_odds=0.5, command="", measured={}),
        **changed,
    )  # fmt: skip


def estimate(evidence: dict[str, float], *supports: float) -> PoseEstimate:
    others = tuple(Alternative(EYE, support) for support in supports)
    return PoseEstimate(0, 0, 1, 0, EYE, 0.5, 1.0, 0, 0.5, 0.2, 10, 5, 1.0, evidence=evidence, alternatives=others)


def stages_of(*overrides: str):
    from hydra import compose, initialize_config_dir
    from omegaconf import OmegaConf

    from pipeline.configuration import CONF

    with initialize_config_dir(str(CONF), version_base="1.3"):
        return build_stages(OmegaConf.to_container(compose("config", list(overrides)), resolve=True))


def test_confidence_is_the_logistic_sum_of_the_evidence():
    found = calibration().apply(estimate({"inliers": np.exp(6.0), "cosine": 0.63}))
    total = 2.0 * 1.0 + 1.0 * (0.63 - 0.5) / 0.1
    assert found.confidence == pytest.approx(1 / (1 + np.exp(-total)))
    assert found.score == found.confidence
    assert found.confidence_10 == pytest.approx(1 / (1 + np.exp(-(total - 1.0 - 1.0))))
    assert found.decision == "accept"
    assert calibration().apply(estimate({"inliers": 1.0})).decision == "reject"


def test_missing_evidence_counts_as_its_mean_and_a_fallback_is_rejected():
    assert calibration().apply(estimate({"other": 3.0})).confidence == pytest.approx(0.5)
    fallback = calibration().apply(estimate({}))
    assert (fallback.confidence, fallback.decision, fallback.score) == (None, "reject", 0.0)


def test_alternatives_weigh_by_their_support_and_share_at_most_what_is_left():
    weighed = estimate({"other": 1.0}, 1.0, 0.5)  # of confidence 0.5
    found = calibration().apply(weighed)
    assert [a.weight for a in found.alternatives] == pytest.approx([0.5 * 0.5, 0.5 * 0.5 * 0.25])
    equal = calibration(rival_odds=1.0).apply(estimate({"other": 1.0}, 1.0))
    assert equal.alternatives[0].weight == equal.confidence == 0.5
    crowded = calibration(rival_odds=1.0).apply(estimate({"other": 1.0}, 1.0, 1.0))
    assert [a.weight for a in crowded.alternatives] == pytest.approx([0.25, 0.25])


def test_file_is_read_back_and_a_wrong_one_is_refused(tmp_path):
    path = tmp_path / "own.json"
    path.write_text(json.dumps(asdict(calibration())))
    assert read_calibration(path) == calibration()
    assert calibration().digest == replace(calibration(), command="other").digest
    assert calibration().digest != replace(calibration(), bias_20=0.1).digest
    broken = tmp_path / "broken.json"
    broken.write_text('{"kinds": {}}')
    with pytest.raises(BadInput, match=r"broken.json, field recipes: found .*, needs a file that"):
        read_calibration(broken)


def test_calibration_belongs_to_the_variants_of_a_method(tmp_path):
    stages = stages_of("extract=pixels")
    kinds, recipes = identify_variants(stages), identify_settings(stages)
    path = tmp_path / "pixels.json"
    path.write_text(json.dumps(asdict(calibration(kinds=kinds, recipes=recipes))))
    chosen = choose_calibration(stages, str(path))
    assert describe_confidence(stages, chosen, str(path)) == ""
    other = stages_of("extract=pixels", "match.top_k=3")
    assert "other settings of match" in describe_confidence(other, choose_calibration(other, str(path)), "auto")
    with pytest.raises(BadInput, match=r"fitted with extract.pixels as extract, needs .* extract.hog"):
        choose_calibration(stages_of("extract=hog"), str(path))
    assert choose_calibration(stages, "none") is None
    assert "poses have no confidence" in describe_confidence(stages, choose_calibration(stages, "auto"), "auto")
