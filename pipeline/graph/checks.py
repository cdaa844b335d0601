"""Checks before a run: missing layers are errors, suspicious detections, cameras and meshes are warnings.

Warnings are printed when a run starts and recorded in poses.json.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from pipeline.bop.masks import decode_rle, pixels_of
from pipeline.errors import BadInput
from pipeline.functional.camera_diagnosis import diagnose_camera
from pipeline.functional.plausibility import (
    diagnose_contrast,
    diagnose_depth,
    diagnose_distance,
    distance_text,
    estimate_distance,
)
from pipeline.graph.context import Context, ImageId
from pipeline.items.features import CLASS_FACET_LAYER, PSEUDO_LAYERS, SALIENCY_LAYER
from pipeline.items.objects import MeshFacts
from pipeline.items.views import Detection
from pipeline.method import Stages
from pipeline.stages.segment import Segmenter

MIN_PIXELS = 16  # masks with fewer pixels have no recognisable shape
FULL_SHARE = 0.98  # share of the image: a larger mask is often inverted
HALF_SHARE = 0.5  # share of the image: a larger mask that touches all four sides is often the background
MAX_IDS = 10  # objects named in a warning
LARGEST_DIAMETER_MM = 10_000.0  # a mesh of a larger diameter gets a warning
MANY_FACES = 1_000_000  # a mesh of more faces gets a warning with its cost
SECONDS_PER_MILLION, GB_PER_MILLION = 5.0, 0.5  # per million faces, on one core: benchmarks/meshes.py
OUTSIDE_SHARE = 0.1  # share of a box outside the image: such boxes are often two corners instead of corner and size


def check_layers(stages: Stages) -> None:
    """Raise BadInput for a requested layer that the extractor lacks, naming the field that requests it."""
    field_of_layer = {SALIENCY_LAYER: "correspond"} | dict.fromkeys(stages.fuse.layers, "fuse.layers")
    field_of_layer |= dict.fromkeys(stages.match.layers, "match.layers") | {stages.match.layer: "match.layer"}
    for layer in stages.layers:
        try:
            stages.extract.feature_shape(layer)
        except BadInput as error:
            if "layer" not in error.where:
                raise
            if layer == SALIENCY_LAYER:
                found = f"{stages.correspond.kind}, and {stages.extract.kind} has no saliency"
                raise BadInput("correspond", found=found, needed="extract=dino or dinov2") from None
            if layer == CLASS_FACET_LAYER:
                found = f"true, and {stages.extract.kind} has no class token"
                raise BadInput("match.class_token", found=found, needed="extract=dino, or false") from None
            needed = error.needed.replace(f", {PSEUDO_LAYERS}", "")  # pseudo-layers are not allowed in these fields
            raise BadInput(field_of_layer[layer], found=error.found, needed=needed) from None


def settings_warnings(stages: Stages) -> list[str]:
    """One line per setting that has no effect because of another one.

    The default ``per_cluster`` is not reported, because methods with a single cluster never set it.
    """
    warnings = []
    top_k, views = getattr(stages.match, "top_k", 0), stages.render.count_views()
    if views is not None and top_k > views:
        warnings.append(f"match.top_k {top_k} is more than the {views} templates of an object: all of them are kept")
    per_cluster = getattr(stages.correspond, "per_cluster", None)
    if stages.cluster.kind == "cluster.one" and per_cluster != getattr(type(stages.correspond), "per_cluster", None):
        warnings.append(f"correspond.per_cluster {per_cluster} has no effect with cluster=one: all matches are kept")
    return warnings


def detection_warnings(context: Context, detections: Sequence[Detection]) -> list[str]:
    """Warnings about settings, dataset and detector, then one line per suspicious camera, then one per detection.

    Cameras are checked only without ground truth; with it, annotated poses have confirmed them.
    """
    warnings = [*settings_warnings(context.stages), *context.dataset.warnings]
    warnings += context.stages.detect.warnings(context.dataset, context.targets)
    warnings += box_warnings(detections, context.stages.segment)
    for scene_id, im_id in dict.fromkeys((d.scene_id, d.im_id) for d in detections):
        annotated = context.dataset.has_ground_truth(scene_id)
        if not annotated and (problem := _check_camera(context, (scene_id, im_id))):
            warnings.append(f"{context.dataset.image_name(scene_id, im_id)}: {problem}")
        if not annotated and (frames := context.dataset.count_frames(scene_id, im_id)) > 1:
            name = context.dataset.image_name(scene_id, im_id)
            warnings.append(f"{name}: its file has {frames} frames: the first is used")
        if reason := context.dataset.distortion(scene_id, im_id):
            warnings.append(f"{context.dataset.image_name(scene_id, im_id)}: {reason}")
    for d in detections:
        if d.defect is None and (problem := _check_detection(context, d)):
            image, name = context.dataset.image_name(d.scene_id, d.im_id), context.dataset.object_name(d.obj_id)
            warnings.append(f"{image}, {name}: {problem}")
    return warnings + _contrast_warnings(context, detections)


def distance_warnings(
    context: Context, detections: Sequence[Detection], facts_of: Callable[[int], MeshFacts]
) -> list[str]:
    """One line per object whose mesh, K and first mask or box give a distance that no photograph is taken from.

    The usual cause is a mesh that is not in millimetres. Without ground truth only, which shows the distances.
    """
    firsts: dict[int, Detection] = {}
    for d in detections:
        x0, y0, x1, y1 = d.bbox_xyxy
        is_tiny = (x1 - x0) * (y1 - y0) < MIN_PIXELS
        if d.defect is None and not is_tiny and not context.dataset.has_ground_truth(d.scene_id):
            firsts.setdefault(d.obj_id, d)
    warnings = []
    for obj_id, d in firsts.items():
        x0, y0, x1, y1 = d.bbox_xyxy
        focal_px = float(context.K((d.scene_id, d.im_id))[0, 0])
        distance_mm = estimate_distance(facts_of(obj_id).diameter_mm, focal_px, float(np.hypot(x1 - x0, y1 - y0)))
        where = f"{context.dataset.image_name(d.scene_id, d.im_id)}, {context.dataset.object_name(obj_id)}"
        if problem := _check_depth(context, d, distance_mm):
            warnings.append(f"{where}: {problem}")
        if problem := diagnose_distance(distance_mm):
            located_by = "box" if d.rle is None else "mask"
            warnings.append(f"{where}: {distance_text(distance_mm, located_by)}: {problem}")
    return warnings


def _check_depth(context: Context, d: Detection, distance_mm: float) -> str:
    """Measured depths that are in another unit, or another place's."""
    use = context.stages.depth.use
    if use == "never" or not context.dataset.gives_depth:
        return ""
    depth_mm = context.dataset.depth_mm(d.scene_id, d.im_id)
    inside = depth_mm[pixels_of(d.rle, d.bbox_xyxy, (depth_mm.shape[0], depth_mm.shape[1])) & (depth_mm > 0)]
    if not (problem := diagnose_depth(inside, distance_mm)):
        return ""
    found = f"depth has a median of {float(np.median(inside)) / 1000:.3g} m there"
    return f"{found}, where mesh and K give {distance_mm / 1000:.3g} m: {problem}"


