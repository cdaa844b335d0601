"""errors of estimates -> matches between estimates and annotated instances, as in bop_toolkit."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float


def select_best_scored(scores: Sequence[float], count: int) -> list[int]:
    """Indices of the ``count`` highest scores, best first; ties keep their order. ``count`` 0: all."""
    order = sorted(range(len(scores)), key=lambda i: -scores[i])
    return order[:count] if count else order


def match_instances(errors: Float[np.ndarray, "e g"], threshold: float) -> list[tuple[int, int]]:
    """Greedy matching as pairs (estimate, instance). Rows of ``errors`` are estimates, best score first.

    Each estimate takes the free instance with the smallest error, if it is below ``threshold``; ties go to the first.
    """
    matches: list[tuple[int, int]] = []
    free = np.ones(errors.shape[1], dtype=bool)
    for est, row in enumerate(errors):
        free_errors = np.where(free, row, np.inf)
        gt = int(np.argmin(free_errors)) if free_errors.size else -1
        if gt >= 0 and free_errors[gt] < threshold:
            matches.append((est, gt))
            free[gt] = False
    return matches
