"""matched template, true pose -> angle between their views, in three interpretations of the paper's Acc15."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from pipeline.functional.rigid import rotation_angle_deg
from pipeline.items.errors import TemplateError

ACC_DEG = 15.0


def template_error(
    T_template: Float[np.ndarray, "4 4"], T_gt: Float[np.ndarray, "4 4"], symmetries: Float[np.ndarray, "s 4 4"]
) -> TemplateError:
    """Angles between a template's view and the true view, degrees, each minimised over the symmetries.

    Both poses are T_cam_obj. ``geodesic`` and ``vectorised`` compare the rotations; ``direction`` compares the
    directions from the object's origin to the camera, which ignore in-plane rotation. For a geodesic angle theta the
    vectorised angle is acos((1 + 2 cos theta) / 3): 15 degrees correspond to 18.4 degrees geodesic.
    """
    true = T_gt @ symmetries
    R_template = np.broadcast_to(T_template[:3, :3], (len(true), 3, 3))
    geodesic = rotation_angle_deg(R_template, true[:, :3, :3])
    cosine = np.clip((1 + 2 * np.cos(np.deg2rad(geodesic))) / 3, -1, 1)
    a, b = camera_direction(T_template[None]), camera_direction(true)
    direction = np.rad2deg(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(-1)))
    return TemplateError(float(geodesic.min()), float(direction.min()), float(np.rad2deg(np.arccos(cosine)).min()))


def camera_direction(T_cam_obj: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n 3"]:
    """Unit vectors from the object's origin to the camera, in the object frame."""
    towards = -np.einsum("nij,ni->nj", T_cam_obj[:, :3, :3], T_cam_obj[:, :3, 3])
    return towards / np.linalg.norm(towards, axis=-1, keepdims=True)
