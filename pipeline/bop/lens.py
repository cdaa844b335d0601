"""Lens distortion: coefficients from users, checked, and warnings about those in camera files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Shaped

from pipeline.bop.jsonio import is_number
from pipeline.errors import BadInput
from pipeline.functional.distortion import COUNTS, UNDISTORTION_VERSION, folds, undistort, undistort_box

_NEEDED = "[k1,k2,p1,p2], [k1,k2,p1,p2,k3] or [k1,k2,p1,p2,k3,k4,k5,k6] of OpenCV's pinhole model"
_MAX_TANGENTIAL = 0.02  # limit of p1 and p2: real lenses are an order of magnitude below
_FISHEYE_NAMES = ("fisheye", "equidistant", "kannala", "omni")

Box = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class Lens:
    """The distortion of a photograph's lens, in OpenCV's order of coefficients. Undistorting keeps K."""

    K: Float[np.ndarray, "3 3"]
    coefficients: tuple[float, ...]

    def identity(self) -> list[Any]:
        """Part of cache keys: all that undistorted pixels depend on."""
        return ["undistorted", UNDISTORTION_VERSION, self.K.tolist(), list(self.coefficients)]

    def undistort(self, image: Shaped[np.ndarray, "H W *c"]) -> Shaped[np.ndarray, "H W *c"]:
        """An undistorted image, or mask (nearest neighbour)."""
        return undistort(image, self.K, self.coefficients, nearest=image.dtype == bool)

    def undistort_box(self, bbox_xyxy: Box, where: str) -> Box:
        """The bounding box of an undistorted box. Raises BadInput where the distortion cannot be inverted."""
        try:
            return undistort_box(bbox_xyxy, self.K, self.coefficients)
        except ValueError:
            needed = "a box in the part of the photograph that the coefficients describe"
            raise BadInput(
                where, found=f"a box where {list(self.coefficients)} cannot be undone", needed=needed
            ) from None


def parse_lens(given: Any, K: Float[np.ndarray, "3 3"], size_hw: tuple[int, int]) -> Lens | None:
    """``dataset.distortion``, checked; None if all coefficients are 0. Raises BadInput, by name for a fisheye lens."""
    where = "dataset.distortion"
    if not isinstance(given, str | Sequence):
        raise BadInput(where, found=given, needed=_NEEDED)
    words = [given] if isinstance(given, str) else [value for value in given if isinstance(value, str)]
    if any(_names_fisheye(word) for word in words):
        raise BadInput(
            where, found=f"a fisheye lens ({given})", needed=f"{_NEEDED}; undistort a fisheye photograph first"
        )
    if words or not all(is_number(value) and np.isfinite(value) for value in given):
        raise BadInput(where, found=given if isinstance(given, str) else list(given), needed=_NEEDED)
    coefficients = tuple(float(value) for value in given)
    if len(coefficients) not in COUNTS:
        extra = " (those of thin prisms and tilted sensors are not applied)" if len(coefficients) in (12, 14) else ""
        raise BadInput(where, found=f"{len(coefficients)} numbers", needed=_NEEDED + extra)
    if max(map(abs, coefficients[2:4])) > _MAX_TANGENTIAL:
        four = len(coefficients) == 4
        likely = "fisheye lenses have k1,k2,k3,k4" if four else "MATLAB, Agisoft and others write k1,k2,k3,p1,p2"
        found = f"p1 {coefficients[2]:g}, p2 {coefficients[3]:g}, larger than any lens's"
        raise BadInput(where, found=found, needed=f"{_NEEDED} ({likely})")
    if folds(K, coefficients, size_hw):
        found = f"{list(coefficients)}, which fold the image at this K"
        raise BadInput(where, found=found, needed=f"the coefficients of this camera: {_NEEDED}")
    return Lens(K, coefficients) if any(coefficients) else None


def describe_distortion(record: Mapping[str, Any]) -> str:
    """Warning that a camera record's distortion is not applied, with what to do; "" without distortion.

    Recognises any field with "dist" in its name, a list or a mapping, and fields k1, k2, ... of the record.
    """
    stated = [value for name, value in record.items() if "dist" in name.lower() and isinstance(value, list | dict)]
    values = list(stated[0].values()) if stated and isinstance(stated[0], dict) else stated[0] if stated else []
    if not values:
        values = [record[name] for name in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6") if name in record]
    coefficients = [float(value) for value in values if is_number(value)]
    if not any(coefficients):
        return ""
    shown = ",".join(f"{value:g}" for value in coefficients)
    texts = [text for item in record.items() for text in item if isinstance(text, str)]
    if any(map(_names_fisheye, texts)):
        return f"fisheye coefficients ({shown}) are not applied; undistort images and masks with cv2.fisheye first"
    return (
        f"distortion coefficients ({shown}) are not applied; undistort images, masks and boxes first (cv2.undistort "
        f"with this K), or give one photograph as dataset=photo dataset.distortion=[{shown}]"
    )


def _names_fisheye(text: str) -> bool:
    return any(name in text.lower() for name in _FISHEYE_NAMES)
