"""The pixel frames that a solver's threshold is measured in, and in which its pose is refitted."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from pipeline.functional import camera, rigid
from pipeline.functional.crop_pose import pose_in_image
from pipeline.items.online import Query
from pipeline.stages.solve import Plane, Solver

LARGEST_CROP_PX = 160  # side, in image pixels, of the largest crop whose solver threshold is in image pixels


def solver_plane(
    plane: Plane, query: Query, crop_size: int
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3 3"], Float[np.ndarray, "3 3"]]:
    """A_plane_img, K_plane and R_plane_cam of a solver's plane, the pixel frame that its threshold is measured in.

    ``image``: pixels of the photograph; ``crop``: pixels of the query's crop. Large crops are scaled to at most 160 px
    a side, so that the pixel threshold is not finer than the features.
    """
    if plane == "crop":
        return query.A_crop_img, *camera.crop_camera(query.A_crop_img, query.K)
    centre = camera.apply_homography(np.linalg.inv(query.A_crop_img), np.full((1, 2), (crop_size - 1) / 2))
    side_px = crop_size / float(camera.local_zoom(query.A_crop_img, centre)[0])
    A_plane_img = camera.resize_affine(min(1.0, LARGEST_CROP_PX / side_px))
    return A_plane_img, A_plane_img @ query.K, np.eye(3)


def refit_in_crop(
    solver: Solver,
    query: Query,
    points_obj: Float[np.ndarray, "m 3"],
    px_img: Float[np.ndarray, "m 2"],
    T_cam_obj: Float[np.ndarray, "4 4"],
) -> Float[np.ndarray, "4 4"]:
    """T_cam_obj (mm) refitted to object points and pixels of the photograph, in the crop's camera (Solver.refit)."""
    K_crop, R_crop_cam = camera.crop_camera(query.A_crop_img, query.K)
    px_crop = camera.apply_homography(query.A_crop_img, px_img)
    T_crop_obj = rigid.rigid(R_crop_cam, np.zeros(3)) @ T_cam_obj
    return pose_in_image(solver.refit(points_obj, px_crop, K_crop, T_crop_obj), R_crop_cam)
