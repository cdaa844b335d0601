import numpy as np
import pytest
import torch

from pipeline.functional.descriptors import mean_top_cosine, pool_foreground


def unit_rows(n: int, c: int, seed: int) -> torch.Tensor:
    return torch.randn((n, c), generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("best", [1, 5, 100])
def test_score_equals_a_loop(best: int):
    query, templates = unit_rows(7, 6, 0), unit_rows(12, 6, 1)
    for q, score in zip(query.double().numpy(), mean_top_cosine(query, templates, best=best), strict=True):
        cosines = [max(0.0, q @ t / np.linalg.norm(q) / np.linalg.norm(t)) for t in templates.double().numpy()]
        assert score.item() == pytest.approx(np.mean(sorted(cosines)[-best:]), abs=1e-6)  # float32


def test_score_ignores_descriptor_length_and_template_order():
    query, templates = unit_rows(3, 6, 0), unit_rows(9, 6, 1)
    once = mean_top_cosine(query, templates, best=5)
    torch.testing.assert_close(mean_top_cosine(3 * query, templates.flip(0) * 0.1, best=5), once)


def test_descriptor_is_the_mean_over_foreground_cells():
    maps = torch.arange(2 * 3 * 4 * 4.0).reshape(2, 3, 4, 4)
    mask = torch.zeros((2, 8, 8), dtype=torch.bool)
    mask[0, :4, :4] = True
    mask[1, 6:, 6:] = True
    expected = torch.stack([maps[0, :, :2, :2].mean((1, 2)), maps[1, :, 3, 3]])
    torch.testing.assert_close(pool_foreground(maps, mask), expected)


def test_class_token_is_returned_unchanged():
    token = torch.randn((2, 5, 1, 1))
    mask = torch.zeros((2, 8, 8), dtype=torch.bool)
    mask[:, 0, 0] = True
    torch.testing.assert_close(pool_foreground(token.half(), mask), token.half().float()[:, :, 0, 0])


def test_crop_without_mask_has_similarity_0():
    described = pool_foreground(torch.ones((1, 5, 2, 2)), torch.zeros((1, 8, 8), dtype=torch.bool))
    assert mean_top_cosine(described, torch.ones((3, 5)), best=5).tolist() == [0.0]
