"""Image files of a BOP dataset as arrays.

All images (photographs, masks, depth images, of any format) are rotated upright by their EXIF orientation.
"""

from __future__ import annotations

import io
import struct
import warnings
from contextlib import suppress
from pathlib import Path

import numpy as np
import PIL.Image
import PIL.ImageFile
import PIL.ImageOps
import PIL.PngImagePlugin
from jaxtyping import Bool, Float32, UInt8

from pipeline.bop.pixels import DEEP_GREY_VERSION, MAX_MEGAPIXELS, check_megapixels, scale_to_8_bits, select_object
from pipeline.errors import BadInput
from pipeline.io.digests import file_digest, unchanged_files
from pipeline.io.files import IMAGE_FORMATS, describe_irregular, read_file
from pipeline.spec import digest

QUARTER_TURNS = (5, 6, 7, 8)  # EXIF orientations that exchange width and height


def read_rgb(path: Path) -> UInt8[np.ndarray, "H W 3"]:
    """8-bit rgb, rotated upright by its EXIF orientation.

    Grey images become three equal channels; more than 8 bits are scaled by bop.pixels; alpha is dropped.
    """
    with _open(path) as image:
        if image.mode[0] in "IF":
            return np.repeat(scale_to_8_bits(np.asarray(image), path)[..., None], 3, axis=-1)
        return np.asarray(image.convert("RGB")).copy()


def read_mask(path: Path, *, label: int | None = None) -> Bool[np.ndarray, "H W"]:
    """The pixels of the object: not black, or opaque if the mask is in the alpha channel only.

    ``label``: the value to select in an image of labels. See bop.pixels for soft edges and compression.
    """
    with _open(path) as image:
        if label is not None and image.mode == "P":
            return select_object(np.asarray(image), path, label=label)  # labels are indices of the palette
        if image.mode in ("CMYK", "YCbCr", "LAB", "HSV"):
            image = image.convert("RGB")  # in CMYK, white is no ink
        values = np.asarray(image.convert("RGBA") if image.mode in ("P", "PA", "LA", "RGBA") else image)
    if values.ndim == 2 or values.shape[-1] != 4:
        return select_object(values, path, label=label)
    colour, alpha = values[..., :3].any(axis=-1), values[..., 3]
    if not (alpha > 0).all() and (colour.all() or not colour.any()):
        return select_object(alpha, path, label=label)
    return select_object(np.where(alpha[..., None] > 0, values[..., :3], 0), path, label=label)


def read_depth(path: Path, depth_scale: float) -> Float32[np.ndarray, "H W"]:
    """Depth in mm along the optical axis, 0 where unknown: file values times ``depth_scale``."""
    with _open(path) as image:
        if image.mode in ("P", "1"):
            found = "a palette" if image.mode == "P" else "one bit a pixel"
            raise BadInput(path, found=found, needed="a depth image with one number a pixel")
        values = np.asarray(image, dtype=np.float64)
    if values.ndim != 2:
        raise BadInput(path, found=f"{values.shape[-1]} channels", needed="a depth image with one channel")
    return (values * depth_scale).astype(np.float32)


PIL.Image.MAX_IMAGE_PIXELS = MAX_MEGAPIXELS * 10**6  # PIL's own limit of 179 reports a large photograph as an attack
warnings.filterwarnings("ignore", category=PIL.Image.DecompressionBombWarning)  # check_megapixels reports it
_ANIMATED = ("GIF", "PNG", "TIFF", "WEBP")
_ORIENTATION_TAG = 0x0112
_EXIF_TEXTS = (b"Raw profile type exif", b"XML:com.adobe.xmp")  # PNG text chunks that may have an orientation
_BROKEN = (OSError, SyntaxError, ValueError, PIL.Image.DecompressionBombError)
_BROKEN_EXIF = (*_BROKEN, KeyError, TypeError, struct.error, OverflowError)  # the pixels may be fine


def image_digest(path: Path, *, photograph: bool = True) -> str:
    """Digest of an image as it is read: of the file, and of any special rules applied to it.

    ``photograph``: whether ``read_rgb`` reads it. Put new rules into ``_special_rules``, so that files without them
    keep their keys. Rules for masks are covered by the version of the detectors instead.
    """
    content = file_digest(path)
    try:
        with unchanged_files([path]), _open_header(path) as image:
            rules = _special_rules(image, photograph=photograph)
    except _BROKEN:
        rules = []
    return digest([content, rules]) if rules else content


