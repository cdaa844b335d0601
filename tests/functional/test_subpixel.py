import pytest
import torch

from pipeline.functional.similarity import l2_normalize
from pipeline.functional.subpixel import neighbourhood_shift

_CELLS = 24


def _field(dx: float = 0.0, dy: float = 0.0) -> torch.Tensor:
    """Unit features (h w c) of a smooth field shifted by (dx, dy) cells."""
    generator = torch.Generator().manual_seed(0)
    wave, phase = torch.randn(16, 20, 2, generator=generator), 6.28 * torch.rand(16, 20, generator=generator)
    y, x = torch.meshgrid(torch.arange(_CELLS) + dy, torch.arange(_CELLS) + dx, indexing="ij")
    waves = torch.einsum("ckd,hwd->hwck", wave, torch.stack([x, y], -1).float())
    return l2_normalize(torch.cos(waves + phase).sum(-1))


def _disc() -> torch.Tensor:
    centre = torch.arange(_CELLS) - (_CELLS - 1) / 2
    return centre[:, None] ** 2 + centre**2 < 100


def test_perfect_match_does_not_shift_even_at_the_silhouette():
    template, mask = _field(), _disc()
    cell = mask.flatten().nonzero()[:, 0]
    shift = neighbourhood_shift(template.flatten(0, 1)[cell], template, mask, cell, kernel=3)
    assert shift.abs().max() == 0


def test_shift_points_towards_the_query():
    template, mask = _field(), torch.ones(_CELLS, _CELLS, dtype=torch.bool)
    cell = _disc().flatten().nonzero()[:, 0]
    for dx, dy in ((0.4, 0.0), (0.0, -0.4), (0.3, 0.3)):
        query = _field(dx, dy).flatten(0, 1)[cell]
        shift = neighbourhood_shift(query, template, mask, cell, kernel=3)
        true = torch.tensor([dx, dy])
        assert (shift - true).norm(dim=1).mean() < 0.75 * true.norm()  # without a shift: true.norm()


@pytest.mark.parametrize("subtract_own", [True, False])
def test_weighted_mean_equals_a_loop_over_the_neighbourhood(subtract_own):
    template, mask, query = _field(), _disc(), _field(0.3, 0.1)
    cell = mask.flatten().nonzero()[::17, 0]
    features = query.flatten(0, 1)[cell]
    found = neighbourhood_shift(features, template, mask, cell, kernel=3, subtract_own=subtract_own)
    for i, flat in enumerate(cell.tolist()):
        y, x = divmod(flat, _CELLS)
        means = []
        for feature in (query[y, x], template[y, x]):
            total, weights = torch.zeros(2), 0.0
            for oy in (-1, 0, 1):
                for ox in (-1, 0, 1):
                    if mask[y + oy, x + ox]:
                        weight = max(float(feature @ template[y + oy, x + ox]), 0.0)
                        total, weights = total + weight * torch.tensor([ox, oy]), weights + weight
            means.append(total / weights)
        own = means[1] if subtract_own else 0.0
        assert torch.allclose(found[i], means[0] - own, atol=1e-5)  # float32, different order of summation


def test_kernel_1_is_off_and_map_corners_are_supported():
    template, mask = _field(), torch.ones(_CELLS, _CELLS, dtype=torch.bool)
    corners = torch.tensor([0, _CELLS - 1, _CELLS * (_CELLS - 1), _CELLS**2 - 1])
    query = _field(0.4, 0.4).flatten(0, 1)[corners]
    assert not neighbourhood_shift(query, template, mask, corners, kernel=1).any()
    assert torch.isfinite(neighbourhood_shift(query, template, mask, corners, kernel=5)).all()
