"""Photograph, poses -> the photograph with silhouette outlines, 3D boxes and labels."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import PIL.Image
from jaxtyping import Bool, Float, UInt8

from pipeline.functional.camera import project, resize_affine
from pipeline.functional.rigid import transform
from pipeline.io.files import write_atomic
from pipeline.items.objects import Mesh
from pipeline.items.views import Image
from pipeline.report.overlay_labels import INK, ROLE_COLOURS, Colour, Role, write_labels
from pipeline.stages.render.raycast import render_depth

Line = Float[np.ndarray, "_m 2"]
_NEAR_MM = 10.0  # edges are clipped where they come closer to the camera plane
_FAR_PX = 1e6  # fixed-point drawing coordinates overflow beyond this
_SUBPIXEL_BITS = 4
AXIS_COLOURS: tuple[Colour, ...] = ((235, 60, 60), (70, 200, 80), (70, 120, 255))
_EDGES = [(a, b) for a in range(8) for b in range(a + 1, 8) if (a ^ b) in (1, 2, 4)]  # corners differ in one axis


@dataclass(frozen=True, eq=False)
class DrawnPose:
    """One pose to draw. ``role`` "unchecked": an estimate without ground truth to compare with.

    ``axes``: also draw the axes of the object frame from its origin, x red, y green, z blue.
    """

    mesh: Mesh
    T_cam_obj: Float[np.ndarray, "4 4"]
    role: Role
    label: str = ""
    axes: bool = False


def draw_overlay(
    image: Image, items: Sequence[DrawnPose], *, legend: bool = True, note: str = ""
) -> UInt8[np.ndarray, "H W 3"]:
    """The photograph with the silhouette outline, 3D box and label of every pose, estimates above ground truth.

    Images smaller than 1000 px are enlarged by an integer factor of at most 4. The box is the mesh's bounding box,
    aligned with the axes of the object frame. Parts behind the camera are left out. ``note``: what was done to the
    photograph, at the lower right.
    """
    factor = _enlargement_factor(image.rgb)
    h, w = (side * factor for side in image.rgb.shape[:2])
    K = resize_affine(float(factor)) @ image.K
    # cv2.resize maps pixel edges to pixel edges, as resize_affine does
    canvas = cv2.resize(image.rgb, (w, h), interpolation=cv2.INTER_CUBIC) if factor > 1 else image.rgb.copy()
    ordered = sorted(items, key=lambda item: item.role != "truth")  # estimates on top
    width = max(2, round(max(h, w) / 640))
    boxes = canvas.copy()
    for item in ordered:
        _draw_lines(boxes, _box_segments(item, K), ROLE_COLOURS[item.role], width)
    canvas = cv2.addWeighted(boxes, 0.6, canvas, 0.4, 0)
    for item in ordered:
        thickness = width + 1 if item.role == "truth" else width
        _draw_lines(canvas, _outlines(item, K, (h, w)), ROLE_COLOURS[item.role], thickness)
    for item in ordered:
        for colour, segment in _axes(item, K):
            _draw_lines(canvas, [segment], colour, width + 1)
    roles = [role for role in ROLE_COLOURS if any(item.role == role for item in ordered)]
    return write_labels(canvas, _labels(ordered, K), roles if legend else [], note)


def write_overlay(
    path: Path, picture: UInt8[np.ndarray, "H W 3"], *, quality: int = 90, made_from: str | None = None
) -> None:
    """Write a picture atomically, in the format of its suffix (.jpg, .png).

    ``made_from``: digest of everything that the picture shows, kept in the comment of a JPEG; see ``shows``.
    """
    stream, options = io.BytesIO(), {} if made_from is None else {"comment": made_from}
    file_format = PIL.Image.registered_extensions()[path.suffix]
    PIL.Image.fromarray(picture).save(stream, file_format, quality=quality, **options)
    write_atomic(path, stream.getvalue())


def shows(path: Path, made_from: str) -> bool:
    """Whether the file is a picture that was written with this ``made_from``."""
    try:
        with PIL.Image.open(path, formats=["JPEG"]) as picture:
            return picture.info.get("comment") == made_from.encode()
    except (OSError, SyntaxError, ValueError):
        return False


def clip_to_front(segments_cam: Float[np.ndarray, "e 2 3"], *, near_mm: float = _NEAR_MM) -> Float[np.ndarray, "k 2 3"]:
    """The parts of segments (camera frame, mm) at z >= near_mm; segments entirely behind it are dropped."""
    segments = segments_cam[segments_cam[:, :, 2].max(axis=1) >= near_mm]
    start, end = segments[:, :1], segments[:, 1:]
    z = segments[..., 2:]
    step = np.where(end[..., 2:] == start[..., 2:], 1.0, end[..., 2:] - start[..., 2:])
    cut = start + (near_mm - start[..., 2:]) / step * (end - start)
    return np.where(z < near_mm, cut, segments)


def _enlargement_factor(rgb: UInt8[np.ndarray, "H W 3"]) -> int:
    return int(np.clip(np.ceil(1000 / max(rgb.shape[:2])), 1, 4))


def _corners(mesh: Mesh) -> Float[np.ndarray, "8 3"]:
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    bits = np.array([[(i >> axis) & 1 for axis in range(3)] for i in range(8)])
    return np.where(bits == 1, high, low)


def _box_segments(item: DrawnPose, K: Float[np.ndarray, "3 3"]) -> list[Float[np.ndarray, "2 2"]]:
    corners = transform(item.T_cam_obj, _corners(item.mesh))
    return list(project(K, clip_to_front(corners[np.array(_EDGES)])))


def _axes(item: DrawnPose, K: Float[np.ndarray, "3 3"]) -> list[tuple[Colour, Line]]:
    """Colour and segment of each axis of the object frame, as long as 0.6 times the mesh's bounding box is wide."""
    if not item.axes:
        return []
    length_mm = 0.6 * float(np.ptp(item.mesh.vertices, axis=0).max())
    lines = []
    for colour, end in zip(AXIS_COLOURS, length_mm * np.eye(3), strict=True):
        segment = clip_to_front(transform(item.T_cam_obj, np.stack([np.zeros(3), end]))[None])
        lines += [(colour, project(K, part)) for part in segment]
    return lines


