import numpy as np
import pytest

from pipeline.metrics.reliability import calibration_error, ranking_auc, reliability_bins


def test_confidence_that_is_the_share_of_right_poses_has_no_error():
    confidence = np.repeat([0.25, 0.75], 40)
    right = np.concatenate([np.arange(40) < 10, np.arange(40) < 30])
    assert calibration_error(confidence, right) == pytest.approx(0.0)
    assert calibration_error(confidence, ~right) == pytest.approx(0.5)
    assert [b.count for b in reliability_bins(confidence, right)] == [40, 40]


def test_certain_confidence_is_in_the_last_bin():
    (only,) = reliability_bins(np.ones(3), np.array([True, True, False]))
    assert (only.count, only.confidence) == (3, 1.0)


def test_auc_is_that_of_scikit_learn():
    from sklearn.metrics import roc_auc_score

    rng = np.random.default_rng(0)
    right, confidence = rng.random(200) < 0.6, np.round(rng.random(200), 1)
    assert ranking_auc(confidence, right) == pytest.approx(roc_auc_score(right, confidence))
    assert np.isnan(ranking_auc(confidence, np.ones(200, bool)))
