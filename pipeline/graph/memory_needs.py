"""Stages, mesh -> bytes that the parts of a run need.

Sizes that follow from array shapes are exact: weights, maps, an object's templates. Temporaries of libraries are
estimated from their largest arrays.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch

from pipeline.backbones.batching import Footprint
from pipeline.graph.context import Context
from pipeline.graph.proposals import ProposalNodes
from pipeline.graph.templates import CROPS_PER_BATCH, RERENDER_SCALE, VIEWS_PER_BATCH
from pipeline.method import Stages

HALF_BYTES = 2  # stored feature maps are float16
VIEW_PIXEL_BYTES = 8  # uint8 rgb, float32 depth and mask of a rendered view
CROP_PIXEL_BYTES = 4  # uint8 rgb and mask of a crop
FLOAT_BYTES = 4  # depth and encoded maps are float32
RAY_BYTES = 160  # origin, direction, hit, colour and normal of a ray
MATCHED_CELL_BYTES = 24  # float32 product, norm and cosine of a cell, each with a temporary
FITTED_VALUE_BYTES = 3  # float16 foreground cells, in parts and concatenated; about 3/4 of a crop is foreground
FUSED_VALUE_BYTES = 16  # float32 maps of query and template on the finest grid, each with a copy

Shape = tuple[int, int, int]
"""(channels, rows, columns) of a feature map."""


@dataclass(frozen=True)
class MemoryNeeds:
    """Bytes that the parts of a run need, on whatever device.

    ``templates``: number of templates of an object. ``footprint``: of a backbone pass, None without one. ``bank``: an
    object's templates as the matcher holds them. ``view``: one template with its features and encoding, as later
    stages read it. ``online``: fused maps of one pair. ``rerender``: drawing a hypothesis. ``unknown``: parts of
    unknown size.
    """

    templates: int
    weights: int
    footprint: Footprint | None
    render: int
    fits: int
    bank: int
    view: int
    online: int
    rerender: int
    unknown: tuple[str, ...] = ()


def estimate_needs(context: Context, proposals: ProposalNodes | None) -> MemoryNeeds:
    """Needs of a run, from the first object: every object has the same number of templates of the same size."""
    stages = context.stages
    _, T_cam_obj, (h, w) = stages.render.cameras(context.model(context.object_ids[0]).mesh)
    n, crop_pixels = len(T_cam_obj), stages.crop.size**2
    shapes = {layer: stages.extract.feature_shape(layer) for layer in stages.layers}
    map_values = {layer: _values(shape) for layer, shape in shapes.items()}
    finest_cells = max((shapes[layer][1] ** 2 for layer in stages.fuse.layers), default=0)
    fused_values = finest_cells * sum(shapes[layer][0] for layer in stages.fuse.layers)
    encoded = 0 if stages.fuse.joint else FLOAT_BYTES * fused_values
    footprint, weights, unknown = _backbone_needs(context, proposals)
    return MemoryNeeds(
        templates=n,
        weights=weights,
        footprint=footprint,
        render=_render_bytes(stages, h * w),
        fits=max((FITTED_VALUE_BYTES * n * map_values[fit.layer] for fit in stages.fits), default=0),
        bank=_bank_bytes(stages, shapes, n),
        view=HALF_BYTES * sum(map_values.values()) + encoded + crop_pixels + FLOAT_BYTES * h * w,
        online=FUSED_VALUE_BYTES * fused_values,
        rerender=_rerender_bytes(stages),
        unknown=unknown,
    )


def _rerender_bytes(stages: Stages) -> int:
    """The picture of a hypothesis and its rays."""
    pixels = (RERENDER_SCALE * stages.crop.size) ** 2
    return pixels * (VIEW_PIXEL_BYTES + 2 * RAY_BYTES) if stages.second_look.hypotheses else 0


def _values(shape: Shape) -> int:
    channels, rows, columns = shape
    return channels * rows * columns


def _render_bytes(stages: Stages, view_pixels: int) -> int:
    """A batch of views, the rays of one of them, and a batch of views with their crops."""
    rays_per_pixel = 1 + getattr(stages.render, "supersample", 1) ** 2
    views = VIEWS_PER_BATCH * VIEW_PIXEL_BYTES * view_pixels
    rays = rays_per_pixel * RAY_BYTES * view_pixels
    crops = CROPS_PER_BATCH * (VIEW_PIXEL_BYTES * view_pixels + CROP_PIXEL_BYTES * stages.crop.size**2)
    return views + rays + crops


def _bank_bytes(stages: Stages, shapes: Mapping[int, Shape], templates: int) -> int:
    """An object's templates as the matcher holds them: fitted arrays, nothing, or maps with masks."""
    if stages.match.fit is not None:
        return sum(fit.array_bytes(shapes[fit.layer][0], templates) for fit in stages.fits)
    if stages.match.needs_truth:
        return 0
    matched = [shapes[layer] for layer in stages.match.layers]
    cells = max(rows * columns for _, rows, columns in matched)
    mask = stages.crop.size**2
    return templates * (HALF_BYTES * sum(map(_values, matched)) + mask + MATCHED_CELL_BYTES * cells)


def _backbone_needs(context: Context, proposals: ProposalNodes | None) -> tuple[Footprint | None, int, tuple[str, ...]]:
    """Footprint of the largest pass, bytes of all weights, and the models of unknown size."""
    extractors = [(context, context.stages.layers)]
    if proposals is not None and proposals.context is not context:
        extractors.append((proposals.context, (proposals.describer.layer,)))
    device = torch.device(context.device).type
    footprints: list[Footprint] = []
    unknown: list[str] = []
    for owner, layers in extractors:
        extract = owner.stages.extract
        footprint = extract.footprint(layers, owner.stages.crop.size, device)
        if footprint is None:
            unknown.append(extract.kind)
        else:
            footprints.append(footprint)
    weights = sum(f.weight_bytes for f in footprints)
    if proposals is not None:
        weights += proposals.describer.proposer.weight_bytes()
        unknown.append("passes of the proposer")
    largest = max(footprints, key=lambda f: f.bytes_per_pass + f.bytes_per_crop, default=None)
    return largest, weights, tuple(unknown)
