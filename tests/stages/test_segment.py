"""Boxes become masks: on discs in front of plain and noisy walls, where the true mask is known."""

import numpy as np
import pytest

from pipeline.bop.masks import encode_rle
from pipeline.functional.boxes import pixels_inside
from pipeline.functional.camera import mask_bbox
from pipeline.graph.checks import box_warnings
from pipeline.items.views import Detection
from pipeline.stages.segment.grabcut import Grabcut
from pipeline.stages.segment.none import NoSegmentation


def disc(size_hw=(120, 160), centre=(80, 60), radius=30) -> np.ndarray:
    y, x = np.mgrid[: size_hw[0], : size_hw[1]]
    return (x - centre[0]) ** 2 + (y - centre[1]) ** 2 < radius**2


def photograph(mask: np.ndarray, noise: float = 6.0) -> np.ndarray:
    rng = np.random.default_rng(3)
    rgb = np.where(mask[..., None], (200, 60, 40), (70, 90, 120)) + rng.normal(0, noise, (*mask.shape, 3))
    return np.clip(rgb, 0, 255).astype(np.uint8)


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / (a | b).sum())


@pytest.mark.parametrize("radius", [8, 30, 55])
def test_a_box_around_a_disc_becomes_the_disc(radius: int):
    mask = disc(radius=radius)
    found = Grabcut()(photograph(mask), mask_bbox(mask))
    assert iou(found, mask) > 0.93


def test_a_large_box_is_cut_at_a_lower_resolution():
    mask = disc((600, 800), (400, 300), 200)
    assert iou(Grabcut()(photograph(mask), mask_bbox(mask)), mask) > 0.97


def test_the_same_image_and_box_give_the_same_mask_whatever_was_cut_before():
    mask = disc()
    rgb = photograph(mask, noise=60.0)
    first = Grabcut()(rgb, mask_bbox(mask))
    Grabcut()(rgb[:, ::-1].copy(), (10.0, 10.0, 90.0, 100.0))
    assert np.array_equal(first, Grabcut()(rgb, mask_bbox(mask)))


def test_no_pixel_outside_the_box_is_taken():
    mask = disc()
    x0, y0, x1, y1 = mask_bbox(mask)
    found = Grabcut()(photograph(mask), (x0, y0, x1 - 6, y1))
    assert iou(found, mask) > 0.8
    assert not found[:, int(x1) - 5 :].any()


@pytest.mark.parametrize(
    "box", [(-0.5, -0.5, 159.5, 119.5), (20.0, 20.0, 22.0, 60.0), (300.0, 10.0, 340.0, 60.0)], ids=str
)
def test_the_box_stays_where_it_fills_the_image_is_tiny_or_lies_outside(box):
    assert Grabcut()(photograph(disc()), box) is None


def test_the_box_stays_where_hardly_anything_is_found():
    speck = disc(radius=4)
    assert Grabcut()(photograph(speck), (30.5, 20.5, 130.5, 110.5)) is None


def test_further_guesses_are_another_cut_and_the_ellipse_in_the_box():
    mask = disc()
    first, second = Grabcut().others(photograph(mask), mask_bbox(mask))
    assert iou(first, mask) > 0.9
    assert iou(second, mask) > 0.95
    assert len(list(Grabcut(guesses=2).others(photograph(mask), mask_bbox(mask)))) == 1
    assert list(Grabcut(guesses=1).others(photograph(mask), mask_bbox(mask))) == []
    assert list(NoSegmentation().others(photograph(mask), mask_bbox(mask))) == []


def test_none_leaves_every_box():
    assert NoSegmentation()(photograph(disc()), mask_bbox(disc())) is None


@pytest.mark.parametrize("box", [(9.5, 4.5, 13.5, 24.5), (-3.0, -2.0, 4.0, 3.0), (9.2, 4.9, 13.0, 24.0)], ids=str)
def test_pixels_inside_are_those_whose_centre_is(box):
    x, y = np.arange(48), np.arange(64)
    expected = ((y >= box[1]) & (y <= box[3]))[:, None] & ((x >= box[0]) & (x <= box[2]))
    mask = np.zeros((64, 48), bool)
    mask[pixels_inside(box, (64, 48))] = True
    assert np.array_equal(mask, expected)


@pytest.mark.parametrize(("segment", "advice"), [(NoSegmentation(), "segment=grabcut"), (Grabcut(), "masks would")])
def test_one_line_says_how_many_detections_are_boxes_and_what_that_costs(segment, advice):
    box, mask = Detection(1, 2, 3, 1.0, 0.0, (0.0, 0.0, 9.0, 9.0)), encode_rle(disc())
    masked = Detection(1, 2, 4, 1.0, 0.0, (0.0, 0.0, 9.0, 9.0), mask)
    (line,) = box_warnings([masked, box, box], segment)
    assert line.startswith("2 of 3 detections are boxes without a mask (the first is scene 1, image 2, object 3)")
    assert "most such poses are wrong" in line
    assert advice in line
    assert box_warnings([masked], segment) == []