def _labels(items: Sequence[DrawnPose], K: Float[np.ndarray, "3 3"]) -> list[tuple[str, tuple[float, float], Role]]:
    """Text, top left corner of the box (px) and role of each pose that has a label and is in front of the camera."""
    labels = []
    for item in items:
        if item.label and (segments := _box_segments(item, K)):
            x, y = np.min(np.concatenate(segments), axis=0)
            labels.append((item.label, (float(x), float(y)), item.role))
    return labels


def _outlines(item: DrawnPose, K: Float[np.ndarray, "3 3"], size_hw: tuple[int, int]) -> list[Line]:
    """Closed outlines (and holes) of the silhouette, pixels, smoothed over five contour points."""
    if transform(item.T_cam_obj, _corners(item.mesh))[:, 2].max() < _NEAR_MM:
        return []
    (h, w), margin = size_hw, 8  # rendered beyond the image, so that outlines of cut objects leave the image
    shifted = np.array([[1.0, 0, margin], [0, 1, margin], [0, 0, 1]]) @ K
    depth = render_depth(item.mesh, shifted, item.T_cam_obj[None], (h + 2 * margin, w + 2 * margin))[0]
    return [_smooth(contour) - margin for contour in _contours(depth > 0)]


def _contours(mask: Bool[np.ndarray, "H W"]) -> list[Line]:
    found, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    return [contour[:, 0].astype(np.float64) for contour in found if len(contour) >= 16]


def _smooth(contour: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, "m+1 2"]:
    mean = np.mean([np.roll(contour, shift, axis=0) for shift in range(-2, 3)], axis=0)
    return np.concatenate([mean, mean[:1]])


def _draw_lines(canvas: UInt8[np.ndarray, "H W 3"], lines: Sequence[Line], colour: Colour, thickness: int) -> None:
    """Draw lines onto the canvas, anti-aliased, with a thin dark border so that they show on bright backgrounds."""
    fixed = [np.round(px * (1 << _SUBPIXEL_BITS)).astype(np.int32) for px in lines if np.abs(px).max() < _FAR_PX]
    for ink, width in ((INK, thickness + 1), (colour, thickness)):
        cv2.polylines(canvas, fixed, False, ink, width, cv2.LINE_AA, _SUBPIXEL_BITS)
