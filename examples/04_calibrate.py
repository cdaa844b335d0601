"""Measure K and the lens's distortion from photographs of a chessboard, and write them as a camera file."""

import argparse
import json
import sys
from pathlib import Path

import cv2
import numpy as np

FEWEST, GOOD_PX = 3, 1.0


def main() -> None:
    """Find the corners in every photograph, calibrate, write camera.json for ``dataset.K``."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("photographs", nargs="+", type=Path, help="of the board from many sides, ten or more")
    parser.add_argument("--corners", default="9x6", help="inner corners, columns x rows (default: 9x6)")
    parser.add_argument("--out", type=Path, default=Path("camera.json"), help="file to write")
    given = parser.parse_args()
    columns, rows = map(int, given.corners.split("x"))
    board = np.zeros((rows * columns, 3), np.float32)  # K does not depend on the size of the squares
    board[:, :2] = np.mgrid[:columns, :rows].T.reshape(-1, 2)
    found, size = [], None
    for path in given.photographs:
        grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if grey is None or (size is not None and grey.shape[::-1] != size):
            sys.exit(f"{path}: needs an image of the same size as the others")
        size = grey.shape[::-1]
        is_found, corners = cv2.findChessboardCornersSB(grey, (columns, rows))
        print(f"{path.name}: {'corners found' if is_found else 'no board of ' + given.corners + ' inner corners'}")
        if is_found:
            found.append(corners)
    if len(found) < FEWEST:
        sys.exit(f"found the board in {len(found)} photographs, needs {FEWEST}, better ten")
    error_px, K, distortion, *_ = cv2.calibrateCamera([board] * len(found), found, size, None, None)
    camera = {"image_width": size[0], "image_height": size[1], "camera_matrix": K.ravel().tolist()}
    camera |= {"distortion_model": "plumb_bob", "distortion_coefficients": distortion.ravel().tolist()}
    given.out.write_text(json.dumps(camera, indent=1))
    quality = "good" if error_px < GOOD_PX else "poor: use sharp photographs of a flat board"
    print(f"error {error_px:.2f} px ({quality}); written {given.out}: dataset.K={given.out}")


if __name__ == "__main__":
    main()
