"""Gradient histograms: their invariances, their bins and their positions."""

import numpy as np
import pytest
import torch

from pipeline.errors import BadInput
from pipeline.functional.camera import cell_to_px
from pipeline.functional.gradients import oriented_energy
from pipeline.items.views import Crops
from pipeline.spec import Runtime, build
from pipeline.stages.extract.hog import Hog

CPU = Runtime(device="cpu")
LAYERS = (2, 5, 8, 11)


def crops_of(rgb: np.ndarray, mask: np.ndarray | None = None) -> Crops:
    mask = np.ones(rgb.shape[:3], bool) if mask is None else mask
    return Crops(rgb * mask[..., None], mask, np.tile(np.eye(3), (len(rgb), 1, 1)))


def noise(n: int = 2, size: int = 128) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (n, size, size, 3), dtype=np.uint8)


def grating(angle_deg: float, size: int = 128) -> np.ndarray:
    """Brightness that rises and falls along a direction, period 16 px."""
    y, x = np.mgrid[:size, :size]
    a = np.radians(angle_deg)
    wave = 127.5 + 100 * np.sin(2 * np.pi * (x * np.cos(a) + y * np.sin(a)) / 16)
    return np.repeat(np.rint(wave).astype(np.uint8)[None, ..., None], 3, axis=-1)


def test_maps_have_the_cells_of_stable_diffusion() -> None:
    spec = Hog()
    maps = spec.load(CPU)(crops_of(noise()), LAYERS)
    assert {k: tuple(v.shape[1:]) for k, v in maps.items()} == {k: spec.feature_shape(k) for k in LAYERS}
    assert [spec.feature_shape(k)[1] for k in LAYERS] == [8, 16, 32, 64]
    assert all(v.dtype == torch.float32 for v in maps.values())


def test_neither_the_batch_nor_other_layers_change_a_byte() -> None:
    backbone, crops = Hog().load(CPU), crops_of(noise(4))
    together = backbone(crops, LAYERS)
    for k in LAYERS:
        alone = backbone(crops[[2]], [k])[k][0]
        assert torch.equal(alone, together[k][2])


def test_added_brightness_changes_nothing_and_contrast_little() -> None:
    rgb = noise() // 4 + 20
    backbone = Hog().load(CPU)
    plain, brighter, steeper = (backbone(crops_of(x), LAYERS) for x in (rgb, rgb + 60, rgb * 2))
    for k in LAYERS:
        assert torch.equal(brighter[k], plain[k])  # differences of whole numbers
        cosine = torch.nn.functional.cosine_similarity(steeper[k], plain[k], dim=1)
        assert cosine.min() > 0.9999  # the direction of a descriptor does not know contrast


def test_turning_a_crop_by_90_degrees_turns_cells_and_bins() -> None:
    spec = Hog(context_cells=0)
    rgb = noise(1)
    turned = np.rot90(rgb, k=-1, axes=(1, 2)).copy()  # x to y: gradients turn by two of eight signed bins
    plain, after = (spec.load(CPU)(crops_of(x), [5])[5][0] for x in (rgb, turned))
    expected = torch.rot90(plain, k=-1, dims=(1, 2)).roll(2, dims=0)
    torch.testing.assert_close(after, expected, rtol=0, atol=1e-5)  # one gradient in 16384 may change its bin


@pytest.mark.parametrize("angle_deg", [0, 45, 90, 135])
def test_a_grating_falls_into_the_bins_of_its_direction(angle_deg: float) -> None:
    maps = Hog(orientations=8, signed=False, context_cells=0).load(CPU)(crops_of(grating(angle_deg)), [2])[2]
    inner = maps[0, :, 2:-2, 2:-2].mean((1, 2))
    assert int(inner.argmax()) == round(angle_deg / 22.5)
    assert inner.max() > 0.95


def test_the_sign_of_an_edge_counts_only_if_signed() -> None:
    edge = np.full((1, 128, 128, 3), 50, np.uint8)
    edge[:, :, 64:] = 200
    for signed in (False, True):
        maps = Hog(signed=signed).load(CPU)
        same = torch.equal(maps(crops_of(edge), [8])[8], maps(crops_of(250 - edge), [8])[8])
        assert same is not signed


def test_an_edge_changes_only_its_own_cells() -> None:
    edge = np.full((1, 128, 128, 3), 50, np.uint8)
    edge[:, 80:] = 200  # between rows 79 and 80
    for layer, cells in ((2, 8), (5, 16), (8, 32), (11, 64)):
        rows = Hog(context_cells=0).load(CPU)(crops_of(edge), [layer])[layer][0].norm(dim=0).mean(1)
        diagonal = torch.arange(cells).double()[:, None].expand(-1, 2)
        centres = cell_to_px(diagonal, size=128, cells=cells)[:, 1]
        weighted = (rows * centres).sum() / rows.sum()
        assert abs(float(weighted) - 79.5) < 128 / cells / 2
        far = (centres - 79.5).abs() > 2 * 128 / cells
        assert rows[far].max() == 0


def test_silhouette_zero_ignores_the_masks_border() -> None:
    mask = np.zeros((1, 128, 128), bool)
    mask[:, 30:90, 40:100] = True
    flat = np.full((1, 128, 128, 3), 180, np.uint8)
    kept, left_out = (Hog(silhouette=s).load(CPU)(crops_of(flat, mask), [5])[5] for s in (1.0, 0.0))
    assert kept.abs().max() > 0.5
    assert left_out.abs().max() == 0


def test_bins_of_a_cell_sum_to_its_energy() -> None:
    rgb, mask = torch.from_numpy(noise(1)), torch.ones(1, 128, 128, dtype=torch.bool)
    sums = [
        oriented_energy(rgb, mask, orientations=n, signed=s, silhouette=1.0).sum(1)
        for n in (8, 9)
        for s in (False, True)
    ]
    for other in sums[1:]:
        torch.testing.assert_close(other, sums[0])


def test_black_crops_give_zeros_and_odd_sizes_work() -> None:
    black = crops_of(np.zeros((1, 128, 128, 3), np.uint8))
    assert all(v.abs().max() == 0 for v in Hog().load(CPU)(black, LAYERS).values())
    maps = Hog().load(CPU)(crops_of(noise(1, size=100)), LAYERS)
    assert [v.shape[-1] for v in maps.values()] == [8, 16, 32, 64]


def test_a_layer_that_does_not_exist_is_named() -> None:
    with pytest.raises(BadInput, match="extract layer: found 3, needs one of 2, 5, 8, 11"):
        Hog().feature_shape(3)
    with pytest.raises(BadInput, match=r"extract\.orientations"):
        build(Hog, {"orientations": 0}, where="extract")
