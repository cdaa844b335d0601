"""values of instances -> bootstrap intervals of the mean. Resamples images, whose instances are not independent."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

DRAWS = 2000
SEED = 0
LEVEL = 0.95


@dataclass(frozen=True)
class Interval:
    """A mean with its LEVEL (95 %) confidence interval."""

    mean: float
    low: float
    high: float

    @property
    def excludes_zero(self) -> bool:
        """Whether 0 lies outside the interval: for a difference, whether it is significant."""
        return self.low > 0 or self.high < 0


def mean_interval(values: Float[np.ndarray, " n"], image: Int[np.ndarray, " n"]) -> Interval:
    """Mean over instances with its bootstrap percentile interval (Efron, 1979), resampling whole images.

    ``image``: index of each instance's image. NaN without instances; with one image the interval has no width.
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
    """Interval of the mean difference ``ours - theirs``; both list the same instances in the same order."""
    return mean_interval(ours - theirs, image)


def image_index(scene_id: Int[np.ndarray, " n"], im_id: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """Index of each instance's image: equal for equal (scene_id, im_id), counting from 0."""
    _, index = np.unique(np.stack([scene_id, im_id], axis=1), axis=0, return_inverse=True)
    return index.reshape(-1)
