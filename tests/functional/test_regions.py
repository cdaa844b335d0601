"""Proposals of regions on drawn pictures: known objects are found, limits and overlaps are respected."""

import cv2
import numpy as np
import pytest

from pipeline.functional.regions import propose_regions

LIMITS = {"side": 160, "smallest": 0.1, "largest": 0.67, "overlap": 0.75}


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / (a | b).sum())


@pytest.fixture(scope="module")
def scene() -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """A noisy wall with a red disc and a box of two colours, and the mask of each."""
    rng = np.random.default_rng(0)
    rgb = np.full((120, 160, 3), (150, 150, 140), np.uint8)
    disc, box = (np.zeros((120, 160), np.uint8) for _ in range(2))
    cv2.circle(disc, (40, 60), 18, 1, -1)
    cv2.rectangle(box, (90, 30), (130, 80), 1, -1)
    rgb[disc > 0] = (180, 40, 40)
    rgb[box > 0] = (40, 60, 160)
    rgb[30:50][box[30:50] > 0] = (30, 90, 190)
    noisy = np.clip(rgb + rng.normal(0, 3, rgb.shape), 0, 255).astype(np.uint8)
    return noisy, {"disc": disc > 0, "box": box > 0}


def test_objects_of_one_and_of_two_colours_are_among_the_regions(scene):
    rgb, objects = scene
    found = propose_regions(rgb, **LIMITS)
    for mask in objects.values():
        assert max(iou(mask, region) for region in found) > 0.8


def test_regions_are_neither_too_small_nor_too_large_nor_near_duplicates(scene):
    found = propose_regions(scene[0], **LIMITS)
    assert all(mask.shape == (120, 160) and mask.dtype == bool for mask in found)
    for mask in found:
        extent = max(np.ptp(np.flatnonzero(mask.any(axis))) + 1 for axis in (0, 1))
        assert extent <= 0.67 * 160
        assert extent >= 0.1 * 0.7 * 160 - 2  # opening removes a pixel on each side
    pairs = [iou(a, b) for n, a in enumerate(found) for b in found[:n]]
    assert max(pairs) < 0.8  # 0.75 before the opening


def test_a_larger_photograph_has_the_regions_of_the_smaller_one_scaled_up(scene):
    rgb, objects = scene
    large = cv2.resize(rgb, (480, 360), interpolation=cv2.INTER_NEAREST)
    found = propose_regions(large, **LIMITS)
    disc = cv2.resize(objects["disc"].astype(np.uint8), (480, 360), interpolation=cv2.INTER_NEAREST) > 0
    assert max(iou(disc, region) for region in found) > 0.8


def test_a_photograph_of_one_colour_has_no_region():
    assert propose_regions(np.full((40, 60, 3), 90, np.uint8), **LIMITS) == []


def test_regions_are_the_same_every_time(scene):
    first, second = (propose_regions(scene[0], **LIMITS) for _ in range(2))
    assert all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))
