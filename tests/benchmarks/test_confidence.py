import json

import numpy as np

from benchmarks.confidence import Example, confidences, coverage_table, fit, fit_signed, measure, right
from benchmarks.validation import Case, read_cases, write_validation
from pipeline.bop.masks import decode_rle
from pipeline.confidence.calibration import SHIPPED, read_calibration
from pipeline.items.poses import Alternative, PoseEstimate


def examples(count: int = 200) -> list[Example]:
    """Poses whose cosine tells right from wrong; every fifth asks for an object that is not there."""
    rng = np.random.default_rng(0)
    made = []
    for k in range(count):
        good, wrong_mesh = k % 2 == 0, k % 10 == 1
        evidence = {"cosine": rng.normal(0.8 if good else 0.5, 0.1), "rival": rng.normal(0.6, 0.1), "inliers": 100.0}
        others = (Alternative(np.eye(4), 0.9),) if k % 4 == 1 else ()
        pose = PoseEstimate(
            0, k, 1, 0, np.eye(4), 0.5, 1.0, 0, 0.5, 0.2, 10, 5, 1.0, evidence=evidence, alternatives=others
        )
        case = Case(k, 1, 0, None if wrong_mesh else np.eye(4).tolist(), 0.3 + 0.7 * (k % 7) / 7, 0.9, "mask")
        made.append(Example(pose, case, 0.1 if good else np.inf if wrong_mesh else 0.6, (0.1,) * len(others)))
    return made


def test_weights_have_the_sign_that_their_evidence_must_have():
    rng = np.random.default_rng(1)
    x = rng.normal(size=(300, 2))
    correct = x[:, 0] - x[:, 1] + rng.normal(size=300) > 0
    bias, *weights = fit_signed(x, correct, (1, 1))
    assert weights[0] > 0.5
    assert weights[1] == 0
    assert abs(bias) < 0.5


def test_a_fitted_calibration_ranks_and_is_calibrated():
    given = examples()
    calibration = fit(given, {"extract": "extract.hog"}, {"extract": "0"}, "command")
    assert "cosine" in {term.name for term in calibration.terms}
    measured = measure(confidences(calibration, given), given, calibration.accept)
    assert measured["AUC"] > 0.95
    assert measured["calibration error"] < 0.1
    assert measured["right among accepted"] >= 0.95
    assert measured["accepted of wrong meshes"] < 0.2
    assert coverage_table(confidences(calibration, given), given, calibration.accept).count("\n") == 5
    assert calibration.rival_odds > 0
    assert right(given).sum() == 100


def test_scenes_are_a_dataset_with_detections_and_their_cases(tmp_path):
    write_validation(tmp_path / "scenes", seed=3, objects=2, images=2, per_image=2)
    detections = json.loads((tmp_path / "scenes" / "detections.json").read_text())
    cases = read_cases(tmp_path / "scenes")
    assert len(cases) == len(detections) >= 4
    for case, detection in zip(cases, detections, strict=True):
        assert (case.im_id, case.obj_id) == (detection["image_id"], detection["category_id"])
        assert (case.kind == "box") == ("segmentation" not in detection)
        if "segmentation" in detection:
            assert decode_rle(detection["segmentation"]).any()


def test_the_shipped_calibration_says_how_it_was_made():
    shipped = read_calibration(SHIPPED / "dzop_x.json")
    assert shipped.command == "python -m benchmarks.confidence"
    assert all(term.weight_20 or term.weight_10 for term in shipped.terms)
    assert 0.5 <= shipped.accept <= 0.99
