"""Estimate the pose of one object in one photograph, and write it to a folder with a page to look at."""

import argparse

import numpy as np
import PIL.Image

from pipeline import PoseEstimator, save_results


def main() -> None:
    """Read the files, estimate the pose, write pose.json, overlay.jpg and pose.html."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("mesh", help="the mesh in millimetres")
    parser.add_argument("image", help="the photograph")
    parser.add_argument("mask", help="an image that is black outside the object")
    parser.add_argument("K", help="fx,fy,cx,cy in pixels of the photograph")
    parser.add_argument("--out", default="results/example", help="folder to write to")
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE", help="settings as on the command line")
    given = parser.parse_args()
    rgb = np.asarray(PIL.Image.open(given.image).convert("RGB"))
    mask = np.asarray(PIL.Image.open(given.mask))
    K = [float(number) for number in given.K.split(",")]
    with PoseEstimator.from_mesh(given.mesh, settings=given.set) as estimator:
        result = estimator(rgb, K, mask=mask)
    print(result.summary())
    for warning in result.warnings:
        print("warning:", warning)
    for path in save_results([result], given.out, image=given.image):
        print("written", path)


if __name__ == "__main__":
    main()
