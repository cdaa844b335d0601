import numpy as np
import pytest

from pipeline.functional.boxes import area, iou, non_maximum_suppression


def some_boxes(n: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    low = rng.integers(0, 30, (n, 2))
    return np.concatenate([low, low + rng.integers(1, 20, (n, 2))], axis=1) - 0.5


def rasterize(box: np.ndarray) -> np.ndarray:
    """The box as a mask: pixel i covers [i - 0.5, i + 0.5]."""
    x0, y0, x1, y1 = (box + 0.5).astype(int)
    mask = np.zeros((60, 60), bool)
    mask[y0:y1, x0:x1] = True
    return mask


def suppress_by_loop(boxes: np.ndarray, score: np.ndarray, max_iou: float) -> np.ndarray:
    masks = [rasterize(box) for box in boxes]
    kept: list[int] = []
    for i in sorted(range(len(boxes)), key=lambda i: -score[i]):
        overlaps = [(masks[i] & masks[j]).sum() / (masks[i] | masks[j]).sum() for j in kept]
        if all(overlap <= max_iou for overlap in overlaps):
            kept.append(i)
    return np.isin(np.arange(len(boxes)), kept)


@pytest.mark.parametrize("max_iou", [0.0, 0.25, 0.7, 1.0])
def test_suppression_equals_a_loop_over_masks(max_iou: float):
    boxes, score = some_boxes(80), np.random.default_rng(1).random(80)
    np.testing.assert_array_equal(
        non_maximum_suppression(boxes, score, max_iou=max_iou), suppress_by_loop(boxes, score, max_iou)
    )


def test_result_does_not_depend_on_the_order_of_boxes():
    boxes, score = some_boxes(50), np.random.default_rng(1).permutation(50) / 50
    order = np.random.default_rng(2).permutation(50)
    kept = non_maximum_suppression(boxes, score, max_iou=0.3)
    np.testing.assert_array_equal(non_maximum_suppression(boxes[order], score[order], max_iou=0.3), kept[order])


def test_iou_equals_that_of_pixel_masks():
    boxes = some_boxes(20)
    counted = [(rasterize(boxes[0]) & rasterize(b)).sum() / (rasterize(boxes[0]) | rasterize(b)).sum() for b in boxes]
    np.testing.assert_allclose(iou(boxes[0], boxes), counted, atol=1e-12)
    np.testing.assert_array_equal(area(boxes), [rasterize(b).sum() for b in boxes])


def test_ties_go_to_the_first_box():
    boxes = np.repeat(some_boxes(1), 3, axis=0)
    assert non_maximum_suppression(boxes, np.ones(3), max_iou=0.5).tolist() == [True, False, False]


def test_empty_boxes_and_empty_lists_are_supported():
    assert iou(np.zeros(4), np.zeros((2, 4))).tolist() == [0, 0]
    assert non_maximum_suppression(np.zeros((0, 4)), np.zeros(0), max_iou=0.5).tolist() == []
