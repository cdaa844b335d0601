"""How regions are compared with templates: known values, and what must not matter."""

import numpy as np
import pytest
import torch

from pipeline.functional.resemblance import best_colour_match, best_masked_cosine, colour_profile


def test_masked_cosine_is_the_share_of_equal_cells_among_those_in_either_mask():
    maps = torch.nn.functional.normalize(torch.randn(1, 5, 4, 4, generator=torch.Generator().manual_seed(0)), dim=1)
    query, template = torch.zeros(1, 4, 4, dtype=torch.bool), torch.zeros(1, 4, 4, dtype=torch.bool)
    query[0, :3], template[0, 1:] = True, True  # 8 cells in both, 16 in either
    assert best_masked_cosine(maps, query, 3 * maps, template).item() == pytest.approx(0.5, abs=1e-6)


def test_the_best_template_counts():
    maps = torch.randn(3, 5, 4, 4, generator=torch.Generator().manual_seed(0))
    mask = torch.ones(3, 4, 4, dtype=torch.bool)
    assert best_masked_cosine(maps[:1], mask[:1], maps, mask).item() == pytest.approx(1, abs=1e-6)


def picture(*colours: tuple[int, int, int]) -> np.ndarray:
    """Stripes of these colours, 64 x 64."""
    return np.repeat(np.array(colours, np.uint8), 64 // len(colours), axis=0)[None, :, None].repeat(64, 2)


EVERYWHERE = np.ones((1, 64, 64), bool)


def match(a: np.ndarray, b: np.ndarray, mask: np.ndarray = EVERYWHERE) -> float:
    return best_colour_match(colour_profile(a, mask), colour_profile(b, mask)).item()


def test_equal_colours_match_wherever_they_are():
    red_green = picture((180, 40, 40), (40, 160, 60))
    assert match(red_green, red_green) == pytest.approx(1, abs=1e-3)
    assert match(red_green, red_green[:, ::-1]) == pytest.approx(1, abs=1e-3)


def test_other_colours_match_less_than_the_same_colour_in_dimmer_light():
    red, dim, blue = picture((180, 40, 40)), picture((130, 29, 29)), picture((40, 40, 180))
    assert match(red, blue) < 0.1
    assert match(red, dim) > match(red, blue) + 0.3


def test_pixels_outside_the_mask_do_not_count():
    red, half = picture((180, 40, 40)), picture((180, 40, 40), (40, 40, 180))
    mask = EVERYWHERE.copy()
    mask[:, 32:] = False
    assert match(red, half, mask) == pytest.approx(1, abs=1e-3)


def test_a_crop_without_a_mask_matches_nothing():
    profile = colour_profile(picture((180, 40, 40)), np.zeros((1, 64, 64), bool))
    assert torch.equal(profile, torch.zeros_like(profile))
