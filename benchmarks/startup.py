"""What a user of one photograph waits for: imports, --help, one command with cached templates, one call of the API."""

from __future__ import annotations

import os
import resource
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np
import PIL.Image

from benchmarks.measure import Measurement, time_interleaved
from pipeline import PoseEstimator
from pipeline.functional.rigid import rigid
from pipeline.io.meshes import write_ply
from pipeline.stages.render.raycast import Raycast
from pipeline.synthetic.objects import make_object

SIZE_HW, MUG = (480, 640), 3
K = np.array([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]])


def startup(*, device: str, repeats: int) -> list[Measurement]:
    """CPU seconds of new processes, and of a call of an estimator that is warm."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rgb, mask = write_photograph(folder)
        settings = [f"runtime.device={device}", "runtime.progress=false"]
        with PoseEstimator.from_mesh(folder / "mug.ply", settings=settings, cache=folder / "cache") as estimator:
            call = time_interleaved({"call": lambda: estimator(rgb, K, mask=mask)}, repeats=repeats)["call"]
        command = ["-m", "pipeline", "dataset=photo", "dataset.mesh=mug.ply", "dataset.image=shot.png", *settings]
        command += ["dataset.K=[600,600,320,240]"]
        boxes = [[*command, f"dataset.bbox=[{x},150,170,200]"] for x in range(300, 300 + repeats)]  # no pose is cached
        photograph = statistics.median(_run(box, folder) for box in boxes)
        imported = statistics.median(_run(["-c", "import pipeline"], folder) for _ in range(repeats))
        helped = statistics.median(_run(["-m", "pipeline", "--help"], folder) for _ in range(repeats))
        loaded = statistics.median(_run(["-c", "from pipeline import PoseEstimator"], folder) for _ in range(repeats))
    unit = "s of one core"
    return [
        Measurement("import pipeline, and Python itself", imported, unit, "", 0.3),
        Measurement("dzop --help", helped, unit, "", 1.0),
        Measurement("from pipeline import PoseEstimator", loaded, unit),
        Measurement("dzop dataset=photo, templates cached", photograph, unit, "", 4.0),
        Measurement("estimator(rgb, K, mask=mask), warm", call.cpu_s, unit),
    ]


def write_photograph(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """mug.ply and a procedural photograph of it, shot.png; returns its pixels and the mask."""
    mesh = make_object(MUG)
    T_cam_obj = rigid(cv2.Rodrigues(np.array([0.5, 0.7, 2.5]))[0], np.array([60.0, 20, 700]))
    rgb, depth_mm = Raycast().render(mesh, K, T_cam_obj[None], SIZE_HW)
    noise = np.random.default_rng(0).integers(0, 255, (*SIZE_HW, 3), np.uint8)
    mask = depth_mm[0] > 0
    photo = np.where(mask[..., None], rgb[0], cv2.GaussianBlur(noise, (0, 0), 6))
    write_ply(folder / "mug.ply", mesh)
    PIL.Image.fromarray(photo).save(folder / "shot.png")
    return photo, mask


def _run(arguments: list[str], folder: Path) -> float:
    """CPU seconds of a Python process with one thread."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    paths = os.pathsep.join([str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": paths}
    subprocess.run([sys.executable, *arguments], cwd=folder, env=environment, check=True, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