def _special_rules(image: PIL.Image.Image, *, photograph: bool) -> list[str]:
    """Rules that apply to this image but not to a plain one. Raise the number of a rule when you change it."""
    orientation = _read_orientation(image)
    rules = [] if orientation == 1 else [f"EXIF orientation {orientation}"]
    is_deep_grey = photograph and image.mode[0] in "IF"
    return [*rules, f"more than 8 bits, rule {DEEP_GREY_VERSION}"] if is_deep_grey else rules


def image_size(path: Path) -> tuple[int, int]:
    """(h, w) of the upright image, from the file's header; the pixels are not read."""
    try:
        with unchanged_files([path]), _open_header(path) as image:
            turned = image.format != "TIFF" and _read_orientation(image) in QUARTER_TURNS  # PIL turns TIFF itself
            return (image.width, image.height) if turned else (image.height, image.width)
    except _BROKEN as error:
        raise _unreadable_image(path, error) from None


def read_orientation(path: Path) -> int:
    """EXIF orientation that ``read_rgb`` applies, 1 to 8; 1 without one and for a file that cannot be read."""
    try:
        with _open_header(path) as image:
            return _read_orientation(image)
    except _BROKEN:
        return 1


def count_frames(path: Path) -> int:
    """Frames or pages of an image file, of which the first is read; 1 for a file that cannot be read.

    The second picture of a phone's JPEG is a preview or a depth map and does not count.
    """
    try:
        with _open_header(path) as image:
            return getattr(image, "n_frames", 1) if image.format in _ANIMATED else 1
    except _BROKEN:
        return 1


def _open_header(path: Path) -> PIL.Image.Image:
    if path.exists() and not path.is_file():
        raise OSError(describe_irregular(path))
    return _require_readable_size(PIL.Image.open(path, formats=IMAGE_FORMATS), path)


def _require_readable_size(image: PIL.Image.Image, path: Path) -> PIL.Image.Image:
    """The image. Raises BadInput if the size in its header would not fit in memory."""
    check_megapixels(image.width, image.height, path)
    return image


def _open(path: Path) -> PIL.Image.Image:
    try:
        image = _require_readable_size(
            PIL.Image.open(io.BytesIO(read_file(path, "an image")), formats=IMAGE_FORMATS), path
        )
        image.load()  # PIL notices a truncated file only when it reads the pixels
    except _BROKEN as error:
        raise _unreadable_image(path, error) from None
    with suppress(*_BROKEN_EXIF):
        PIL.ImageOps.exif_transpose(image, in_place=True)
    return image


def _read_orientation(image: PIL.Image.Image) -> int:
    """EXIF orientation (1 to 8) that PIL applies to an opened image; 1 without one and for any other value."""
    if isinstance(image, PIL.PngImagePlugin.PngImageFile) and not _has_exif(image):
        return 1
    with suppress(*_BROKEN_EXIF):
        found = image.getexif().get(_ORIENTATION_TAG, 1)
        return int(found) if found in range(2, 9) else 1
    return 1


def _has_exif(image: PIL.ImageFile.ImageFile) -> bool:
    """Whether a PNG has EXIF data anywhere. Scans the chunks, because PIL would decode all pixels to find out."""
    stream = image.fp
    if stream is None:
        return "exif" in image.info
    start = stream.tell()
    try:
        stream.seek(8)
        while len(head := stream.read(8)) == 8:
            length, name = struct.unpack(">I4s", head)
            text = stream.read(min(length, 32)) if name in (b"tEXt", b"zTXt", b"iTXt") else b""
            if name == b"eXIf" or text.startswith(_EXIF_TEXTS):
                return True
            stream.seek(length + 4 - len(text), io.SEEK_CUR)
        return False
    finally:
        stream.seek(start)


def _unreadable_image(path: Path, error: Exception) -> BadInput:
    if isinstance(error, FileNotFoundError):
        return BadInput(path, found="no such file", needed="an image")
    if path.exists() and not path.is_file():
        return BadInput(path, found=describe_irregular(path), needed="an image")
    found = "unknown image format" if isinstance(error, PIL.UnidentifiedImageError) else str(error)
    return BadInput(path, found=f"a broken image ({found})", needed="a complete PNG, JPEG, TIFF or WebP")
