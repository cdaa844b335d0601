import numpy as np
import pytest

from pipeline.items.records import scores_from_record, scores_to_record
from pipeline.items.scores import Scores
from pipeline.metrics.bootstrap import image_index, mean_interval, paired_interval
from pipeline.metrics.recall import (
    average_recall,
    instance_ar,
    recall_by_object,
    recall_by_threshold,
    recall_by_visibility,
)


def scores(count: int = 12, *, vsd: bool = True, seed: int = 0) -> Scores:
    rng = np.random.default_rng(seed)
    ids = [np.repeat(1, count), np.arange(count) // 3, np.arange(count) % 3 + 1, np.arange(count)]
    hits = [rng.random((count, 10)) < 0.5, rng.random((count, 10)) < 0.4]
    surface = rng.random((count, 10, 10)) < 0.3 if vsd else None
    return Scores(*ids, rng.random(count), *hits, surface, "" if vsd else "no depth")


def test_ar_is_the_mean_of_the_three_recalls_over_instances_and_thresholds():
    given = scores()
    recall = average_recall(given)
    assert recall.vsd == pytest.approx(given.vsd.mean())
    assert recall.mssd == pytest.approx(given.mssd.mean())
    assert recall.ar == pytest.approx((given.vsd.mean() + given.mssd.mean() + given.mspd.mean()) / 3)
    assert instance_ar(given).mean() == pytest.approx(recall.ar)


def test_without_vsd_ar_is_none_instead_of_0():
    recall = average_recall(scores(vsd=False))
    assert recall.vsd is None
    assert recall.ar is None
    assert recall.mssd_mspd == pytest.approx((recall.mssd + recall.mspd) / 2)
    assert set(recall_by_threshold(scores(vsd=False))) == {"mssd", "mspd"}


def test_theta_max_excludes_higher_thresholds():
    given = scores()
    recall = average_recall(given, theta_max=0.15)
    assert recall.mssd == pytest.approx(given.mssd[:, :3].mean())
    assert recall.mspd == pytest.approx(given.mspd[:, :3].mean())
    assert recall.vsd == pytest.approx(given.vsd[:, :, :3].mean())
    assert average_recall(given, theta_max=0.5) == average_recall(given)


def test_objects_and_bins_of_visibility_cover_every_instance_once():
    given = scores()
    objects = recall_by_object(given)
    assert set(objects) == {1, 2, 3}
    assert np.mean([recall.mssd for recall in objects.values()]) == pytest.approx(given.mssd.mean())
    bins = recall_by_visibility(given)
    assert sum(count for count, _ in bins.values()) == len(given)
    whole = given.select(np.arange(len(given)) < 1)
    whole.visib_fract[:] = 1.0
    assert list(recall_by_visibility(whole)) == [(0.8, 1.0)]


def test_scores_record_round_trip():
    for given in (scores(), scores(vsd=False), scores(0)):
        given.visib_fract[:1] = np.nan
        back = scores_from_record(scores_to_record(given))
        for name in ("scene_id", "im_id", "obj_id", "gt_id", "mssd", "mspd", "vsd"):
            np.testing.assert_array_equal(getattr(back, name), getattr(given, name))
        np.testing.assert_allclose(back.visib_fract, given.visib_fract, atol=1e-6)
        assert back.no_vsd == given.no_vsd


def test_interval_contains_the_mean_and_narrows_with_more_images():
    rng = np.random.default_rng(0)
    few, many = rng.random(20), rng.random(2000)
    narrow, wide = mean_interval(many, np.arange(2000) // 2), mean_interval(few, np.arange(20) // 2)
    assert wide.low < few.mean() < wide.high
    # 100 times the images: a tenth of the width, within a third
    assert (narrow.high - narrow.low) == pytest.approx((wide.high - wide.low) / 10, rel=0.34)
    # 1.96 standard errors of means of two uniform values, on both sides
    assert narrow.high - narrow.low == pytest.approx(2 * 1.96 * np.sqrt(1 / 24 / 1000), rel=0.1)


def test_instances_of_one_image_are_resampled_together():
    values = np.repeat(np.random.default_rng(0).random(10), 50)
    assert mean_interval(values, np.repeat(np.arange(10), 50)).high - values.mean() > 3 * (
        mean_interval(values, np.arange(500)).high - values.mean()
    )


def test_paired_difference_is_significant_where_separate_intervals_overlap():
    rng = np.random.default_rng(0)
    hard, image = rng.random(40), np.arange(40) // 2
    better = hard + 0.02
    assert mean_interval(hard, image).high > mean_interval(better, image).low
    difference = paired_interval(better, hard, image)
    assert difference.excludes_zero
    assert difference.mean == pytest.approx(0.02)
    assert not paired_interval(hard, hard, image).excludes_zero


def test_images_of_different_scenes_with_the_same_id_are_different():
    assert image_index(np.array([1, 1, 2]), np.array([5, 5, 5])).tolist() == [0, 0, 1]
