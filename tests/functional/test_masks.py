import cv2
import numpy as np
import pytest
import torch

from pipeline.functional.masks import cell_coverage, cell_mask, erode, foreground, open_mask


def test_coverage_keeps_the_area_for_any_ratio_of_pixels_to_cells():
    mask = torch.rand(5, 37, 37, generator=torch.Generator().manual_seed(0)) < 0.4
    for cells in (3, 8, 37, 50):
        area = cell_coverage(mask, cells=cells).mean((1, 2))
        assert torch.allclose(area, mask.float().mean((1, 2)), atol=1e-6)  # float32 sums of 2500 cells


def test_coverage_of_aligned_cells_is_the_mean_of_their_pixels():
    mask = torch.rand(8, 8, generator=torch.Generator().manual_seed(1)) < 0.5
    expected = torch.tensor(
        [[mask[2 * i : 2 * i + 2, 2 * j : 2 * j + 2].float().mean() for j in range(4)] for i in range(4)]
    )
    assert torch.equal(cell_coverage(mask, cells=4), expected)


def test_cell_covered_by_half_is_foreground():
    mask = torch.zeros(4, 4, dtype=torch.bool)
    mask[0, :2] = True  # half of the upper left cell
    mask[2, 2] = True  # a quarter of the lower right one
    assert cell_mask(mask, cells=2).tolist() == [[True, False], [False, False]]


def test_mask_of_one_pixel_keeps_its_best_covered_cell():
    masks = torch.zeros(2, 128, 128, dtype=torch.bool)
    masks[0, 100, 17] = True
    cells = cell_mask(masks, cells=8)
    assert cells[0].nonzero().tolist() == [[6, 1]]
    assert not cells[1].any()


def test_foreground_lists_cells_in_reading_order():
    assert foreground(torch.tensor([[False, True], [True, False]])).tolist() == [1, 2]


@pytest.mark.parametrize("radius", [0, 1, 2])
def test_erosion_and_opening_are_opencvs(radius):
    rng, square = np.random.default_rng(radius), np.ones((2 * radius + 1,) * 2, np.uint8)
    for density in (0.5, 0.9, 0.99):
        mask = rng.random((31, 44)) < density
        assert np.array_equal(erode(mask, radius=radius), cv2.erode(mask.astype(np.uint8), square) > 0)
        opened = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, square) > 0
        assert np.array_equal(open_mask(mask, radius=radius), opened)


def test_a_mask_that_reaches_the_images_border_is_not_eroded_there():
    mask = np.zeros((9, 9), bool)
    mask[:4] = True
    assert erode(mask, radius=1).sum() == 3 * 9
    assert np.array_equal(open_mask(mask, radius=1), mask)
