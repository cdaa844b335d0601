"""Writes tests/data/store.tar.xz: a small dataset, and the store and results of two methods on it.

    python tests/make_store.py

tests/test_stored_results.py checks that later code finds all of it again. The archive was written by commit 73d0e55;
make a new one only when a raised ``version`` makes some of its entries obsolete.
"""

import shutil
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

import numpy as np
import trimesh

from pipeline.items.objects import Mesh
from pipeline.synthetic import scenes

ARCHIVE = Path(__file__).parent / "data" / "store.tar.xz"
SAFELY: dict[str, str] = {"filter": "data"} if hasattr(tarfile, "data_filter") else {}
"""Arguments of extractall; Python 3.11.3 and earlier have no filter."""
SMALL = (
    *("dataset=bop", "dataset.name=small", "dataset.root=scene", "store.root=cache", "crop.size=64", "match.top_k=2"),
    *("render=raycast", "render.size=64", "render.viewpoints=superfibonacci", "render.count=4"),
    *("overlays=false", "gallery=0", "runtime.device=cpu", "runtime.progress=false"),
)
METHODS = {
    "embedded": ("method=dzop_x", "extract.input_size=32"),
    "foundpose": (
        *("method=foundpose", "extract=hog", "extract.context_cells=0", "match.layer=8", "fuse.layers=[8]"),
        *("fuse.dim=6", "render.inplane=1", "match.count=30", "match.dim=4"),
        *("crop.erode_template=0", "crop.open_query=0"),  # as the archive was written
    ),
}


def write_scene(root: Path) -> None:
    """One image of 128 x 96 pixels that shows one object: a coarse mesh, since the mesh fills most of the archive."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    rng = np.random.default_rng(0)
    vertices = ball.vertices * (1 + 0.3 * np.sin(3 * ball.vertices[:, [1, 2, 0]])) * [30.0, 45.0, 60.0]
    colours = (128 + 127 * np.sin(ball.vertices @ rng.normal(size=(3, 3)) * 4)).astype(np.uint8)
    scenes.make_object = lambda seed: Mesh(vertices.round(2), np.asarray(ball.faces), colours)
    scenes.write_dataset(root, objects=1, images=1, per_image=1, size_hw=(96, 128), occluded=0, seed=5, progress=False)
    shutil.rmtree(root / "models_eval")


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_scene(folder / "scene")
        for out, method in METHODS.items():
            command = [sys.executable, "-m", "pipeline", *SMALL, *method, f"out=results/{out}"]
            subprocess.run(command, cwd=folder, check=True)
        ARCHIVE.parent.mkdir(exist_ok=True)
        with tarfile.open(ARCHIVE, "w:xz") as archive:
            for part in ("scene", "cache", "results"):
                archive.add(folder / part, arcname=part)


if __name__ == "__main__":
    main()
