import pytest
import torch

from pipeline.functional.binning import bin_count, log_bin


def bin_by_loops(maps: torch.Tensor, hierarchy: int) -> torch.Tensor:
    """The same by nested loops over cells, bins and neighbours."""
    n, _, h, w = maps.shape
    cells = []
    for y in range(h):
        for x in range(w):
            bins = []
            for level in range(hierarchy):
                step = 3**level
                for dy in (-step, 0, step):
                    for dx in (-step, 0, step):
                        if level > 0 and dy == dx == 0:
                            continue
                        i, j = min(max(y + dy, 0), h - 1), min(max(x + dx, 0), w - 1)
                        r = step // 2
                        window = maps[:, :, max(0, i - r) : i + r + 1, max(0, j - r) : j + r + 1]
                        bins.append(window.mean((2, 3)))
            cells.append(torch.cat(bins, 1))
    return torch.stack(cells, -1).reshape(n, -1, h, w)


@pytest.mark.parametrize("hierarchy", [1, 2, 3])
@pytest.mark.parametrize("size", [(7, 9), (2, 3), (1, 1)])
def test_bins_equal_a_direct_loop(hierarchy: int, size: tuple[int, int]):
    maps = torch.randn((2, 3, *size), generator=torch.Generator().manual_seed(0))
    binned = log_bin(maps, hierarchy=hierarchy)
    assert binned.shape == (2, 3 * bin_count(hierarchy), *size)
    # means of at most 81 float32 values, summed in another order
    torch.testing.assert_close(binned, bin_by_loops(maps, hierarchy), rtol=1e-5, atol=1e-6)


def test_the_fifth_bin_is_the_cell_itself():
    maps = torch.randn(1, 2, 5, 5)
    assert torch.equal(log_bin(maps, hierarchy=2)[:, 8:10], maps)


def test_constant_map_stays_constant():
    torch.testing.assert_close(log_bin(torch.full((1, 1, 4, 6), 3.0), hierarchy=2), torch.full((1, 17, 4, 6), 3.0))


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_supported(dtype: torch.dtype):
    assert log_bin(torch.randn(1, 2, 4, 4).to(dtype), hierarchy=2).dtype == dtype
