"""Conversion of poses between an image's camera and the virtual cameras of crops."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from pipeline.functional import camera, rigid

Matrix = Float[np.ndarray, "3 3"]
Pose = Float[np.ndarray, "4 4"]


def pose_in_image(T_crop_obj: Pose, R_crop_cam: Matrix) -> Pose:
    """T_cam_obj (mm) from a pose in a crop's camera, which is the image's camera rotated by ``R_crop_cam``."""
    return rigid.rigid(R_crop_cam.T, np.zeros(3)) @ T_crop_obj


def transfer_template_pose(
    A_query: Matrix, K_query: Matrix, A_template: Matrix, K_template: Matrix, T_template_obj: Pose
) -> Pose:
    """T_cam_obj (mm) of a query for which the object looks in its crop as in the template's crop.

    ``A_*`` and ``K_*``: A_crop_img and the image's K; ``T_template_obj``: pose in the template's camera. Computed
    between the cameras of both crops (camera.crop_camera): the object's origin projects to the same crop pixel, depth
    scales with the focal length, and the rotation follows the viewing ray.
    """
    K_crop, R_crop_cam = camera.crop_camera(A_query, K_query)
    K_template_crop, R_template_cam = camera.crop_camera(A_template, K_template)
    T_crop_obj = rigid.rigid(R_template_cam, np.zeros(3)) @ T_template_obj
    t = T_crop_obj[:3, 3]
    origin_crop = camera.project(K_template_crop, t)
    depth = t[2] * K_crop[0, 0] / K_template_crop[0, 0]
    position = camera.unproject(K_crop, origin_crop[None], np.array([depth]))[0]
    turn = rigid.rotation_between(t, position)
    return pose_in_image(rigid.rigid(turn @ T_crop_obj[:3, :3], position), R_crop_cam)
