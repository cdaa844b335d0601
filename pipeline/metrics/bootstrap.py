"""values of instances -> intervals of their mean, by resampling images: targets of one image are not independent."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

DRAWS = 2000
SEED = 0
LEVEL = 0.95


@dataclass(frozen=True)
class Interval:
    """A mean and the bounds between which it lies in LEVEL of the resamples."""

    mean: float
    low: float
    high: float

    @property
    def excludes_zero(self) -> bool:
        """Whether the interval leaves out 0: for a difference, whether it is more than chance."""
        return self.low > 0 or self.high < 0


def mean_interval(values: Float[np.ndarray, " n"], image: Int[np.ndarray, " n"]) -> Interval:
    """Mean of ``values`` over instances with its percentile interval (Efron, 1979) over images drawn with replacement.

    ``image``: index of each instance's image. NaN without an instance; no width with one image.
    """
    if not len(values):
        return Interval(np.nan, np.nan, np.nan)
    _, index = np.unique(image, return_inverse=True)
    sums, counts = np.bincount(index, weights=values), np.bincount(index)
    drawn = np.random.default_rng(SEED).multinomial(len(sums), np.full(len(sums), 1 / len(sums)), size=DRAWS)
    means = drawn @ sums / (drawn @ counts)
    low, high = np.quantile(means, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return Interval(float(values.mean()), float(low), float(high))


def paired_interval(
    ours: Float[np.ndarray, " n"], theirs: Float[np.ndarray, " n"], image: Int[np.ndarray, " n"]
) -> Interval:
    """Interval of the mean difference ``ours - theirs`` of the same instances in the same order."""
    return mean_interval(ours - theirs, image)


def image_index(scene_id: Int[np.ndarray, " n"], im_id: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """One number for each (scene_id, im_id)."""
    _, index = np.unique(np.stack([scene_id, im_id], axis=1), axis=0, return_inverse=True)
    return index.reshape(-1)
