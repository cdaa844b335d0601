"""errors of estimates -> which estimate found which instance, as bop_toolkit matches them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float


def select_best_scored(scores: Sequence[float], count: int) -> list[int]:
    """Indices of the ``count`` estimates with the highest scores, best first; equals keep their order; 0: all."""
    order = sorted(range(len(scores)), key=lambda i: -scores[i])
    return order[:count] if count else order


def match_instances(errors: Float[np.ndarray, "e g"], threshold: float) -> list[tuple[int, int]]:
    """Pairs (estimate, instance) of the greedy matching: estimates, best score first, each take the nearest instance.

    Only instances that are still free and whose error is below ``threshold`` can be taken; of equals, the first.
    """
    taken: list[tuple[int, int]] = []
    free = np.ones(errors.shape[1], dtype=bool)
    for est, row in enumerate(errors):
        open_row = np.where(free, row, np.inf)
        gt = int(np.argmin(open_row)) if open_row.size else -1
        if gt >= 0 and open_row[gt] < threshold:
            taken.append((est, gt))
            free[gt] = False
    return taken
