"""The paper's online path, written plainly with scikit-learn, SciPy and OpenCV; reference for speed and correctness.

Von Gimborn et al., "Diffusion Features for Zero-Shot 6DoF Object Pose Estimation", in two readings: ``DZOP`` is that of
``method=dzop``, the defaults of match=cosine, fuse=pca, cluster=kmeans, correspond=cosine and solve=epnp; ``LETTER`` is
that of ``method=dzop_paper``. It shares no code with the package, uses numpy arrays, and prefers clarity to speed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.distance import cdist
from sklearn.cluster import KMeans
from sklearn.decomposition import PCA
from sklearn.metrics.pairwise import cosine_similarity
from sklearn.preprocessing import normalize

Map = Float[np.ndarray, "c h w"]
Cells = Bool[np.ndarray, "h w"]
View = tuple[Mapping[int, Map], Bool[np.ndarray, "S S"], np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""features by layer, mask, A_crop_img, depth (mm), K and T_cam_obj of a template"""


@dataclass(frozen=True)
class Reading:
    """What the paper leaves open, or ``method=dzop`` adds to it; fields as in conf/method/dzop_paper.yaml."""

    normalise: bool = True
    all_cells: bool = False
    planar: str = "skip"
    mutual: bool = True
    subtract_own_shift: bool = True
    iterations: int = 400
    confidence: float = 0.999
    refine: bool = True


DZOP = Reading()
LETTER = Reading(
    normalise=False, all_cells=True, planar="fundamental", mutual=False, subtract_own_shift=False,
    iterations=100, confidence=0.99, refine=False,
)  # fmt: skip


def retrieve(query: Map, bank: Float[np.ndarray, "n c h w"]) -> Float[np.ndarray, " n"]:
    """Cosine of the flattened maps."""
    return cosine_similarity(query.reshape(1, -1), bank.reshape(len(bank), -1))[0]


def cell_mask(mask: Bool[np.ndarray, "S S"], cells: int) -> Cells:
    """Cells of which at least half is covered."""
    return cv2.resize(mask.astype(np.float64), (cells, cells), interpolation=cv2.INTER_AREA) >= 0.5 - 1e-5


def cells_inside(features: Map, mask: Cells) -> Float[np.ndarray, "m c"]:
    """Features of the cells inside a mask, in reading order."""
    return features[:, mask].T


def co_project(
    query: Mapping[int, Map],
    template: Mapping[int, Map],
    query_mask: Bool[np.ndarray, "S S"],
    template_mask: Bool[np.ndarray, "S S"],
    *,
    dims: Mapping[int, int],
    reading: Reading = DZOP,
) -> tuple[Map, Map]:
    """Joint PCA by layer, upsampled to the finest layer, concatenated; scaled to unit root mean square if so read."""
    finest = max(m.shape[-1] for m in query.values())
    blocks: tuple[list[Map], list[Map]] = ([], [])
    for layer, dim in dims.items():
        cells = query[layer].shape[-1]
        masks = [np.ones_like(mask) if reading.all_cells else mask for mask in (query_mask, template_mask)]
        inside = [cell_mask(mask, cells) for mask in masks]
        sides = [m[layer].astype(np.float64) for m in (query, template)]
        samples = np.concatenate([cells_inside(m, mask) for m, mask in zip(sides, inside, strict=True)])
        pca = PCA(n_components=dim, svd_solver="full").fit(samples)
        scale = np.sqrt(np.mean(np.sum(pca.transform(samples) ** 2, axis=1))) if reading.normalise else 1.0
        for block, m in zip(blocks, sides, strict=True):
            flat = pca.transform(m.reshape(len(m), -1).T) / scale
            block.append(cv2.resize(flat.reshape(cells, cells, dim), (finest, finest), interpolation=cv2.INTER_LINEAR))
    return tuple(np.concatenate(block, axis=2).transpose(2, 0, 1) for block in blocks)  # type: ignore[return-value]


def k_means(
    points: Float[np.ndarray, "m c"], *, count: int, seed: int, iterations: int
) -> tuple[Int[np.ndarray, " m"], Float[np.ndarray, "k c"]]:
    """Labels and centres: k-means++ initialisation (Arthur and Vassilvitskii, SODA 2007), then scikit-learn."""
    draws = np.random.default_rng(seed).random(count)
    chosen = [min(int(draws[0] * len(points)), len(points) - 1)]
    nearest = cdist(points, points[chosen], "sqeuclidean")[:, 0]
    for draw in draws[1:]:
        cumulative = np.cumsum(nearest)
        if cumulative[-1] <= 0:
            break
        chosen.append(int(np.searchsorted(cumulative, draw * cumulative[-1], side="right")))
        nearest = np.minimum(nearest, cdist(points, points[chosen[-1:]], "sqeuclidean")[:, 0])
    found = KMeans(len(chosen), init=points[chosen], n_init=1, max_iter=iterations, tol=0, algorithm="lloyd").fit(
        points
    )
    return found.labels_, found.cluster_centers_


