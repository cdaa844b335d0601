"""Camera files and EXIF data -> K, distortion coefficients and image size."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import yaml
from jaxtyping import Float

from pipeline.bop.jsonio import is_number
from pipeline.errors import BadInput
from pipeline.io.files import IMAGE_FORMATS, read_file

NEEDED = "[fx,fy,cx,cy], the 9 numbers of the matrix row by row, a camera file (.yaml, .yml, .json), or exif"
_MATRIX_NAMES = ("camera_matrix", "cameramatrix", "k", "cam_k", "intrinsic_matrix", "intrinsics")
_DISTORTION_NAMES = ("distortion_coefficients", "dist_coeffs", "distcoeffs", "d", "dist", "distortion")
_WIDTHS, _HEIGHTS = ("image_width", "width"), ("image_height", "height")
_FILM_DIAGONAL_MM = float(np.hypot(36, 24))
_EXIF_IFD, _FOCAL_LENGTH_35MM = 0x8769, 0xA405


@dataclass(frozen=True, eq=False)
class CameraFile:
    """Parameters of a camera. ``size_hw``: size of the images that K belongs to; None if unknown."""

    K: Float[np.ndarray, "3 3"]
    distortion: tuple[float, ...] = ()
    size_hw: tuple[int, int] | None = None

    def check_size(self, size_hw: tuple[int, int], where: str) -> None:
        """Raise BadInput if K was calibrated for images of another size."""
        if self.size_hw is not None and self.size_hw != size_hw:
            (h, w), (own_h, own_w) = size_hw, self.size_hw
            found = f"the camera of images of {own_w} x {own_h}"
            raise BadInput(where, found=found, needed=f"that of this image, {w} x {h} (width x height)")


def read_camera(path: Path) -> CameraFile:
    """A camera from ROS's camera_info yaml, OpenCV's yaml or a json file, such as BOP's camera.json. Raises BadInput.

    The matrix may be a list of 4 or 9 numbers, three rows, a mapping with ``data``, or fields fx, fy, cx, cy.
    """
    record = _read_mapping(path)
    fields = {str(name).lower(): value for name, value in record.items()}
    given = [fields[name] for name in _MATRIX_NAMES if name in fields]
    if not given and all(is_number(fields.get(name)) for name in ("fx", "fy", "cx", "cy")):
        given = [[fields[name] for name in ("fx", "fy", "cx", "cy")]]
    numbers = _numbers(given[0]) if given else []
    if len(numbers) == 4:
        fx, fy, cx, cy = numbers
        numbers = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
    if len(numbers) != 9:
        found = f"{len(numbers)} numbers" if given else f"fields {', '.join(map(str, record))}"
        raise BadInput(path, found=found, needed="camera_matrix or K with 9 numbers, or fx, fy, cx, cy")
    model = str(fields.get("distortion_model", ""))
    distortion = [value for name in _DISTORTION_NAMES if name in fields for value in _numbers(fields[name])]
    if any(distortion) and model and model not in ("plumb_bob", "rational_polynomial"):
        raise BadInput(path, found=f"distortion_model {model}", needed="plumb_bob: undistort the images first")
    sizes = [next((fields[name] for name in names if name in fields), None) for names in (_HEIGHTS, _WIDTHS)]
    h, w = (value if isinstance(value, int) and value > 0 else None for value in sizes)
    size_hw = None if h is None or w is None else (h, w)
    return CameraFile(np.array(numbers, float).reshape(3, 3), tuple(distortion) if any(distortion) else (), size_hw)


def estimate_camera(path: Path, size_hw: tuple[int, int]) -> CameraFile:
    """A rough camera from the 35 mm equivalent focal length in EXIF data. Raises BadInput if that is missing."""
    try:
        with PIL.Image.open(path, formats=IMAGE_FORMATS) as image:
            focal_mm = image.getexif().get_ifd(_EXIF_IFD).get(_FOCAL_LENGTH_35MM)
    except (OSError, SyntaxError, ValueError):
        focal_mm = None
    if not focal_mm or not float(focal_mm) > 0:
        found = "no FocalLengthIn35mmFilm in its EXIF data"
        raise BadInput(path, found=found, needed="one, or dataset.K=[fx,fy,cx,cy]")
    (h, w) = size_hw
    f = float(focal_mm) / _FILM_DIAGONAL_MM * float(np.hypot(h, w))
    return CameraFile(np.array([[f, 0, (w - 1) / 2], [0, f, (h - 1) / 2], [0, 0, 1.0]]), size_hw=size_hw)


def numbers_in(text: str) -> list[float] | None:
    """The numbers in a text such as "600 600 320 240" or "[600, 600, 320, 240]"; None if there is other text."""
    words = re.split(r"[\s,;]+", text.strip().strip("[]()").strip())
    try:
        return [float(word) for word in words]
    except ValueError:
        return None


def _read_mapping(path: Path) -> Mapping[str, Any]:
    text = read_file(path, "a camera file").decode("utf-8", errors="replace")
    try:
        if path.suffix.lower() == ".json":
            record = json.loads(text)
        else:
            record = yaml.load(re.sub(r"\A%YAML[: ][^\n]*\n", "", text), Loader=_Loader)
    except (ValueError, RecursionError, yaml.YAMLError) as error:
        found = " ".join(str(error).split())[:120]
        raise BadInput(path, found=f"invalid syntax ({found})", needed="a camera file in yaml or json") from None
    if not isinstance(record, dict):
        raise BadInput(path, found=type(record).__name__, needed="a camera file with named fields")
    return record


class _Loader(yaml.SafeLoader):
    """Safe YAML loader that also reads OpenCV's matrices: mappings with rows, cols and data."""


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", lambda loader, node: loader.construct_mapping(node, True))


def _numbers(value: Any) -> list[float]:
    """All numbers in a list, in nested rows, or in the field ``data``, in order."""
    if isinstance(value, Mapping):
        return _numbers(value.get("data", []))
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [number for part in value for number in _numbers(part)]
    return [float(value)] if is_number(value) else []
