"""``dzop doctor``: check a mesh, and a photograph with its K and mask, before a pose is estimated."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from pipeline.bop.given import MeshFiles, Unit
from pipeline.bop.images import image_size, read_orientation, read_rgb
from pipeline.bop.photo import Photo, PhotoConfig
from pipeline.bop.scene import Box
from pipeline.bop.symmetries import mesh_symmetries
from pipeline.errors import DzopError
from pipeline.functional.boxes import pixels_inside
from pipeline.functional.camera_diagnosis import diagnose_camera
from pipeline.functional.plausibility import (
    diagnose_contrast,
    diagnose_depth,
    diagnose_distance,
    distance_text,
    estimate_distance,
)
from pipeline.functional.surface import signed_volume
from pipeline.io.meshes import prepare_mesh
from pipeline.items.objects import Mesh, MeshFacts

Level = Literal["ok", "note", "warning", "error"]
MANY_FACES, FEW_PIXELS, FAR_ORIGIN = 1_000_000, 1000, 1.5
DARK, BRIGHT = 25.0, 235.0
MOST_INSIDE = 0.9  # share of a box inside the image, below which it may be two corners
FEWEST_MEASURED = 0.2  # share of an object's pixels with a depth


@dataclass(frozen=True)
class Finding:
    """The result of a check: its subject, what was found, and the remedy ("" if none is needed)."""

    level: Level
    about: str
    text: str
    remedy: str = ""

    def line(self) -> str:
        """The finding for the terminal."""
        return f"{self.level:<8}{self.about:<10}{self.text}" + (f"\n{'':18}-> {self.remedy}" if self.remedy else "")


def doctor_command(arguments: Sequence[str]) -> None:
    """``dzop doctor MESH [IMAGE K [MASK]]``: print the findings. Exits with status 1 if one of them is an error."""
    options = _parser().parse_args(arguments)
    given = {name: value for name, value in vars(options).items() if name not in ("mesh", "image", "K")}
    findings = list(examine(options.mesh, options.image, options.K, **given))
    for finding in findings:
        print(finding.line())
    worst = [finding for finding in findings if finding.level in ("error", "warning")]
    print(f"\n{len(worst)} of {len(findings)} checks found a problem" if worst else "\nno problems found")
    if any(finding.level == "error" for finding in findings):
        sys.exit(1)


def examine(
    mesh: str,
    image: str | None = None,
    K: str | None = None,
    mask: str | None = None,
    *,
    bbox: str | None = None,
    depth: str | None = None,
    depth_scale: float = 1.0,
    scale: float = 1.0,
    units: Unit = "mm",
) -> Iterator[Finding]:
    """All findings about a mesh file and a photograph. The arguments are fields of ``dataset``, as texts."""
    diameter_mm: float | None = None
    try:
        files = MeshFiles((Path(mesh).expanduser(),), scale, units=units)
        factor = files.factor(1)
        read, facts = prepare_mesh(files.path(1), scale=factor)
        diameter_mm = facts.diameter_mm
        yield from examine_mesh(read, facts, factor)
    except DzopError as error:
        yield Finding("error", "mesh", str(error))
    if image is None:
        return
    try:
        size_hw = image_size(Path(image).expanduser())
        yield from _examine_pixels(Path(image).expanduser(), size_hw)
        if K is None:
            yield Finding("error", "K", "not given", "give K in pixels as fx,fy,cx,cy, a camera file, or exif")
            return
        photo = PhotoConfig(
            mesh=mesh, image=image, K=K, mask=mask, bbox=bbox, depth=depth, depth_scale=depth_scale
        ).open()
        yield from _examine_photograph(photo, size_hw, diameter_mm)
    except DzopError as error:
        yield Finding("error", "input", str(error))


def examine_mesh(mesh: Mesh, facts: MeshFacts, scale: float) -> Iterator[Finding]:
    """Unit, size, origin, winding, colours, faces and symmetry of a mesh."""
    d = facts.diameter_mm
    yield _examine_unit(d, scale)
    centre = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
    away = float(np.linalg.norm(centre)) / d
    if away > FAR_ORIGIN:
        text = f"the origin is {away:.1f} diameters from the middle of the mesh; T_cam_obj places the origin"
        yield Finding(
            "warning", "origin", text, "centre the mesh at its origin, or expect translations far from the object"
        )
    else:
        yield Finding("ok", "origin", f"{away:.1f} diameters from the middle of the mesh")
    if signed_volume(mesh.vertices, mesh.faces) < 0:
        yield Finding("warning", "winding", "the faces are turned inside out", "flip the normals when exporting")
    for text in facts.warnings:
        yield Finding("warning", "mesh", text)
    if mesh.texture is not None or mesh.colours is not None:
        kind = "a texture" if mesh.texture is not None else "vertex colours"
        yield Finding("ok", "colours", kind)
    if facts.faces > MANY_FACES:
        yield Finding("warning", "faces", f"{facts.faces / 1e6:.1f} million", "dataset.simplify=200000")
    else:
        yield Finding("ok", "faces", f"{facts.faces}")
    geometric, visible = mesh_symmetries(mesh, d)
    level: Level = "note" if visible.text != "none" else "ok"
    yield Finding(level, "symmetry", f"shape: {geometric.text}; appearance: {visible.text}")


def _examine_unit(diameter: float, scale: float) -> Finding:
    text = f"a diameter of {diameter:.4g} mm"
    if 2 <= diameter < 10_000:
        small = "; if it is larger, the file is not in millimetres" if diameter < 20 else ""
        return Finding("note" if small else "ok", "unit", text + small)
    fitting = {"metres": 1000.0, "centimetres": 10.0, "inches": 25.4, "micrometres": 0.001}
    likely = "metres" if diameter < 2 else "micrometres"
    return Finding("error", "unit", f"{text}: it looks like {likely}", f"dataset.scale={scale * fitting[likely]:g}")


def _examine_photograph(photo: Photo, size_hw: tuple[int, int], diameter_mm: float | None) -> Iterator[Finding]:
    """K, then mask or box, the distance that follows from its size, and the depth inside it."""
    problem = diagnose_camera(photo.camera_matrix, size_hw, exif_orientation=photo.orientation(0, 0))
    yield Finding("warning", "K", problem) if problem else Finding("ok", "K", "plausible for this image")
    for text in photo.warnings:
        yield Finding("warning", "K", text)
    if photo.masks:
        mask = photo.object_mask(photo.masks[0][0], size_hw)
        yield from _examine_mask(mask)
    elif photo.bbox_xyxy is not None:
        mask = np.zeros(size_hw, dtype=bool)
        mask[pixels_inside(photo.locate(photo.targets[0])[0].bbox_xyxy, size_hw)] = True
        yield from _examine_box(photo.bbox_xyxy, size_hw)
    else:
        mask = np.ones(size_hw, dtype=bool)
    located = bool(mask.any()) and not mask.all()
    distance_mm = _implied_distance(photo, mask, diameter_mm) if located and diameter_mm is not None else None
    if located and (text := diagnose_contrast(photo.image(0, 0).rgb, mask)):
        yield Finding("warning", "image", text, "change the exposure, or take another photograph")
    if distance_mm is not None:
        yield _examine_distance(distance_mm, "mask" if photo.masks else "box")
    if photo.gives_depth and mask.any():
        yield from _examine_depth(photo.depth_mm(0, 0)[mask], distance_mm)


def _examine_pixels(path: Path, size_hw: tuple[int, int]) -> Iterator[Finding]:
    rgb = read_rgb(path)
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    (h, w), mean = size_hw, float(grey.mean())
    if mean < DARK or mean > BRIGHT:
        how = "dark" if mean < DARK else "bright"
        yield Finding("warning", "image", f"very {how}: a mean of {mean:.0f} of 255", "change the exposure")
    yield Finding("ok", "image", f"{w} x {h} pixels (width x height)")
    if read_orientation(path) != 1:
        yield Finding(
            "note", "image", "is turned upright by its EXIF orientation", "give K and mask of the upright image"
        )


def _examine_mask(mask: Bool[np.ndarray, "H W"]) -> Iterator[Finding]:
    """Area, pieces and border of the mask."""
    pixels, share = int(mask.sum()), float(mask.mean())
    if pixels == 0:
        yield Finding("error", "mask", "empty", "paint the object's pixels white")
        return
    sides = [bool(side.any()) for side in (mask[0], mask[-1], mask[:, 0], mask[:, -1])]
    if share > 0.98 or (all(sides) and share > 0.5):
        yield Finding("warning", "mask", f"covers {share:.0%} of the image and touches all sides", "invert the mask")
    elif pixels < FEW_PIXELS:
        yield Finding("warning", "mask", f"only {pixels} pixels", "use a closer photograph or a higher resolution")
    else:
        yield Finding("ok", "mask", f"{pixels} pixels, {share:.1%} of the image")
    if any(sides) and not all(sides):
        yield Finding("note", "mask", "touches the border: part of the object may lie outside the image")
    if (pieces := _count_pieces(mask)) > 1:
        yield Finding("note", "mask", f"{pieces} separate pieces: a partly hidden object, or several objects")


def _examine_box(box: Box, size_hw: tuple[int, int]) -> Iterator[Finding]:
    """How much of the box lies in the image."""
    (x0, y0, x1, y1), (h, w) = box, size_hw
    inside = max(min(x1, w) - max(x0, 0), 0) * max(min(y1, h) - max(y0, 0), 0) / ((x1 - x0) * (y1 - y0))
    if inside < MOST_INSIDE:
        text = f"{1 - inside:.0%} of it lies outside the image"
        yield Finding("warning", "box", text, "give x, y, width, height, not two corners")
    else:
        yield Finding("ok", "box", f"{x1 - x0:.0f} x {y1 - y0:.0f} pixels; a mask gives better poses")


def _examine_depth(depth_mm: Float32[np.ndarray, " n"], distance_mm: float | None) -> Iterator[Finding]:
    """How much of the object has a depth, and whether that is near the distance that follows from its size."""
    share = float((depth_mm > 0).mean())
    if share < FEWEST_MEASURED:
        yield Finding(
            "warning", "depth", f"known in {share:.0%} of the object", "register depth to colour, or leave it"
        )
    if share == 0:
        return
    median_mm = float(np.median(depth_mm[depth_mm > 0]))
    text = f"a median of {median_mm / 1000:.3g} m on the object"
    remedy = "" if distance_mm is None else diagnose_depth(depth_mm[depth_mm > 0], distance_mm)
    if distance_mm is None or not remedy:
        yield Finding("ok", "depth", text)
        return
    yield Finding("warning", "depth", f"{text}, where mesh and K give {distance_mm / 1000:.3g} m", remedy)


def _implied_distance(photo: Photo, mask: Bool[np.ndarray, "H W"], diameter_mm: float) -> float:
    """The distance, mm, at which an object of this diameter appears as large as the mask; if occluded, it is nearer."""
    rows, columns = np.nonzero(mask)
    longest_px = float(np.hypot(np.ptp(rows) + 1, np.ptp(columns) + 1))
    return estimate_distance(diameter_mm, float(photo.camera_matrix[0, 0]), longest_px)


def _examine_distance(distance_mm: float, located_by: str) -> Finding:
    """Whether a photograph is taken from this distance."""
    remedy = diagnose_distance(distance_mm)
    return Finding("warning" if remedy else "ok", "distance", distance_text(distance_mm, located_by), remedy)


def _count_pieces(mask: Bool[np.ndarray, "H W"]) -> int:
    """Number of connected parts with at least 1 % of the mask's pixels."""
    _, _, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    return int((stats[1:, cv2.CC_STAT_AREA] >= mask.sum() / 100).sum())


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="dzop doctor", description="Check your own mesh, photograph, K and mask.")
    parser.add_argument("mesh", help="the mesh's file")
    parser.add_argument("image", nargs="?", help="the photograph")
    parser.add_argument("K", nargs="?", help="fx,fy,cx,cy in pixels, a camera file, or exif")
    parser.add_argument("mask", nargs="?", help="the object's mask")
    add = parser.add_argument
    add("--bbox", help="x,y,width,height in pixels, instead of a mask")
    add("--depth", help="a depth image registered to the photograph")
    add("--depth-scale", type=float, default=1.0, help="mm per unit of the depth image (default: 1)")
    add("--scale", type=float, default=1.0, help="multiplies the mesh: 1000 for metres (default: 1)")
    add("--units", choices=get_args(Unit), default="mm", help="of the mesh (default: mm)")
    return parser