def pair_clusters(
    query_centres: Float[np.ndarray, "k c"], template_centres: Float[np.ndarray, "l c"]
) -> Int[np.ndarray, "p 2"]:
    """Pairs of clusters that are mutual nearest neighbours."""
    similarity = cosine_similarity(query_centres, template_centres)
    best, back = similarity.argmax(axis=1), similarity.argmax(axis=0)
    return np.array([(i, j) for i, j in enumerate(best) if back[j] == i])


def consistent_pairs(
    a: Float[np.ndarray, "p 2"], b: Float[np.ndarray, "p 2"], *, threshold: float, seed: int, planar: str = "skip"
) -> Bool[np.ndarray, " p"]:
    """Mask of pairs consistent with a fundamental matrix. ``planar``: what if a homography explains them about as well.

    ``skip``: all pairs; ``homography``: those consistent with it; ``fundamental``: as for any other set.
    """
    order = np.random.default_rng(seed).permutation(len(a))
    everything, kept = np.ones(len(a), dtype=bool), np.zeros(len(a), dtype=bool)
    if len(a) < 8:
        return everything
    F, agree = cv2.findFundamentalMat(a[order], b[order], cv2.FM_RANSAC, threshold, 0.99, 1000)
    if F is None or agree.sum() < 8:
        return everything
    H, on_plane = cv2.findHomography(a[order], b[order], cv2.RANSAC, threshold, maxIters=200, confidence=0.99)
    if planar != "fundamental" and H is not None and on_plane.sum() >= 0.8 * agree.sum():
        if planar == "skip":
            return everything
        agree = on_plane
    kept[order[agree[:, 0] > 0]] = True
    return kept


def label_map(features: Map, mask: Cells, *, count: int, seed: int, iterations: int) -> tuple[np.ndarray, np.ndarray]:
    """Cluster of each cell, -1 outside the mask, and the cluster centres; features are normalised to unit length."""
    labels, centres = k_means(normalize(cells_inside(features, mask)), count=count, seed=seed, iterations=iterations)
    found = np.full(mask.shape, -1)
    found[mask] = labels
    return found, centres


