import pytest
import torch

from pipeline.functional.maps import block_means, normalize_channels
from pipeline.stages.fuse import EncodedMap, coarse_shape, coarsen


def test_a_block_is_the_mean_of_its_foreground_cells():
    features, mask = torch.rand(5, 8, 12, generator=torch.Generator().manual_seed(0)), torch.rand(8, 12) > 0.4
    coarse, covered = block_means(features, mask, block=4)
    for y in range(2):
        for x in range(3):
            part = (slice(4 * y, 4 * y + 4), slice(4 * x, 4 * x + 4))
            inside = features[:, *part][:, mask[part]]
            torch.testing.assert_close(coarse[:, y, x], inside.mean(1))
            assert bool(covered[y, x]) == (mask[part].sum() >= 8)


def test_cells_are_scaled_with_the_bytes_of_torchs_norm():
    maps = 3 * torch.randn((2, 64, 7, 9), generator=torch.Generator().manual_seed(0))
    maps[0, :, 2, 3] = 0
    assert torch.equal(normalize_channels(maps), torch.nn.functional.normalize(maps, dim=1))


def test_a_mask_smaller_than_a_block_keeps_its_block():
    mask = torch.zeros(8, 8, dtype=torch.bool)
    mask[5, 2] = True
    coarse, covered = block_means(torch.ones(1, 8, 8), mask, block=4)
    assert covered.nonzero().tolist() == [[1, 0]]
    assert float(coarse[0, 1, 0]) == 1
    assert not block_means(torch.ones(1, 8, 8), torch.zeros_like(mask), block=4)[1].any()


@pytest.mark.parametrize(("cells", "block", "expected"), [(64, 2, 32), (30, 4, 15), (37, 2, 37), (8, 1, 8)])
def test_a_block_that_does_not_divide_the_map_is_replaced_by_a_common_divisor(cells, block, expected):
    encoded = EncodedMap(torch.rand(3, cells, cells), torch.ones(cells, cells, dtype=torch.bool), "kept")
    made = coarsen(encoded, block=block)
    assert made.features.shape == coarse_shape(encoded.features.shape, block=block) == (3, expected, expected)
    assert made.note == "kept"
