"""Masks and images of odd kinds are normalised by a stated rule, or refused by name."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from pipeline.bop.images import image_size, read_depth, read_mask, read_rgb
from pipeline.bop.pixels import scale_to_8_bits
from pipeline.errors import BadInput

SIZE = (120, 160)


def disc(x: float = 80, y: float = 60, radius: float = 35) -> np.ndarray:
    row, column = np.mgrid[: SIZE[0], : SIZE[1]]
    return (column - x) ** 2 + (row - y) ** 2 < radius**2


def write(path: Path, values: np.ndarray, **options: object) -> Path:
    Image.fromarray(values).save(path, **options)
    return path


@pytest.mark.parametrize("quality", [30, 75, 95])
@pytest.mark.parametrize("name", ["mask.jpg", "mask.webp"])
def test_a_compressed_mask_keeps_its_outline(tmp_path, name, quality):
    read = read_mask(write(tmp_path / name, disc().astype(np.uint8) * 255, quality=quality))
    assert np.mean(read != disc()) < 0.005


@pytest.mark.parametrize("blur", [1, 2, 3])
def test_soft_edges_are_cut_at_half_of_the_largest_value(tmp_path, blur):
    soft = cv2.GaussianBlur(disc().astype(np.float32) * 255, (0, 0), blur)
    read = read_mask(write(tmp_path / "mask.png", soft.round().astype(np.uint8)))
    assert np.mean(read != disc()) < 0.01


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32, bool])
@pytest.mark.parametrize("white", [1, 7, 255, 4095])
def test_a_mask_of_two_values_is_where_it_is_not_black(tmp_path, dtype, white):
    if white > 255 and dtype in (np.uint8, bool):
        return
    values = disc() if dtype is bool else (disc() * white).astype(dtype)
    np.testing.assert_array_equal(read_mask(write(tmp_path / "mask.tif", values)), disc())


def labels() -> np.ndarray:
    values = np.zeros(SIZE, np.uint8)
    for label, x in ((1, 30), (2, 80), (5, 130)):
        values[disc(x, radius=20)] = label
    return values


def test_an_image_of_labels_needs_the_choice_of_one(tmp_path):
    path = write(tmp_path / "mask.png", labels())
    with pytest.raises(BadInput, match=r"1 \(\d+ pixels\), 2 \(\d+ pixels\), 5 .*dataset.mask_label"):
        read_mask(path)
    np.testing.assert_array_equal(read_mask(path, label=2), disc(80, radius=20))
    with pytest.raises(BadInput, match=r"dataset.mask_label: found 3, needs one of the labels"):
        read_mask(path, label=3)


@pytest.mark.parametrize("scale", [1, 40, 85])
def test_labels_far_apart_are_not_a_soft_edge(tmp_path, scale):
    values = labels()
    values[values == 5] = 3
    with pytest.raises(BadInput, match="several values beside black"):
        read_mask(write(tmp_path / "mask.png", values * np.uint8(scale)))


def test_labels_of_a_palette_are_its_indices(tmp_path):
    image = Image.fromarray(labels(), mode="P")
    image.putpalette([0, 0, 0, 220, 20, 60, 119, 11, 32, 0, 0, 142, 0, 0, 230, 106, 0, 228])
    image.save(tmp_path / "mask.png")
    with pytest.raises(BadInput, match="colours beside black"):
        read_mask(tmp_path / "mask.png")
    np.testing.assert_array_equal(read_mask(tmp_path / "mask.png", label=5), disc(130, radius=20))


def test_a_mask_of_one_colour_is_read_and_one_of_several_is_refused(tmp_path):
    red = np.where(disc()[..., None], np.array([200, 30, 40], np.uint8), np.uint8(0))
    np.testing.assert_array_equal(read_mask(write(tmp_path / "red.png", red)), disc())
    two = red.copy()
    two[disc(30, radius=15)] = (20, 200, 60)
    with pytest.raises(BadInput, match="2 colours beside black"):
        read_mask(write(tmp_path / "two.png", two))


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
def test_grey_of_more_bits_has_the_brightness_of_8(tmp_path, bits):
    ramp = np.tile(np.linspace(0, 1, SIZE[1]), (SIZE[0], 1))
    values = np.round(ramp * ((1 << bits) - 1)).astype(np.uint16)
    read = read_rgb(write(tmp_path / "image.png", values))
    assert np.abs(read[..., 0].astype(float) - ramp * 255).max() <= 1


@pytest.mark.parametrize("white", [1.0, 255.0, 65535.0])
def test_floating_point_images_are_fractions_of_white_or_integers(tmp_path, white):
    ramp = np.tile(np.linspace(0, 1, SIZE[1], dtype=np.float32), (SIZE[0], 1))
    read = read_rgb(write(tmp_path / "image.tif", ramp * np.float32(white)))
    assert np.abs(read[..., 0].astype(float) - ramp * 255).max() <= 1


@pytest.mark.parametrize("values", [[-1.0, 0.5], [0.0, 1e6], [0.0, np.nan]])
def test_values_that_are_no_intensities_are_refused(values):
    with pytest.raises(BadInput, match=r"image.tif: found pixel values from"):
        scale_to_8_bits(np.array([values], np.float32), Path("image.tif"))


def test_a_palette_is_no_depth_image(tmp_path):
    Image.fromarray(labels(), mode="P").save(tmp_path / "depth.png")
    with pytest.raises(BadInput, match=r"depth.png: found a palette, needs a depth image with one number a pixel"):
        read_depth(tmp_path / "depth.png", 1.0)


@pytest.mark.parametrize("size", [(16330, 12247), (12000, 9000)])
def test_photographs_of_phones_are_not_called_an_attack(tmp_path, size):
    Image.new("L", size).save(tmp_path / "photo.jpg", quality=5)
    assert image_size(tmp_path / "photo.jpg") == size[::-1]


def test_an_image_too_large_is_called_too_large(tmp_path):
    Image.new("1", (40000, 10000)).save(tmp_path / "photo.tif", compression="group4")
    with pytest.raises(BadInput, match="40000 x 10000 pixels, 400 megapixels, needs at most 300"):
        image_size(tmp_path / "photo.tif")


@pytest.fixture
def shades() -> np.ndarray:
    """A picture of random shades, smooth as photographs are, 120 x 160."""
    noise = np.random.default_rng(3).random((120, 160, 3), dtype=np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 5)
    return (30 + 220 * (smooth - smooth.min()) / np.ptp(smooth)).astype(np.uint8)


@pytest.mark.parametrize("cut", ["whole", "ball", "small ball", "grey ball", "half transparent"])
def test_a_photograph_is_no_mask(tmp_path, shades, cut):
    y, x = np.mgrid[:120, :160]
    inside = (x - 80) ** 2 + (y - 60) ** 2 < (15 if cut == "small ball" else 40) ** 2
    values = shades if cut in ("whole", "half transparent") else shades * inside[..., None]
    values = values[..., 1] if cut == "grey ball" else values
    if cut == "half transparent":
        values = np.dstack([values, np.where(inside, 255, 128).astype(np.uint8)])
    Image.fromarray(values).save(tmp_path / "cut.png")
    with pytest.raises(BadInput, match=r"photograph|colours beside black"):
        read_mask(tmp_path / "cut.png")


@pytest.mark.parametrize("blur", [1, 3, 8])
@pytest.mark.parametrize("radius", [12, 40])
def test_a_soft_mask_is_no_photograph(tmp_path, blur, radius):
    y, x = np.mgrid[:240, :320]
    inside = (x - 160) ** 2 + (y - 120) ** 2 < radius**2
    soft = cv2.GaussianBlur(inside.astype(np.float32), (0, 0), blur)
    Image.fromarray((255 * soft / soft.max()).round().astype(np.uint8)).save(tmp_path / "soft.png")
    mask = read_mask(tmp_path / "soft.png")
    assert 0.6 * inside.sum() < mask.sum() < 1.7 * inside.sum()


def test_a_mask_of_ink_is_read_as_its_colours(tmp_path):
    mask = np.zeros((40, 60), np.uint8)
    mask[10:20, 15:40] = 255
    Image.fromarray(mask).convert("RGB").convert("CMYK").save(tmp_path / "ink.tif")
    np.testing.assert_array_equal(read_mask(tmp_path / "ink.tif"), mask > 0)
