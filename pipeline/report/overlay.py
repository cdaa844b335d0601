"""photograph, poses -> picture with outlines and boxes."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import PIL.Image
import PIL.ImageDraw
import PIL.ImageFont
from jaxtyping import Bool, Float, UInt8

from pipeline.functional.camera import project, resize_affine
from pipeline.functional.rigid import transform
from pipeline.io.files import write_atomic
from pipeline.items.objects import Mesh
from pipeline.items.views import Image
from pipeline.stages.render.raycast import render_depth

Role = Literal["truth", "correct", "wrong", "unchecked"]
Colour = tuple[int, int, int]
_COLOURS: dict[Role, Colour] = {
    "truth": (50, 130, 255),
    "correct": (50, 215, 90),
    "wrong": (245, 60, 50),
    "unchecked": (255, 190, 30),
}
_LEGEND: dict[Role, str] = {
    "truth": "ground truth",
    "correct": "estimate, correct",
    "wrong": "estimate, wrong",
    "unchecked": "estimate",
}
_INK = (20, 20, 20)
_NEAR_MM = 10.0  # edges are cut where they come closer to the camera plane
_FAR_PX = 1e6  # fixed-point drawing coordinates overflow beyond
_SUBPIXEL_BITS = 4
_EDGES = [(a, b) for a in range(8) for b in range(a + 1, 8) if (a ^ b) in (1, 2, 4)]  # corners differ in one axis


@dataclass(frozen=True, eq=False)
class DrawnPose:
    """One pose to draw. ``role`` "unchecked": an estimate without ground truth to compare with."""

    mesh: Mesh
    T_cam_obj: Float[np.ndarray, "4 4"]
    role: Role
    label: str = ""


def draw_overlay(image: Image, items: Sequence[DrawnPose], *, legend: bool = True) -> UInt8[np.ndarray, "H W 3"]:
    """The photograph with each pose's silhouette outline, 3D box and label, and a legend unless there is to be none.

    Images under 1000 px are enlarged by a whole factor (at most 4). The box is the mesh's axis-aligned one in the
    object frame. What lies behind the camera is left out.
    """
    factor = _enlargement(image.rgb)
    h, w = (side * factor for side in image.rgb.shape[:2])
    K = resize_affine(float(factor)) @ image.K
    # cv2's resize holds pixel edges on pixel edges, as resize_affine does
    canvas = cv2.resize(image.rgb, (w, h), interpolation=cv2.INTER_CUBIC) if factor > 1 else image.rgb.copy()
    ordered = sorted(items, key=lambda item: item.role != "truth")  # estimates on top
    width = max(2, round(max(h, w) / 640))
    boxes = canvas.copy()
    for item in ordered:
        _lines(boxes, _box_segments(item, K), _COLOURS[item.role], width)
    canvas = cv2.addWeighted(boxes, 0.6, canvas, 0.4, 0)
    for item in ordered:
        thickness = width + 1 if item.role == "truth" else width
        _lines(canvas, _outlines(item, K, (h, w)), _COLOURS[item.role], thickness)
    return _written(canvas, ordered, K, legend=legend)


def write_overlay(path: Path, picture: UInt8[np.ndarray, "H W 3"], *, quality: int = 90) -> None:
    """Write a picture as its suffix says (.jpg, .png); a reader sees the whole file or none."""
    stream = io.BytesIO()
    PIL.Image.fromarray(picture).save(stream, PIL.Image.registered_extensions()[path.suffix], quality=quality)
    write_atomic(path, stream.getvalue())


def clip_to_front(segments_cam: Float[np.ndarray, "e 2 3"], *, near_mm: float = _NEAR_MM) -> Float[np.ndarray, "k 2 3"]:
    """The parts of segments (camera frame, mm) at z >= near_mm; segments wholly behind are left out."""
    segments = segments_cam[segments_cam[:, :, 2].max(axis=1) >= near_mm]
    start, end = segments[:, :1], segments[:, 1:]
    z = segments[..., 2:]
    step = np.where(end[..., 2:] == start[..., 2:], 1.0, end[..., 2:] - start[..., 2:])
    cut = start + (near_mm - start[..., 2:]) / step * (end - start)
    return np.where(z < near_mm, cut, segments)


def _enlargement(rgb: UInt8[np.ndarray, "H W 3"]) -> int:
    return int(np.clip(np.ceil(1000 / max(rgb.shape[:2])), 1, 4))


def _corners(mesh: Mesh) -> Float[np.ndarray, "8 3"]:
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    bits = np.array([[(i >> axis) & 1 for axis in range(3)] for i in range(8)])
    return np.where(bits == 1, high, low)


def _box_segments(item: DrawnPose, K: Float[np.ndarray, "3 3"]) -> list[Float[np.ndarray, "2 2"]]:
    corners = transform(item.T_cam_obj, _corners(item.mesh))
    return list(project(K, clip_to_front(corners[np.array(_EDGES)])))


def _outlines(item: DrawnPose, K: Float[np.ndarray, "3 3"], size_hw: tuple[int, int]) -> list[Float[np.ndarray, "m 2"]]:
    """Closed outlines (and holes) of the silhouette, pixels, smoothed over five contour points."""
    if transform(item.T_cam_obj, _corners(item.mesh))[:, 2].max() < _NEAR_MM:
        return []
    (h, w), margin = size_hw, 8  # drawn a little past the image, so that outlines leave it
    shifted = np.array([[1.0, 0, margin], [0, 1, margin], [0, 0, 1]]) @ K
    depth = render_depth(item.mesh, shifted, item.T_cam_obj[None], (h + 2 * margin, w + 2 * margin))[0]
    return [_smooth(contour) - margin for contour in _contours(depth > 0)]


def _contours(mask: Bool[np.ndarray, "H W"]) -> list[Float[np.ndarray, "m 2"]]:
    found, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    return [contour[:, 0].astype(np.float64) for contour in found if len(contour) >= 16]


def _smooth(contour: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, "m+1 2"]:
    mean = np.mean([np.roll(contour, shift, axis=0) for shift in range(-2, 3)], axis=0)
    return np.concatenate([mean, mean[:1]])


def _lines(
    canvas: UInt8[np.ndarray, "H W 3"], lines: Sequence[Float[np.ndarray, "m 2"]], colour: Colour, thickness: int
) -> None:
    """Draw onto the canvas, anti-aliased, over a thin dark border that keeps them visible on bright ground."""
    fixed = [np.round(px * (1 << _SUBPIXEL_BITS)).astype(np.int32) for px in lines if np.abs(px).max() < _FAR_PX]
    for ink, width in ((_INK, thickness + 1), (colour, thickness)):
        cv2.polylines(canvas, fixed, False, ink, width, cv2.LINE_AA, _SUBPIXEL_BITS)


def _written(
    canvas: UInt8[np.ndarray, "H W 3"], items: Sequence[DrawnPose], K: Float[np.ndarray, "3 3"], *, legend: bool
) -> UInt8[np.ndarray, "H W 3"]:
    """The canvas with labels and, at the lower left, a legend of the roles drawn."""
    picture = PIL.Image.fromarray(canvas)
    draw = PIL.ImageDraw.Draw(picture)
    size = max(11, round(max(canvas.shape[:2]) / 75))
    font = PIL.ImageFont.load_default(size)
    taken: list[tuple[float, float, float, float]] = []
    for item in items:
        if item.label and (segments := _box_segments(item, K)):
            x, y = np.min(np.concatenate(segments), axis=0)
            taken.append(_label(draw, font, item.label, (float(x), float(y) - 1.6 * size), item.role, taken))
    if legend:
        _draw_legend(draw, font, size, [role for role in _COLOURS if any(item.role == role for item in items)])
    return np.asarray(picture).copy()


def _label(
    draw: PIL.ImageDraw.ImageDraw,
    font: PIL.ImageFont.ImageFont | PIL.ImageFont.FreeTypeFont,
    text: str,
    at: tuple[float, float],
    role: Role,
    taken: Sequence[tuple[float, float, float, float]],
) -> tuple[float, float, float, float]:
    """Write a label inside the picture, below others that are in its way; its rectangle."""
    pad = 4
    _, _, w, h = draw.textbbox((0, 0), text, font=font)
    w, h = float(w + 2 * pad), float(h + 2 * pad)
    x = min(max(at[0], 0.0), max(draw.im.size[0] - w, 0.0))
    y = min(max(at[1], 0.0), max(draw.im.size[1] - h, 0.0))
    for left, top, right, bottom in sorted(taken, key=lambda box: box[1]):
        if left < x + w and x < right and top < y + h and y < bottom:
            y = bottom + 1
    draw.rounded_rectangle((x, y, x + w, y + h), radius=4, fill=_COLOURS[role])
    draw.text((x + pad, y + pad), text, fill=_INK, font=font)
    return x, y, x + w, y + h


def _draw_legend(
    draw: PIL.ImageDraw.ImageDraw,
    font: PIL.ImageFont.ImageFont | PIL.ImageFont.FreeTypeFont,
    size: int,
    roles: Sequence[Role],
) -> None:
    if not roles:
        return
    line, pad = 1.5 * size, 0.6 * size
    width = max(draw.textlength(_LEGEND[role], font=font) for role in roles) + 2.2 * size + 2 * pad
    top = draw.im.size[1] - len(roles) * line - 1.5 * pad
    draw.rectangle((0, top, width, draw.im.size[1]), fill=_INK)
    for row, role in enumerate(roles):
        y = top + pad + row * line
        draw.rectangle((pad, y + 0.45 * size, pad + 1.6 * size, y + 0.7 * size), fill=_COLOURS[role])
        draw.text((pad + 2.2 * size, y), _LEGEND[role], fill=(240, 240, 240), font=font)
