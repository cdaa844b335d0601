"""estimated and true pose -> errors. ``T_est``, ``T_gt``: T_cam_obj, mm; ``vertices``: in the object frame, mm."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull, QhullError, cKDTree

from pipeline.functional.camera import project
from pipeline.functional.rigid import rotation_angle_deg, transform

Pose = Float[np.ndarray, "4 4"]
Vertices = Float[np.ndarray, "v 3"]
_BLOCK_FLOATS = 1 << 22  # coordinates computed at a time for all symmetries, 32 MiB
_MAX_MERGED = 5_000  # vertices above which Qhull joggles instead of merging facets


def rotation_error_deg(T_est: Pose, T_gt: Pose) -> float:
    """Geodesic angle between the rotations, degrees, without symmetries.

    Equals bop_toolkit's ``re`` for exact rotations. It uses atan2: for LM-O's rotations, orthonormal only to 1e-2, the
    arc cosine would give spurious degrees near zero.
    """
    return float(rotation_angle_deg(T_est[None, :3, :3], T_gt[None, :3, :3])[0])


def translation_error_mm(T_est: Pose, T_gt: Pose) -> float:
    """Distance between the translations, mm; bop_toolkit's ``te``."""
    return float(np.linalg.norm(T_est[:3, 3] - T_gt[:3, 3]))


def add(T_est: Pose, T_gt: Pose, vertices: Vertices) -> float:
    """ADD: mean distance between corresponding vertices, mm (Hinterstoisser et al., ACCV 2012)."""
    return float(np.linalg.norm(transform(T_est, vertices) - transform(T_gt, vertices), axis=1).mean())


def adi(T_est: Pose, T_gt: Pose, vertices: Vertices) -> float:
    """ADI: mean distance from each true vertex to the nearest estimated one, mm (Hinterstoisser et al., ACCV 2012)."""
    distances, _ = cKDTree(transform(T_est, vertices)).query(transform(T_gt, vertices))
    return float(distances.mean())


def mssd(T_est: Pose, T_gt: Pose, vertices: Vertices, symmetries: Float[np.ndarray, "s 4 4"]) -> float:
    """Maximum symmetry-aware surface distance, mm: the minimum over symmetries of the largest vertex distance.

    Drost et al., ICCVW 2017; Hodan et al., ECCVW 2020, section 2.2. The distance between two poses of a point is convex
    in the point, so the vertices of the convex hull (``hull_vertices``) give the same value as all vertices.
    """
    return float(_largest_distances(T_est, T_gt, vertices, symmetries).min())


def mspd(
    T_est: Pose,
    T_gt: Pose,
    K: Float[np.ndarray, "3 3"],
    vertices: Vertices,
    symmetries: Float[np.ndarray, "s 4 4"],
    probes: Float[np.ndarray, "p 3"] | None = None,
) -> float:
    """Maximum symmetry-aware projection distance, pixels of the image of K (Hodan et al., ECCVW 2020, section 2.2).

    ``probes``: a subset of the vertices, for speed. Their largest distance is a lower bound for each symmetry, so most
    symmetries need not be measured on all vertices; the result is the same.
    """
    est_px = project(K, transform(T_est, vertices))
    if probes is None or len(symmetries) == 1:
        return float(_largest_shifts(K, est_px, T_gt, vertices, symmetries).min())
    bound = _largest_shifts(K, project(K, transform(T_est, probes)), T_gt, probes, symmetries)
    best = np.inf
    for index in np.argsort(bound):
        if bound[index] >= best:
            break
        best = min(best, float(_largest_shifts(K, est_px, T_gt, vertices, symmetries[index : index + 1])[0]))
    return best


def hull_vertices(vertices: Vertices) -> Float[np.ndarray, "h 3"]:
    """Vertices of the convex hull, to rounding; all vertices for a flat object.

    Larger meshes are joggled (Qhull's QJ), which moves vertices by rounding errors: Qhull would otherwise merge facets
    that lie in one plane, such as the triangles of a cylinder's cap, in quadratic time.
    """
    options = "QJ" if len(vertices) > _MAX_MERGED else None
    try:
        return vertices[ConvexHull(vertices, qhull_options=options).vertices]
    except QhullError:
        return vertices


def _largest_distances(
    T_est: Pose, T_gt: Pose, vertices: Vertices, symmetries: Float[np.ndarray, "s 4 4"]
) -> Float[np.ndarray, " s"]:
    """Largest vertex distance for each symmetry, mm."""
    est = transform(T_est, vertices)
    blocks = _split_symmetries(symmetries, len(vertices))
    placed = (_transform_all(T_gt @ block, vertices) for block in blocks)
    return _concatenate([np.linalg.norm(gt - est, axis=-1).max(axis=-1) for gt in placed])


def _largest_shifts(
    K: Float[np.ndarray, "3 3"],
    est_px: Float[np.ndarray, "v 2"],
    T_gt: Pose,
    vertices: Vertices,
    symmetries: Float[np.ndarray, "s 4 4"],
) -> Float[np.ndarray, " s"]:
    """Largest distance between projected vertices for each symmetry, pixels."""
    blocks = _split_symmetries(symmetries, len(vertices))
    placed = (project(K, _transform_all(T_gt @ block, vertices)) for block in blocks)
    return _concatenate([np.linalg.norm(px - est_px, axis=-1).max(axis=-1) for px in placed])


def _concatenate(blocks: list[Float[np.ndarray, " _b"]]) -> Float[np.ndarray, " s"]:
    """The blocks as one array; NaN (a vertex in the camera's plane, which has no projection) becomes infinity."""
    return np.nan_to_num(np.concatenate(blocks), nan=np.inf, posinf=np.inf)


def _transform_all(T: Float[np.ndarray, "s 4 4"], vertices: Vertices) -> Float[np.ndarray, "s v 3"]:
    return vertices @ np.swapaxes(T[:, :3, :3], 1, 2) + T[:, None, :3, 3]


def _split_symmetries(symmetries: Float[np.ndarray, "s 4 4"], vertex_count: int) -> list[Float[np.ndarray, "_b 4 4"]]:
    rows = max(1, _BLOCK_FLOATS // (3 * vertex_count))
    return [symmetries[i : i + rows] for i in range(0, len(symmetries), rows)]
