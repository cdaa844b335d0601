"""Colours in mesh files -> 8-bit rgb."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Num, UInt8

from pipeline.errors import BadInput

_UNIT_LIMIT = 2.0  # floats up to this are 0..1 with overshoot; larger ones mean 0..255


def to_uint8(path: Path, values: Num[np.ndarray, "n 3"]) -> UInt8[np.ndarray, "n 3"]:
    """Colours scaled to 0..255, from a file that does not state its scale.

    Floats are 0..1, or 0..255 if one exceeds 2. Integers are 0..255, or 0..65535 if one exceeds 255. Raises BadInput
    for other values.
    """
    if values.dtype == np.uint8:
        return values
    if not np.isfinite(values).all() or (values < 0).any():
        raise BadInput(path, found="a colour that is negative or not a number", needed="colours of 0..1 or 0..255")
    highest = float(values.max(initial=0))
    scale = 255.0 if values.dtype.kind == "f" and highest <= _UNIT_LIMIT else 1.0
    if scale == 1.0 and highest > 255:
        if highest > 65535:
            raise BadInput(path, found=f"a colour of {highest:g}", needed="colours of 0..1, 0..255 or 0..65535")
        scale = 255 / 65535
    return unit_to_uint8(values.astype(float) * (scale / 255))


def unit_to_uint8(values: Num[np.ndarray, "n 3"]) -> UInt8[np.ndarray, "n 3"]:
    """Colours of 0..1 scaled to 0..255, clipped and rounded."""
    return np.rint(np.clip(values, 0, 1) * 255).astype(np.uint8)