def cluster(
    query: Map,
    template: Map,
    query_mask: Cells,
    template_mask: Cells,
    *,
    count: int = 200,
    iterations: int = 20,
    reading: Reading = DZOP,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Labels of both maps, and the matched pairs of clusters."""
    query_label, query_centres = label_map(query, query_mask, count=count, seed=0, iterations=iterations)
    template_label, template_centres = label_map(template, template_mask, count=count, seed=0, iterations=iterations)
    pairs = pair_clusters(query_centres, template_centres)
    middle = [
        np.array([np.argwhere(label == k)[:, ::-1].mean(axis=0) for k in pairs[:, side]])
        for side, label in enumerate((query_label, template_label))
    ]
    kept = consistent_pairs(*middle, threshold=2.0, seed=0, planar=reading.planar)
    return query_label, template_label, pairs[kept]


def sub_pixel(
    feature: Float[np.ndarray, " c"], template: Float[np.ndarray, "h w c"], mask: Cells, row: int, column: int
) -> Float[np.ndarray, " 2"]:
    """Similarity-weighted mean offset (x, y), in cells, over the 3 x 3 neighbourhood inside the mask."""
    total, offset = 0.0, np.zeros(2)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            y, x = row + dy, column + dx
            if 0 <= y < mask.shape[0] and 0 <= x < mask.shape[1] and mask[y, x]:
                weight = max(float(feature @ template[y, x]), 0.0)
                total += weight
                offset += weight * np.array([dx, dy])
    return offset / total if total > 0 else offset


def correspond(
    query: Map,
    template: Map,
    template_mask: Cells,
    query_label: Int[np.ndarray, "h w"],
    template_label: Int[np.ndarray, "h w"],
    pairs: Int[np.ndarray, "p 2"],
    *,
    crop_size: int,
    per_cluster: int = 10,
    reading: Reading = DZOP,
) -> tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, "m 2"]]:
    """Crop pixels in query and template: the most similar nearest neighbours of each cluster pair."""
    q = normalize(query.reshape(len(query), -1).T).reshape(*query.shape[1:], -1)
    t = normalize(template.reshape(len(template), -1).T).reshape(*template.shape[1:], -1)
    stride = crop_size / query.shape[-1]
    query_px, template_px = [], []
    for query_cluster, template_cluster in pairs:
        query_cells, template_cells = (
            np.argwhere(query_label == query_cluster),
            np.argwhere(template_label == template_cluster),
        )
        similarity = cosine_similarity(q[tuple(query_cells.T)], t[tuple(template_cells.T)])
        forward, back = similarity.argmax(axis=1), similarity.argmax(axis=0)
        both_ways = [(i, j) for i, j in enumerate(forward) if not reading.mutual or back[j] == i]
        found = [(similarity[i, j], i, j) for i, j in both_ways if similarity[i, j] > 0]
        found.sort(key=lambda match: -match[0])
        for _, i, j in found[:per_cluster]:
            (y, x), (row, column) = query_cells[i], template_cells[j]
            shift = sub_pixel(q[y, x], t, template_mask, row, column)
            if reading.subtract_own_shift:
                shift = shift - sub_pixel(t[row, column], t, template_mask, row, column)
            query_px.append((np.array([x, y]) + 0.5) * stride - 0.5)
            template_px.append((np.array([column, row]) + shift + 0.5) * stride - 0.5)
    return np.array(query_px), np.array(template_px)


def object_point(
    px_crop: Float[np.ndarray, " 2"],
    A_crop_img: Float[np.ndarray, "3 3"],
    depth_mm: Float[np.ndarray, "H W"],
    K: Float[np.ndarray, "3 3"],
    T_cam_obj: Float[np.ndarray, "4 4"],
) -> Float[np.ndarray, " 3"]:
    """Object point (mm) at a pixel of a template's crop; NaN in the background."""
    x, y, w = np.linalg.inv(A_crop_img) @ [*px_crop, 1.0]
    x, y = x / w, y / w
    depth = float(depth_mm[int(np.floor(y + 0.5)), int(np.floor(x + 0.5))])
    point_cam = np.linalg.inv(K) @ [x, y, 1.0] * (depth if depth > 0 else np.nan)
    return T_cam_obj[:3, :3].T @ (point_cam - T_cam_obj[:3, 3])


def solve(
    points_obj: Float[np.ndarray, "m 3"],
    px: Float[np.ndarray, "m 2"],
    K: Float[np.ndarray, "3 3"],
    *,
    seed: int = 0,
    reading: Reading = DZOP,
) -> Float[np.ndarray, "4 4"]:
    """RANSAC EPnP, then three rounds of Levenberg-Marquardt on the inliers if so read."""
    order = np.random.default_rng(seed).permutation(len(points_obj))
    _, rvec, tvec, _ = cv2.solvePnPRansac(
        points_obj[order], px[order], K, None, iterationsCount=reading.iterations, reprojectionError=8.0,
        confidence=reading.confidence, flags=cv2.SOLVEPNP_EPNP,
    )  # fmt: skip
    for _ in range(3 if reading.refine else 0):
        projected = cv2.projectPoints(points_obj, rvec, tvec, K, None)[0][:, 0]
        near = np.linalg.norm(projected - px, axis=1) < 8.0
        rvec, tvec = cv2.solvePnPRefineLM(points_obj[near], px[near], K, None, rvec, tvec)
    T_cam_obj = np.eye(4)
    T_cam_obj[:3, :3], T_cam_obj[:3, 3] = cv2.Rodrigues(rvec)[0], tvec[:, 0]
    return T_cam_obj


def pose(
    query: Mapping[int, Map],
    query_mask: Bool[np.ndarray, "S S"],
    A_crop_img: Float[np.ndarray, "3 3"],
    K: Float[np.ndarray, "3 3"],
    bank: Float[np.ndarray, "n c h w"],
    view: Callable[[int], View],
    *,
    dims: Mapping[int, int],
    reading: Reading = DZOP,
) -> tuple[int, Float[np.ndarray, "4 4"]]:
    """The best template and T_cam_obj (mm)."""
    best = int(retrieve(query[2], bank).argmax())
    template, template_mask, A_template, depth_mm, K_template, T_template = view(best)
    query_map, template_map = co_project(query, template, query_mask, template_mask, dims=dims, reading=reading)
    masks = [cell_mask(mask, query_map.shape[-1]) for mask in (query_mask, template_mask)]
    clusters = cluster(query_map, template_map, *masks, reading=reading)
    query_px, template_px = correspond(
        query_map, template_map, masks[1], *clusters, crop_size=len(query_mask), reading=reading
    )
    points_obj = np.array([object_point(px, A_template, depth_mm, K_template, T_template) for px in template_px])
    seen = np.isfinite(points_obj).all(axis=1)
    A_img_crop = np.linalg.inv(A_crop_img)
    px_img = np.array([(A_img_crop @ [*px, 1.0])[:2] for px in query_px])
    return best, solve(points_obj[seen], px_img[seen], K, reading=reading)
