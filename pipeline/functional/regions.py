"""image -> regions that may be objects: uniform patches, merged step by step (after Uijlings et al., IJCV 2013)."""

from __future__ import annotations

import heapq
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8
from scipy import ndimage

Strategy = Literal["colour", "chroma", "edge"]
STRATEGIES: tuple[Strategy, ...] = ("colour", "chroma", "edge")
"""Orders of merging: by colour, by colour without brightness, by the contrast along the common border."""

_BLUR_PX, _MINIMUM_PX = 1.0, 5
_FLAT = 4.0  # grey levels per px; weaker gradients separate no patches
_BINS = 20  # of the histogram of each channel
_HISTOGRAMS, _BORDER = 25.0, 0.5  # weights beside the distance of the mean colours, in grey levels
_FAVOUR_SMALL = 0.15, 0.2  # power of the smaller region's share of the image: by colours, by border
_LEAST_FILL = 0.12  # of the square around a region; thinner ones are lines and frames
_MARGIN = 0.7, 0.45  # smallest extent and root of the smallest area, as shares of the smallest object's side


def propose_regions(
    rgb: UInt8[np.ndarray, "H W 3"], *, side: int, smallest: float, largest: float, overlap: float
) -> list[Bool[np.ndarray, "H W"]]:
    """Masks of regions, of which no two have an IoU above ``overlap``.

    The image is scaled down to ``side`` px along its longer side, of which regions extend over ``smallest`` to
    ``largest``.
    """
    scale = min(1.0, side / max(rgb.shape))
    small = cv2.resize(rgb, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else rgb
    lab = cv2.cvtColor(small, cv2.COLOR_RGB2LAB).astype(np.float32)
    gradient = _gradient(lab)
    patches = _split(gradient)
    found = (_merge(patches, gradient, lab, small, strategy) for strategy in STRATEGIES)
    members = np.concatenate([part[_plausible(part, patches, smallest, largest)] for part in found])
    members = members[_distinct(members, patches, overlap)]
    large = cv2.resize(patches.astype(np.float32), rgb.shape[1::-1], interpolation=cv2.INTER_NEAREST).astype(np.int64)
    opened = (cv2.morphologyEx(m[large].astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) for m in members)
    return [mask > 0 for mask in opened if mask.any()]


def _gradient(lab: Float32[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w"]:
    """Length of the gradient over all channels, grey levels per px."""
    smooth = np.asarray(cv2.GaussianBlur(lab, (0, 0), _BLUR_PX))
    steps = [cv2.Sobel(smooth, cv2.CV_32F, dx, 1 - dx, scale=0.25) for dx in (1, 0)]
    return np.sqrt(sum(np.square(step).sum(-1) for step in steps))


def _split(gradient: Float[np.ndarray, "h w"]) -> Int[np.ndarray, "h w"]:
    """Labels 0, 1, ... of patches: a watershed from the local minima and the flat areas."""
    seeds = (gradient <= ndimage.minimum_filter(gradient, _MINIMUM_PX) + 0.3) | (gradient < _FLAT)
    labels, _ = ndimage.label(seeds)
    grown = ndimage.watershed_ift(np.clip(4 * gradient, 0, 255).astype(np.uint8), labels.astype(np.int32))
    return np.unique(grown, return_inverse=True)[1].reshape(grown.shape)


def _merge(
    patches: Int[np.ndarray, "h w"],
    gradient: Float[np.ndarray, "h w"],
    lab: Float32[np.ndarray, "h w 3"],
    rgb: UInt8[np.ndarray, "h w 3"],
    strategy: Strategy,
) -> Bool[np.ndarray, "r p"]:
    """The patches of every region on the way from single patches to the whole image."""
    regions = _Regions.of(patches, gradient, _channels(lab, rgb, strategy))
    cost = regions.border_cost if strategy == "edge" else regions.colour_cost
    members = [*np.eye(regions.count, dtype=bool)]
    for i, j in regions.merge_all(cost):
        members.append(members[i] | members[j])
    return np.stack(members)


def _channels(
    lab: Float32[np.ndarray, "h w 3"], rgb: UInt8[np.ndarray, "h w 3"], strategy: Strategy
) -> Float32[np.ndarray, "h w c"]:
    if strategy != "chroma":
        return lab * np.array([0.6, 1.3, 1.3], np.float32)
    light = rgb.astype(np.float32) + 5
    return np.concatenate([200 * light / light.sum(-1, keepdims=True), 0.15 * lab[..., :1]], -1)


@dataclass(eq=False)
class _Regions:
    """Statistics of all regions, first the patches; ``neighbours`` maps to [sum of gradients, length] of a border."""

    count: int
    size: Float[np.ndarray, " r"]
    mean: Float[np.ndarray, "r c"]
    histogram: Float[np.ndarray, "r b"]
    neighbours: list[dict[int, list[float]]]

    @classmethod
    def of(cls, patches: Int[np.ndarray, "h w"], gradient: Float[np.ndarray, "h w"], channels: np.ndarray) -> _Regions:
        """The patches, with room for the regions they merge into."""
        n, flat = int(patches.max()) + 1, patches.ravel()
        size = np.bincount(flat, minlength=n).astype(float)
        planes = [channels[..., c].ravel() for c in range(channels.shape[-1])]
        mean = np.stack([np.bincount(flat, plane, minlength=n) / size for plane in planes], axis=1)
        histogram = np.concatenate([_histograms(flat, plane, n) for plane in planes], axis=1)
        size, mean, histogram = (np.concatenate([x, np.zeros((n - 1, *x.shape[1:]))]) for x in (size, mean, histogram))
        return cls(n, size, mean, histogram, _borders(patches, gradient, n))

    def border_cost(self, i: int, j: int) -> float:
        """Mean gradient along the common border; small regions merge first."""
        total, length = self.neighbours[i][j]
        return float(total / length * self._share(i, j) ** _FAVOUR_SMALL[1])

    def colour_cost(self, i: int, j: int) -> float:
        """Difference of colours and their histograms, and of the gradient between; small regions merge first."""
        total, length = self.neighbours[i][j]
        distance = float(np.sqrt(np.square(self.mean[i] - self.mean[j]).sum()))
        common = np.minimum(self.histogram[i] / self.size[i], self.histogram[j] / self.size[j]).sum()
        differing = _HISTOGRAMS * (1 - common / self.mean.shape[1])
        return float((distance + differing + _BORDER * total / length) * self._share(i, j) ** _FAVOUR_SMALL[0])

    def _share(self, i: int, j: int) -> float:
        return float(min(self.size[i], self.size[j]) / self.size[: self.count].sum())

    def merge_all(self, cost: Callable[[int, int], float]) -> list[tuple[int, int]]:
        """The pairs in the order in which they merge, cheapest first; the k-th pair becomes region ``count`` + k."""
        heap = [(cost(i, j), i, j) for i, near in enumerate(self.neighbours) for j in near if i < j]
        heapq.heapify(heap)
        merged: list[tuple[int, int]] = []
        gone: set[int] = set()
        while heap:
            _, i, j = heapq.heappop(heap)
            if i in gone or j in gone:
                continue
            gone |= {i, j}
            new = self.count + len(merged)
            merged.append((i, j))
            self._join(i, j, new)
            for other in self.neighbours[new]:
                heapq.heappush(heap, (cost(new, other), new, other))
        return merged

    def _join(self, i: int, j: int, new: int) -> None:
        """Write the union of two regions at ``new`` and give it their neighbours."""
        self.size[new] = self.size[i] + self.size[j]
        self.mean[new] = (self.mean[i] * self.size[i] + self.mean[j] * self.size[j]) / self.size[new]
        self.histogram[new] = self.histogram[i] + self.histogram[j]
        around: dict[int, list[float]] = {}
        for part in (i, j):
            for other, (total, length) in self.neighbours[part].items():
                if other not in (i, j):
                    border = around.setdefault(other, [0.0, 0.0])
                    border[0] += total
                    border[1] += length
        self.neighbours.append(around)
        for other, border in around.items():
            self.neighbours[other].pop(i, None)
            self.neighbours[other].pop(j, None)
            self.neighbours[other][new] = border


def _histograms(labels: np.ndarray, values: np.ndarray, count: int) -> Float[np.ndarray, "n b"]:
    low, high = values.min(), values.max() + 1e-3
    bins = ((values - low) / (high - low) * _BINS).astype(np.int64).clip(0, _BINS - 1)
    return np.bincount(labels * _BINS + bins, minlength=count * _BINS).reshape(count, _BINS).astype(float)


def _borders(
    patches: Int[np.ndarray, "h w"], gradient: Float[np.ndarray, "h w"], count: int
) -> list[dict[int, list[float]]]:
    """For each patch, the sum of gradients along the border to each neighbour, and the border's length."""
    neighbours: list[dict[int, list[float]]] = [{} for _ in range(count)]
    for a, b in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        first, second, steep = patches[a], patches[b], np.maximum(gradient[a], gradient[b])
        differs = first != second
        low, high = np.minimum(first, second)[differs], np.maximum(first, second)[differs]
        pair, index = np.unique(low * count + high, return_inverse=True)
        totals, lengths = np.bincount(index, steep[differs]), np.bincount(index)
        for code, total, length in zip(pair.tolist(), totals.tolist(), lengths.tolist(), strict=True):
            i, j = divmod(code, count)
            border = neighbours[i].setdefault(j, [0.0, 0.0])
            neighbours[j][i] = border
            border[0] += total
            border[1] += length
    return neighbours


def _plausible(
    members: Bool[np.ndarray, "r p"], patches: Int[np.ndarray, "h w"], smallest: float, largest: float
) -> Bool[np.ndarray, " r"]:
    """Regions whose extent and area an object can have."""
    index, longer = np.arange(members.shape[1]), max(patches.shape)
    extents = []
    for positions in np.indices(patches.shape):
        low, high = (
            np.asarray(find(positions, patches, index), np.float32) for find in (ndimage.minimum, ndimage.maximum)
        )
        extents.append(np.where(members, high, -np.inf).max(1) - np.where(members, low, np.inf).min(1) + 1)
    extent = np.maximum(*extents)
    area = members @ np.bincount(patches.ravel()).astype(float)
    in_range = (extent >= _MARGIN[0] * smallest * longer) & (extent <= largest * longer)
    return in_range & (area >= (_MARGIN[1] * smallest * longer) ** 2) & (area > _LEAST_FILL * extent**2)


def _distinct(
    members: Bool[np.ndarray, "r p"], patches: Int[np.ndarray, "h w"], overlap: float
) -> Bool[np.ndarray, " r"]:
    """Regions whose IoU with every kept region before them is at most ``overlap``."""
    weight = np.bincount(patches.ravel()).astype(np.float32)
    area, members_f = members @ weight, members.astype(np.float32)
    keep = np.zeros(len(members), bool)
    open_ = np.ones(len(members), bool)
    for k in range(len(members)):
        if open_[k]:
            keep[k] = True
            common = members_f @ (members_f[k] * weight)
            open_ &= common <= overlap * (area + area[k] - common)
    return keep
