"""A procedural video: an object turns and moves through 30 frames, one of which is mostly occluded.

Compares poses of an estimator with and without the pose of the frame before as its prior, and with wrong priors.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from benchmarks.measure import Measurement
from pipeline import PoseEstimator, PoseResult
from pipeline.functional.rigid import rigid
from pipeline.io.meshes import write_ply
from pipeline.items.objects import Mesh
from pipeline.metrics.pose_error import hull_vertices, mssd
from pipeline.stages.render.raycast import Raycast
from pipeline.synthetic.objects import make_object

SIZE_HW, OBJECT, FRAMES = (480, 640), 3, 30
OCCLUDED = 15  # the frame of which 15 % of the object's width are visible
NOISE = 4.0  # standard deviation, grey levels
WRONG = 0.2  # of the diameter: a pose with a larger MSSD is wrong
K = np.array([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]])
_TURNS = (np.diag([1.0, -1, -1, 1]), np.diag([-1.0, 1, -1, 1]), np.diag([-1.0, -1, 1, 1]))


@dataclass(frozen=True, eq=False)
class VideoFrame:
    """An image of the video with the object's mask and its true pose (mm)."""

    rgb: UInt8[np.ndarray, "H W 3"]
    mask: Bool[np.ndarray, "H W"]
    T_cam_obj: Float[np.ndarray, "4 4"]


def make_video(mesh: Mesh, *, count: int = FRAMES) -> Iterator[VideoFrame]:
    """The frames: 80 degrees of rotation, 160 mm across and 60 mm along the optical axis, with noise."""
    rng = np.random.default_rng(0)
    background = cv2.GaussianBlur(rng.integers(0, 255, (*SIZE_HW, 3), np.uint8), (0, 0), 6)
    for n in range(count):
        a = n / (FRAMES - 1)
        R = cv2.Rodrigues(np.array([0.5 + 0.9 * a, 0.7 - 0.5 * a, 2.5 + 1.2 * a]))[0]
        T_cam_obj = rigid(R, np.array([160 * a - 80, 20 * np.sin(3 * a), 700 + 60 * np.sin(2 * a)]))
        drawn, depth_mm = Raycast().render(mesh, K, T_cam_obj[None], SIZE_HW)
        mask = depth_mm[0] > 0
        if n == OCCLUDED:
            columns = np.flatnonzero(mask.any(axis=0))
            mask[:, columns[int(0.15 * len(columns))] :] = False
        clean = np.where(mask[..., None], drawn[0], background)
        rgb = np.clip(clean + rng.normal(0, NOISE, clean.shape), 0, 255).astype(np.uint8)
        yield VideoFrame(rgb, mask, T_cam_obj)


def video(*, device: str, repeats: int) -> list[Measurement]:
    """Seconds of a frame, jitter of z and largest error, without and with priors; poses that wrong priors spoil."""
    mesh = make_object(OBJECT)
    hull, diameter = hull_vertices(mesh.vertices), float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    frames = list(make_video(mesh))
    with tempfile.TemporaryDirectory() as name:
        write_ply(Path(name) / "object.ply", mesh)
        settings = [f"runtime.device={device}", "runtime.progress=false"]
        with PoseEstimator.from_mesh(Path(name) / "object.ply", settings=settings, cache=name) as estimator:
            alone = _follow(frames, lambda frame, before: estimator(frame.rgb, K, mask=frame.mask))
            along = _follow(frames, lambda frame, before: estimator(frame.rgb, K, mask=frame.mask, prior=before))
            turned = [frame.T_cam_obj @ _TURNS[n % 3] for n, frame in enumerate(frames)]
            misled = [estimator(f.rgb, K, mask=f.mask, prior=T) for f, T in zip(frames, turned, strict=True)]
    rows = []
    for label, (results, seconds) in {"alone": alone, "from the frame before": along}.items():
        errors = _errors(results, frames, hull, diameter)
        off_mm = [r.T_cam_obj[2, 3] - f.T_cam_obj[2, 3] for r, f in _clear(results, frames) if r.T_cam_obj is not None]
        rows += [
            Measurement(f"a frame, {label}", seconds, "s of one core"),
            Measurement(f"jitter of z, {label}", float(np.std(np.diff(off_mm))), "mm"),
            Measurement(f"largest error of a frame that is not occluded, {label}", max(errors), "of the diameter"),
        ]
    spoiled = sum(error >= WRONG for error in _errors(misled, frames, hull, diameter))
    return [*rows, Measurement("wrong poses after priors turned by 180 degrees", float(spoiled), f"of {FRAMES - 1}")]


def _follow(
    frames: list[VideoFrame], estimate: Callable[[VideoFrame, PoseResult | None], PoseResult]
) -> tuple[list[PoseResult], float]:
    """The results of all frames, and CPU seconds of a frame."""
    results, start = list[PoseResult](), time.process_time()
    for frame in frames:
        results.append(estimate(frame, results[-1] if results else None))
    return results, (time.process_time() - start) / len(frames)


def _clear(results: list[PoseResult], frames: list[VideoFrame]) -> Iterator[tuple[PoseResult, VideoFrame]]:
    """Results and frames without the occluded one."""
    return (pair for n, pair in enumerate(zip(results, frames, strict=True)) if n != OCCLUDED)


def _errors(
    results: list[PoseResult], frames: list[VideoFrame], hull: Float[np.ndarray, "p 3"], diameter: float
) -> list[float]:
    """MSSD over the diameter of every frame that is not occluded; infinite without a pose."""
    identity = np.eye(4)[None]
    return [
        np.inf if r.T_cam_obj is None else mssd(r.T_cam_obj, f.T_cam_obj, hull, identity) / diameter
        for r, f in _clear(results, frames)
    ]
