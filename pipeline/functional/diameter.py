"""Points -> largest distance between two of them: branch and bound over pairs of boxes."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

_FEW_POINTS = 2048  # so few are compared with each other directly
_LEAF_POINTS = 16
_BLOCK_PAIRS = 1 << 17  # pairs of boxes halved at a time
_STEPS = 12  # of the search for a first long pair; three suffice almost always
_MARGIN = 1e-13  # of the diameter: longer distances within it are not looked for


def point_diameter(points: Float[np.ndarray, "n 3"]) -> float:
    """Largest distance between two of the points, in their unit; exact to 1e-13 of it.

    Points and pairs of boxes that cannot hold a longer distance than the longest one known are dropped, so a ball of a
    million points takes seconds. Bounds follow from |a - b|^2 = 2 |a|^2 + 2 |b|^2 - |a + b|^2 about a centre, which is
    tight on balls and cylinders, and from the boxes' corners.
    """
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    longest = _long_pair(points, centre)
    radius = np.linalg.norm(points - centre, axis=-1)
    # by the triangle inequality, both ends of a longer distance lie at least this far from the centre
    points = points[radius >= (longest - radius.max()) * (1 - 1e-9)]
    if len(points) <= _FEW_POINTS:
        return max(longest, _largest_distance(points))
    return _search(points, centre, longest)


def _long_pair(points: Float[np.ndarray, "n 3"], start: Float[np.ndarray, " 3"]) -> float:
    """A lower bound: from the point farthest from ``start``, go to the farthest point until that is no longer."""
    longest = 0.0
    for _ in range(_STEPS):
        squares = ((points - start) ** 2).sum(axis=-1)
        start = points[squares.argmax()]
        distance = float(_distances(start[None], points).max())
        if distance <= longest:
            break
        longest = distance
    return longest


def _largest_distance(points: Float[np.ndarray, "n 3"]) -> float:
    rows = range(0, len(points), 512)
    return max((float(_distances(points[row : row + 512], points).max()) for row in rows), default=0.0)


def _distances(a: Float[np.ndarray, "n 3"], b: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "n m"]:
    from scipy.spatial.distance import cdist

    return cdist(a, b)


def _search(points: Float[np.ndarray, "n 3"], centre: Float[np.ndarray, " 3"], longest: float) -> float:
    """Branch and bound from the root of a balanced tree."""
    levels, leaves = _build_tree(points, centre)
    root = np.zeros(1, np.int64)
    todo = [(0, root, root, levels[0].bounds(root, root))]  # depth first, so that few pairs are in memory
    while todo:
        level, first, second, bound = todo.pop()
        keep = np.flatnonzero(bound > longest * (1 + _MARGIN))
        if len(keep) > _BLOCK_PAIRS:
            keep = keep[np.argsort(bound[keep])]  # the most promising pairs come first
            rest, keep = keep[:-_BLOCK_PAIRS], keep[-_BLOCK_PAIRS:]
            todo.append((level, first[rest], second[rest], bound[rest]))
        first, second = first[keep], second[keep]
        if not len(keep):
            continue
        if level + 1 == len(levels):
            longest = max(longest, _compare(leaves, first, second))
            continue
        longest = max(longest, levels[level].sample(first, second))
        first, second = _children(first, second)
        todo.append((level + 1, first, second, levels[level + 1].bounds(first, second)))
    return longest


def _build_tree(
    points: Float[np.ndarray, "n 3"], centre: Float[np.ndarray, " 3"]
) -> tuple[list[_Boxes], Float[np.ndarray, "b m 3"]]:
    """Boxes of 1, 2, 4, ... groups of equally many points, halved along their longest side; and the last groups."""
    depth = max(0, int(np.ceil(np.log2(len(points) / _LEAF_POINTS))))
    missing = -len(points) % (1 << depth)
    groups = np.concatenate([points, np.repeat(points[-1:], missing, axis=0)])[None]
    levels = [_Boxes(groups, centre)]
    for _ in range(depth):
        half = groups.shape[1] // 2
        longest_side = np.ptp(groups, axis=1).argmax(axis=-1)
        along = np.take_along_axis(groups, longest_side[:, None, None], axis=2)[..., 0]
        order = np.argpartition(along, half, axis=1)
        groups = np.take_along_axis(groups, order[..., None], axis=1).reshape(2 * len(groups), half, 3)
        levels.append(_Boxes(groups, centre))
    return levels, groups


class _Boxes:
    """Bounding boxes about the centre of the groups of one level, their outermost points, and radii."""

    def __init__(self, groups: Float[np.ndarray, "b m 3"], centre: Float[np.ndarray, " 3"]) -> None:
        groups = groups - centre
        self.low, self.high = groups.min(axis=1), groups.max(axis=1)
        self.middle = (self.low + self.high) / 2
        squares = (groups**2).sum(axis=-1)
        self.outermost = groups[np.arange(len(groups)), squares.argmax(axis=1)]
        self.square = squares.max(axis=1)
        self.reach = np.sqrt(((groups - self.middle[:, None]) ** 2).sum(axis=-1).max(axis=1))

    def bounds(self, a: Int[np.ndarray, " p"], b: Int[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
        """Upper bounds of the distances between the points of pairs of groups."""
        corners = np.maximum(self.high[a] - self.low[b], self.high[b] - self.low[a])
        by_corners = (corners**2).sum(axis=-1)
        sums = np.sqrt(((self.middle[a] + self.middle[b]) ** 2).sum(axis=-1))
        least = np.maximum(sums - self.reach[a] - self.reach[b], 0)
        by_radius = 2 * self.square[a] + 2 * self.square[b] - least**2
        return np.sqrt(np.minimum(by_corners, by_radius))

    def sample(self, a: Int[np.ndarray, " p"], b: Int[np.ndarray, " p"]) -> float:
        """Largest distance between the outermost points of the groups of each pair."""
        difference = self.outermost[a] - self.outermost[b]
        return float(np.sqrt((difference**2).sum(axis=-1).max()))


def _children(a: Int[np.ndarray, " p"], b: Int[np.ndarray, " p"]) -> tuple[Int[np.ndarray, " q"], ...]:
    """Pairs of the halves of pairs of groups, each unordered pair once."""
    first = np.concatenate([2 * a, 2 * a, 2 * a + 1, 2 * a + 1])
    second = np.concatenate([2 * b, 2 * b + 1, 2 * b, 2 * b + 1])
    once = first <= second
    return first[once], second[once]


def _compare(leaves: Float[np.ndarray, "b m 3"], a: Int[np.ndarray, " p"], b: Int[np.ndarray, " p"]) -> float:
    """Largest distance between two points of the groups of each pair."""
    longest = 0.0
    for row in range(0, len(a), 4096):  # a million distances, 25 MB
        first, second = a[row : row + 4096], b[row : row + 4096]
        difference = leaves[first][:, :, None] - leaves[second][:, None]
        pair = np.einsum("pijc,pijc->pij", difference, difference).max(axis=(1, 2)).argmax()
        longest = max(longest, float(_distances(leaves[first[pair]], leaves[second[pair]]).max()))
    return longest
