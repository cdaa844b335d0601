"""Rows of arrays."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int, Num


def rank_rows(columns: list[Num[np.ndarray, " n"]]) -> Int[np.ndarray, " n"]:
    """Integers in the order of the rows, compared column by column; equal rows get equal numbers.

    Sorting one column at a time takes a fraction of the time and memory of sorting rows.
    """
    key = np.zeros(len(columns[0]), dtype=np.int64)
    for column in columns:
        distinct, rank = np.unique(column, return_inverse=True)
        key = key * len(distinct) + rank
        key = np.unique(key, return_inverse=True)[1]  # so that the next product stays small
    return key
