"""Estimate the poses of several objects in one photograph, in one call."""

import argparse

import numpy as np
import PIL.Image

from pipeline import PoseEstimator, save_results


def main() -> None:
    """Read NAME=MESH:MASK for every object, estimate all poses, write their files."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("image", help="the photograph")
    parser.add_argument("K", help="fx,fy,cx,cy in pixels of the photograph")
    parser.add_argument("objects", nargs="+", metavar="NAME=MESH:MASK", help="an object's name, mesh and mask")
    parser.add_argument("--out", default="results/example", help="folder to write to")
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE", help="settings as on the command line")
    given = parser.parse_args()
    named = dict(text.split("=", 1) for text in given.objects)
    meshes = {name: files.split(":")[0] for name, files in named.items()}
    masks = {name: np.asarray(PIL.Image.open(files.split(":")[1])) for name, files in named.items()}
    rgb = np.asarray(PIL.Image.open(given.image).convert("RGB"))
    K = [float(number) for number in given.K.split(",")]
    with PoseEstimator.from_mesh(meshes, settings=given.set) as estimator:
        results = estimator.find(rgb, K, masks)
    for result in results:
        print(result.summary())
    save_results(results, given.out, image=given.image)


if __name__ == "__main__":
    main()
