"""``dzop doctor``: check a mesh, and a photograph with its K and mask, before a pose is estimated."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool

from pipeline.bop.images import image_size, read_orientation, read_rgb
from pipeline.bop.photo import Photo, PhotoConfig
from pipeline.bop.symmetries import mesh_symmetries
from pipeline.errors import DzopError
from pipeline.functional.camera_diagnosis import diagnose_camera
from pipeline.functional.surface import signed_volume
from pipeline.io.meshes import prepare_mesh
from pipeline.items.objects import Mesh, MeshFacts

Level = Literal["ok", "note", "warning", "error"]
MANY_FACES, FEW_PIXELS, FAR_ORIGIN = 1_000_000, 1000, 1.5
NEAR_MM, FAR_MM = 60.0, 10_000.0  # plausible distances of an object that a robot is to pick
FLAT = 1e-3  # smallest over largest side of the bounding box; below this, a mesh counts as a sheet
DARK, BRIGHT = 25.0, 235.0


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
    findings = list(examine(options.mesh, options.image, options.K, options.mask, scale=options.scale))
    for finding in findings:
        print(finding.line())
    worst = [finding for finding in findings if finding.level in ("error", "warning")]
    print(f"\n{len(worst)} of {len(findings)} checks found a problem" if worst else "\nno problems found")
    if any(finding.level == "error" for finding in findings):
        sys.exit(1)


def examine(
    mesh: str, image: str | None = None, K: str | None = None, mask: str | None = None, *, scale: float = 1.0
) -> Iterator[Finding]:
    """All findings about a mesh file, and about a photograph, its K (as ``dataset.K``) and its mask."""
    diameter_mm: float | None = None
    try:
        read, facts = prepare_mesh(Path(mesh).expanduser(), scale=scale)
        diameter_mm = facts.diameter_mm
        yield from examine_mesh(read, facts, scale)
    except DzopError as error:
        yield Finding("error", "mesh", str(error))
    if image is not None:
        yield from _examine_photograph(mesh, image, K, mask, diameter_mm)


def examine_mesh(mesh: Mesh, facts: MeshFacts, scale: float) -> Iterator[Finding]:
    """Unit, size, origin, winding, colours, faces and symmetry of a mesh."""
    d, sides = facts.diameter_mm, np.ptp(mesh.vertices, axis=0)
    yield _examine_unit(d, scale)
    if sides.min() < FLAT * sides.max():
        yield Finding(
            "warning",
            "shape",
            f"flat: {_sides(sides)} mm",
            "use a mesh with thickness; a sheet cannot be seen from behind",
        )
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


def _examine_photograph(
    mesh: str, image: str, K: str | None, mask: str | None, diameter_mm: float | None
) -> Iterator[Finding]:
    try:
        size_hw = image_size(Path(image).expanduser())
        yield from _examine_pixels(Path(image).expanduser(), size_hw)
        if K is None:
            yield Finding("error", "K", "not given", "give K in pixels as fx,fy,cx,cy, a camera file, or exif")
            return
        photo = PhotoConfig(mesh=mesh, image=image, K=K, mask=mask).open()
        problem = diagnose_camera(photo.camera_matrix, size_hw, exif_orientation=photo.orientation(0, 0))
        yield Finding("warning", "K", problem) if problem else Finding("ok", "K", "plausible for this image")
        for text in photo.warnings:
            yield Finding("warning", "K", text)
        if mask is not None:
            yield from _examine_mask(photo, size_hw, diameter_mm)
    except DzopError as error:
        yield Finding("error", "input", str(error))


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


def _examine_mask(photo: Photo, size_hw: tuple[int, int], diameter_mm: float | None) -> Iterator[Finding]:
    """Area, pieces and border of the mask, and the distance that follows from its size and the mesh's."""
    path = photo.masks[0][0]
    mask = photo.object_mask(path, size_hw)
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
    if diameter_mm is not None:
        yield _examine_distance(photo, mask, diameter_mm)


def _examine_distance(photo: Photo, mask: Bool[np.ndarray, "H W"], diameter_mm: float) -> Finding:
    """The distance at which an object of this diameter appears as large as the mask; if occluded, it is nearer."""
    rows, columns = np.nonzero(mask)
    longest_px = float(np.hypot(np.ptp(rows) + 1, np.ptp(columns) + 1))
    distance_mm = float(photo.camera_matrix[0, 0]) * diameter_mm / longest_px
    text = f"mesh, K and mask give a distance of about {distance_mm / 1000:.3g} m"
    if NEAR_MM <= distance_mm <= FAR_MM:
        return Finding("ok", "distance", text)
    factors = {"metres": 1000.0, "inches": 25.4, "centimetres": 10.0}
    fitting = [name for name, f in factors.items() if NEAR_MM * 3 <= distance_mm * f <= FAR_MM / 3]
    remedy = f"check K; or is the mesh in {' or '.join(fitting)}?" if fitting else "check K and the mesh's unit"
    return Finding("warning", "distance", text, remedy)


def _count_pieces(mask: Bool[np.ndarray, "H W"]) -> int:
    """Number of connected parts with at least 1 % of the mask's pixels."""
    _, _, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    return int((stats[1:, cv2.CC_STAT_AREA] >= mask.sum() / 100).sum())


def _sides(sides: np.ndarray) -> str:
    return " x ".join(f"{side:.4g}" for side in sides)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="dzop doctor", description="Check your own mesh, photograph, K and mask.")
    parser.add_argument("mesh", help="the mesh's file")
    parser.add_argument("image", nargs="?", help="the photograph")
    parser.add_argument("K", nargs="?", help="fx,fy,cx,cy in pixels, a camera file, or exif")
    parser.add_argument("mask", nargs="?", help="the object's mask")
    parser.add_argument("--scale", type=float, default=1.0, help="multiplies the mesh: 1000 for metres (default: 1)")
    return parser
