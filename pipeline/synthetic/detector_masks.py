"""True masks -> simulated masks of a detector, with typical errors."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool

from pipeline.synthetic.parts import Rng

Mask = Bool[np.ndarray, "h w"]

SHARES = {
    "wavy": 0.36,
    "merged": 0.12,
    "cut": 0.11,
    "holes": 0.05,
    "wide": 0.09,
    "another": 0.17,
    "missing": 0.05,
    "box": 0.05,
}
"""How often each kind of mask occurs, chosen to be plausible, not fitted to a detector. A third only has a rough
contour, a fifth covers another object or is missing, and the rest have typical errors of segmentation."""


def imitate_detector(visible: Mask, silhouette: Mask, others: Sequence[Mask], rng: Rng) -> tuple[Mask, bool] | None:
    """A simulated mask of an instance, and whether only its box is given; None if the instance is missed.

    ``visible``: its visible part; ``silhouette``: its outline without occluders; ``others``: masks of other objects.
    """
    kind = str(rng.choice(list(SHARES), p=list(SHARES.values())))
    if kind == "missing" or not visible.any():
        return None
    if kind == "another" and others:
        return _wavy(others[int(rng.integers(len(others)))], rng), False
    change = {"merged": _merge, "cut": _cut, "holes": _pierce, "wide": _widen}.get(kind)
    changed = visible if change is None else change(visible, silhouette, others, rng)
    mask = _wavy(changed, rng)
    return (mask if mask.any() else visible), kind == "box"


def box_xywh(mask: Mask) -> list[int]:
    """The box of a mask: first column, first row, number of columns, number of rows."""
    ys, xs = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    return [int(xs[0]), int(ys[0]), int(np.ptp(xs) + 1), int(np.ptp(ys) + 1)]


def _wavy(mask: Mask, rng: Rng) -> Mask:
    """Move the contour in and out by about 1.5 px."""
    coarse = rng.normal(0, 1.5, tuple(max(2, n // 12) for n in mask.shape)).astype(np.float32)
    shift = cv2.resize(coarse, mask.shape[::-1], interpolation=cv2.INTER_CUBIC)
    return _signed_distance(mask) > shift


def _merge(visible: Mask, silhouette: Mask, others: Sequence[Mask], rng: Rng) -> Mask:
    """Add a part of the occluder or, without one, of what is beside the object."""
    hidden = silhouette & ~visible
    if hidden.sum() > 20:
        return visible | _dilate(hidden, int(rng.integers(3, 12)))
    around = _dilate(visible, int(rng.integers(8, 20)))
    near = [other & around for other in others]
    largest = max(near, key=lambda part: part.sum(), default=visible)
    return visible | largest if largest.sum() > 20 else visible | (around & _half_plane(visible, rng, 0.75))


def _cut(visible: Mask, silhouette: Mask, others: Sequence[Mask], rng: Rng) -> Mask:
    """Remove one side, as when a segment ends at an inner edge."""
    return visible & _half_plane(visible, rng, rng.uniform(0.25, 0.5))


def _pierce(visible: Mask, silhouette: Mask, others: Sequence[Mask], rng: Rng) -> Mask:
    """Cut one to three round holes."""
    ys, xs = np.nonzero(visible)
    y, x = np.mgrid[: visible.shape[0], : visible.shape[1]]
    holes = np.zeros_like(visible)
    for i in rng.integers(len(ys), size=int(rng.integers(1, 4))):
        holes |= (y - ys[i]) ** 2 + (x - xs[i]) ** 2 < rng.uniform(0.02, 0.08) * len(ys)
    return visible & ~holes


def _widen(visible: Mask, silhouette: Mask, others: Sequence[Mask], rng: Rng) -> Mask:
    """Dilate by two to five pixels."""
    return _dilate(visible, int(rng.integers(2, 6)))


def _half_plane(mask: Mask, rng: Rng, share: float) -> Mask:
    """A half plane in a random direction that excludes this share of the mask's pixels."""
    angle = rng.uniform(0, 2 * np.pi)
    y, x = np.mgrid[: mask.shape[0], : mask.shape[1]]
    along = x * np.cos(angle) + y * np.sin(angle)
    return along > np.quantile(along[mask], share)


def _dilate(mask: Mask, radius_px: int) -> Mask:
    return _signed_distance(mask) > -radius_px


def _signed_distance(mask: Mask) -> np.ndarray:
    """Distance to the contour, px, positive inside."""
    inside = mask.astype(np.uint8)
    return np.asarray(cv2.distanceTransform(inside, cv2.DIST_L2, 5) - cv2.distanceTransform(1 - inside, cv2.DIST_L2, 5))