def _contrast_warnings(context: Context, detections: Sequence[Detection]) -> list[str]:
    """One line per detection in the user's own photographs whose pixels show nothing."""
    if not context.dataset.requires_pose:
        return []
    warnings = []
    for image in dict.fromkeys((d.scene_id, d.im_id) for d in detections if d.defect is None):
        rgb = context.dataset.image(*image).rgb
        for d in detections:
            if d.defect is not None or (d.scene_id, d.im_id) != image:
                continue
            pixels = pixels_of(d.rle, d.bbox_xyxy, (rgb.shape[0], rgb.shape[1]))
            if pixels.sum() >= MIN_PIXELS and (problem := diagnose_contrast(rgb, pixels)):
                where = f"{context.dataset.image_name(*image)}, {context.dataset.object_name(d.obj_id)}"
                warnings.append(f"{where}: {problem}")
    return warnings


def box_warnings(detections: Sequence[Detection], segment: Segmenter) -> list[str]:
    """One line for all detections that have only a box, with the consequence for their poses."""
    usable = [d for d in detections if d.defect is None]
    boxes = [d for d in usable if d.rle is None]
    if not boxes:
        return []
    d, needed = boxes[0], "masks would help" if segment.makes_masks else "segment=grabcut makes masks of boxes"
    first = f"the first is scene {d.scene_id}, image {d.im_id}, object {d.obj_id}"
    cost = "what else is in the box counts as object, and most such poses are wrong"
    return [f"{len(boxes)} of {len(usable)} detections are boxes without a mask ({first}): {cost}; {needed}"]


