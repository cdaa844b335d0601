"""Rigid transforms T (4 4): frames cancel from right to left, ``p_cam = T_cam_obj @ p_obj``. Lengths are mm."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def rigid(R: Float[np.ndarray, "*n 3 3"], t: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 4 4"]:
    """T (4 4) from rotations and translations (mm)."""
    T = np.zeros((*R.shape[:-2], 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = R, t, 1.0
    return T


def inverse(T: Float[np.ndarray, "*n 4 4"]) -> Float[np.ndarray, "*n 4 4"]:
    """T_b_a from T_a_b; assumes orthonormal rotations."""
    R = np.swapaxes(T[..., :3, :3], -1, -2)
    return rigid(R, -(R @ T[..., :3, 3:])[..., 0])


def transform(T: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "*m 3"]) -> Float[np.ndarray, "*m 3"]:
    """Points (m 3, mm) mapped by T, from its right-hand frame to its left-hand frame."""
    return points @ T[:3, :3].T + T[:3, 3]


def nearest_rotation(R: Float[np.ndarray, "*n 3 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """The rotation (determinant +1) closest to R in the Frobenius norm, by SVD (Kabsch)."""
    U, _, Vt = np.linalg.svd(R)
    sign = np.linalg.det(U @ Vt)
    U = U.copy()
    U[..., :, -1] *= sign[..., None]
    return U @ Vt


def rotation_angle_deg(R_a: Float[np.ndarray, "*n 3 3"], R_b: Float[np.ndarray, "*n 3 3"]) -> Float[np.ndarray, "*n"]:
    """Geodesic angle between rotations, degrees. By atan2, which is accurate near 0 and 180."""
    D = np.swapaxes(R_a, -1, -2) @ R_b
    cos = (np.trace(D, axis1=-2, axis2=-1) - 1) / 2
    axis = np.stack([D[..., 2, 1] - D[..., 1, 2], D[..., 0, 2] - D[..., 2, 0], D[..., 1, 0] - D[..., 0, 1]], -1)
    return np.asarray(np.degrees(np.arctan2(np.linalg.norm(axis, axis=-1) / 2, cos)))


def look_at(eye: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 4 4"]:
    """T_cam_obj of cameras at ``eye`` (object frame, mm) that look at the object's origin.

    OpenCV camera: x right, y down, z forward. The object's z axis points up in the image; for a camera straight above
    or below, its y axis does.
    """
    z = -eye / np.linalg.norm(eye, axis=-1, keepdims=True)
    up = np.where(np.abs(z[..., 2:]) > 1 - 1e-9, np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    x = np.cross(z, up)
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    R = np.stack([x, np.cross(z, x), z], axis=-2)
    return rigid(R, -(R @ eye[..., None])[..., 0])


def rotation_between(a: Float[np.ndarray, " 3"], b: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """The smallest rotation R with R a parallel to b, by Rodrigues' formula; undefined for opposite directions."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    v = np.cross(a, b)
    V = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    return np.eye(3) + V + V @ V / (1.0 + a @ b)
