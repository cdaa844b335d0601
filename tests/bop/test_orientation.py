"""One rule for every format and every kind of image: it is turned upright as its EXIF orientation says."""

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import PIL.Image
import pytest

from pipeline.bop.images import image_digest, image_size, read_depth, read_mask, read_orientation, read_rgb
from pipeline.io.digests import file_digest

UPRIGHT = {  # what a viewer does with the stored rows and columns, from the EXIF standard's table
    None: lambda a: a,
    1: lambda a: a,
    2: lambda a: a[:, ::-1],
    3: lambda a: a[::-1, ::-1],
    4: lambda a: a[::-1],
    5: lambda a: a.swapaxes(0, 1),
    6: lambda a: a.swapaxes(0, 1)[:, ::-1],
    7: lambda a: a[::-1, ::-1].swapaxes(0, 1),
    8: lambda a: a.swapaxes(0, 1)[::-1],
    77: lambda a: a,
    0: lambda a: a,
}
FORMATS = {"png": {}, "tif": {}, "webp": {"lossless": True}, "jpg": {"quality": 95}}
STORED_HW = (40, 64)


def exif_of(orientation: int | None) -> PIL.Image.Exif:
    exif = PIL.Image.Exif()
    if orientation is not None:
        exif[0x0112] = orientation
    return exif


def write(path: Path, values: np.ndarray, orientation: int | None) -> Path:
    PIL.Image.fromarray(values).save(path, exif=exif_of(orientation), **FORMATS[path.suffix[1:]])
    return path


def coloured() -> np.ndarray:
    rgb = np.zeros((*STORED_HW, 3), np.uint8)
    rgb[:20, :32], rgb[:20, 32:], rgb[20:, :32] = (250, 0, 0), (0, 250, 0), (0, 0, 250)
    return rgb


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("orientation", UPRIGHT)
def test_photographs_are_turned_upright(tmp_path: Path, suffix: str, orientation: int | None):
    path = write(tmp_path / f"photo.{suffix}", coloured(), orientation)
    upright, read = UPRIGHT[orientation](coloured()), read_rgb(path)
    assert image_size(path) == read.shape[:2] == upright.shape[:2]
    assert np.abs(read.astype(int) - upright).mean() < (3 if suffix == "jpg" else 1e-9)
    assert read_orientation(path) == (orientation if orientation in range(2, 9) else 1)
    if suffix in ("jpg", "png"):  # OpenCV ignores the orientation of other formats or cannot read them
        np.testing.assert_allclose(read, cv2.imread(str(path))[..., ::-1], atol=4)


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("orientation", range(1, 9))
def test_masks_are_turned_upright(tmp_path: Path, suffix: str, orientation: int):
    stored = np.zeros(STORED_HW, bool)
    stored[4:20, 8:48] = True
    path = write(tmp_path / f"mask.{suffix}", stored * np.uint8(255), orientation)
    assert np.mean(read_mask(path) != UPRIGHT[orientation](stored)) < 0.01


@pytest.mark.parametrize("suffix", ["png", "tif"])
@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_depth_images_are_turned_upright(tmp_path: Path, suffix: str, orientation: int, dtype: type):
    if suffix == "png" and dtype is np.float32:
        return
    stored = np.arange(STORED_HW[0] * STORED_HW[1]).reshape(STORED_HW).astype(dtype)
    path = write(tmp_path / f"depth.{suffix}", stored, orientation)
    np.testing.assert_array_equal(read_depth(path, 0.5), UPRIGHT[orientation](stored) * 0.5)


def chunk(name: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def xmp(orientation: int) -> bytes:
    text = f'<x:xmpmeta><rdf:Description tiff:Orientation="{orientation}"/></x:xmpmeta>'
    return b"XML:com.adobe.xmp" + bytes(5) + text.encode()


@pytest.mark.parametrize("orientation", [3, 6, 8])
@pytest.mark.parametrize("place", ["before the pixels", "after the pixels"])
@pytest.mark.parametrize("form", ["eXIf", "iTXt", "zTXt"])
def test_png_states_its_orientation_anywhere_and_in_any_form(tmp_path: Path, orientation: int, place: str, form: str):
    path = tmp_path / "photo.png"
    PIL.Image.fromarray(coloured()).save(path)
    exif = exif_of(orientation).tobytes()
    profile = f"\nexif\n{len(exif):8}\n{exif.hex()}\n".encode()  # as ImageMagick writes it
    data = {
        "eXIf": exif.removeprefix(b"Exif\0\0"),
        "iTXt": xmp(orientation),
        "zTXt": b"Raw profile type exif\0\0" + zlib.compress(profile),
    }
    content, added = path.read_bytes(), chunk(form.encode(), data[form])
    at = 33 if place == "before the pixels" else len(content) - 12
    path.write_bytes(content[:at] + added + content[at:])
    upright = UPRIGHT[orientation](coloured())
    np.testing.assert_array_equal(read_rgb(path), upright)
    assert image_size(path) == upright.shape[:2]
    assert image_digest(path) != file_digest(path)


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("photograph", [True, False])
def test_the_orientation_is_in_the_key_where_it_is_applied(tmp_path: Path, suffix: str, photograph: bool):
    for orientation in UPRIGHT:
        path = write(tmp_path / f"{orientation}.{suffix}", coloured(), orientation)
        plain = image_digest(path, photograph=photograph) == file_digest(path)
        assert plain == (orientation not in range(2, 9))


@pytest.mark.parametrize("content", [b"", b"Exif\0\0", b"MM\0*\0\0\xff\xff", b"II*\0\x08\0\0\0\x01\0\x12\x01\x02\0"])
def test_broken_exif_leaves_the_pixels_as_they_are(tmp_path: Path, content: bytes):
    path = tmp_path / "photo.png"
    PIL.Image.fromarray(coloured()).save(path)
    data = path.read_bytes()
    path.write_bytes(data[:33] + chunk(b"eXIf", content) + data[33:])
    np.testing.assert_array_equal(read_rgb(path), coloured())
    assert image_size(path) == STORED_HW
    assert image_digest(path) == file_digest(path)