def mesh_warnings(context: Context, facts_of: Callable[[int], MeshFacts]) -> list[str]:
    """Contradictions of models_info.json, then one line per warning about meshes with the objects concerned."""
    warnings: list[str] = []
    objects: dict[str, list[int]] = {}
    for obj_id in context.object_ids:
        facts = facts_of(obj_id)
        if warning := context.dataset.model_warning(obj_id, facts):
            warnings.append(warning)
        for text in (*facts.warnings, *_check_diameter(facts), *_check_size(facts, context.dataset.simplify)):
            objects.setdefault(text, []).append(obj_id)
    names = context.dataset.object_name
    return warnings + [f"{_describe_meshes([*map(names, obj_ids)])}: {text}" for text, obj_ids in objects.items()]


def _check_diameter(facts: MeshFacts) -> tuple[str, ...]:
    """Warning about an implausible diameter, usually from a scale applied to a mesh that is already in mm."""
    if facts.diameter_mm <= LARGEST_DIAMETER_MM:
        return ()
    metres = facts.diameter_mm / 1000
    return (f"its diameter is {metres:.4g} m: is it in millimetres, and dataset.scale for another unit?",)


def _check_size(facts: MeshFacts, simplify: int | None) -> tuple[str, ...]:
    """Cost of a mesh with many faces; empty if the user has set ``dataset.simplify``."""
    if simplify is not None or facts.faces <= MANY_FACES:
        return ()
    millions = facts.faces / 1e6
    cost = f"about {millions * SECONDS_PER_MILLION:.0f} s and {millions * GB_PER_MILLION:.1f} GB to read and prepare it"
    return (f"it has {millions:.1f} million faces: {cost}; dataset.simplify=200000 renders a smaller one",)


def _describe_meshes(names: Sequence[str]) -> str:
    """``mesh of object 1, 5``, or the user's names of the objects."""
    numbered = all(name.startswith("object ") for name in names)
    shown = [name.removeprefix("object ") if numbered else name for name in names[:MAX_IDS]]
    of = ("object" if len(names) == 1 else "objects") + " " if numbered else ""
    return f"mesh of {of}{', '.join(shown)}" + (", ..." if len(names) > MAX_IDS else "")


def _check_camera(context: Context, image: ImageId) -> str:
    orientation = context.dataset.orientation(*image)
    return diagnose_camera(context.K(image), context.dataset.image_size(*image), exif_orientation=orientation)


def _check_detection(context: Context, d: Detection) -> str:
    given_as_box = d.rle is None or context.dataset.given_bbox_xyxy is not None
    problem = _check_box(context, d) if given_as_box else ""
    return problem if d.rle is None else problem or _check_mask(context, d, d.rle)


def _check_box(context: Context, d: Detection) -> str:
    h, w = context.dataset.image_size(d.scene_id, d.im_id)
    x0, y0, x1, y1 = np.clip(d.bbox_xyxy, -0.5, (w - 0.5, h - 0.5, w - 0.5, h - 0.5))
    left, top, right, bottom = d.bbox_xyxy
    inside_px, box_px = float(max(x1 - x0, 0) * max(y1 - y0, 0)), (right - left) * (bottom - top)
    if context.dataset.given_bbox_xyxy and inside_px < (1 - OUTSIDE_SHARE) * box_px:
        share = 1 - inside_px / box_px
        return f"{share:.0%} of the box lies outside the image; is it x, y, width, height, and not two corners?"
    return _check_area("box", inside_px, h * w, is_background=False)


def _check_mask(context: Context, d: Detection, rle: dict[str, Any]) -> str:
    h, w = context.dataset.image_size(d.scene_id, d.im_id)
    mask = decode_rle(rle)
    touches_all_sides = all(side.any() for side in (mask[0], mask[-1], mask[:, 0], mask[:, -1]))
    pixels = float(mask.sum())
    return _check_area("mask", pixels, h * w, is_background=touches_all_sides and pixels >= HALF_SHARE * h * w)


def _check_area(what: str, pixels: float, image_pixels: int, *, is_background: bool) -> str:
    if pixels < MIN_PIXELS:
        return f"the {what} has {pixels:.0f} pixel{'s' if round(pixels) != 1 else ''}; too few for a reliable pose"
    if pixels >= FULL_SHARE * image_pixels or is_background:
        return f"the {what} covers {pixels / image_pixels:.0%} of the image; is it the object's, and not inverted?"
    return ""
