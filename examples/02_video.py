"""Estimate the pose of one object in every frame of a video: each starts from the pose in the frame before."""

import argparse
import csv
import sys
from pathlib import Path

import cv2
import numpy as np
import PIL.Image

from pipeline import PoseEstimator
from pipeline.bop.camera_files import read_camera


def main() -> None:
    """Print one line of CSV per frame: its name, the translation in mm, the quaternion and the score."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("mesh", help="the mesh in millimetres")
    parser.add_argument("frames", type=Path, help="folder of PNG images")
    parser.add_argument("masks", type=Path, help="folder of masks, named like the images")
    parser.add_argument("camera", type=Path, help="camera file of ROS or OpenCV; frames and masks are undistorted")
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE", help="settings as on the command line")
    given = parser.parse_args()
    camera = read_camera(given.camera)
    distortion = np.array(camera.distortion or (0.0, 0, 0, 0))
    rows = csv.writer(sys.stdout)
    rows.writerow(["frame", "x_mm", "y_mm", "z_mm", "qx", "qy", "qz", "qw", "score"])
    with PoseEstimator.from_mesh(given.mesh, settings=given.set) as estimator:
        result = None
        for path in sorted(given.frames.glob("*.png")):
            rgb = np.asarray(PIL.Image.open(path).convert("RGB"))
            mask = np.asarray(PIL.Image.open(given.masks / path.name))
            rgb, mask = (cv2.undistort(image, camera.K, distortion) for image in (rgb, mask))
            result = estimator(rgb, camera.K, mask=mask, prior=result)
            if result.T_cam_obj is None or result.quaternion_xyzw is None:
                print(f"{path.name}: {result.reason}", file=sys.stderr)
                continue
            numbers = [*result.T_cam_obj[:3, 3], *result.quaternion_xyzw, result.score]
            rows.writerow([path.name, *(f"{number:.5g}" for number in numbers)])


if __name__ == "__main__":
    main()
