"""crops -> histograms of oriented gradients: a control without weights (Dalal and Triggs, CVPR 2005)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torch.nn.functional import avg_pool2d, conv2d, interpolate, pad, unfold

from pipeline.items.features import FeatureMaps
from pipeline.items.views import Crops
from pipeline.spec import Fraction, NonNegative, Positive, PositiveFloat, Runtime, Spec, spec
from pipeline.stages.extract.grid import cells_of


@spec
class Hog(Spec):
    """Gradient histograms per cell with those of its 8 neighbours as context, normalised by local energy.

    ``signed``: an edge from dark to bright differs from its opposite. ``context_cells``: distance of the neighbours.
    ``silhouette``: weight of gradients at the mask's border, which compare object and black, not object and scene.
    ``contrast``: grey levels (0..1) per pixel below which a gradient counts as noise.
    """

    kind: ClassVar[str] = "extract.hog"
    version: ClassVar[int] = 1
    needs_geometry: ClassVar[bool] = False
    notice: ClassVar[str] = ""
    model: ClassVar[str] = "hog"
    timestep: ClassVar[int] = 0

    orientations: Positive = 8
    signed: bool = False
    context_cells: NonNegative = 1
    silhouette: Fraction = 1.0
    contrast: PositiveFloat = 0.02

    @property
    def channels(self) -> int:
        """Length of a cell's descriptor."""
        return self.orientations * (9 if self.context_cells else 1)

    def feature_shape(self, layer: int) -> tuple[int, int, int]:
        """(c, h, w). Raises BadInput for a layer other than 2, 5, 8, 11."""
        return self.channels, cells_of(layer), cells_of(layer)

    def load(self, runtime: Runtime) -> HogBackbone:
        """Nothing to load."""
        return HogBackbone(self, runtime)


class HogBackbone:
    """A Hog spec on a device."""

    def __init__(self, spec: Hog, runtime: Runtime) -> None:
        self.spec, self.device, self.batch = spec, torch.device(runtime.torch_device()), runtime.batch or 32

    @torch.no_grad()
    def __call__(self, crops: Crops, layers: Sequence[int]) -> FeatureMaps:
        """Maps of the given layers, float32."""
        cells = {layer: cells_of(layer) for layer in layers}
        rgb, mask = (torch.from_numpy(np.ascontiguousarray(x)).to(self.device) for x in (crops.rgb, crops.mask))
        energy = oriented_energy(
            rgb,
            mask,
            orientations=self.spec.orientations,
            signed=self.spec.signed,
            silhouette=self.spec.silhouette,
        )
        return {k: self._map(energy, cells=n) for k, n in cells.items()}

    def _map(self, energy: Float[Tensor, "n o S S"], *, cells: int) -> Float[Tensor, "n c h w"]:
        histograms = pooled(energy, cells=cells)
        return with_context(histograms, distance=self.spec.context_cells, contrast=self.spec.contrast)


def oriented_energy(
    rgb: UInt8[Tensor, "n S S 3"],
    mask: Bool[Tensor, "n S S"],
    *,
    orientations: int,
    signed: bool,
    silhouette: float,
) -> Float[Tensor, "n o S S"]:
    """Gradient magnitude (grey levels 0..1 per pixel) of every pixel, shared linearly by the two nearest orientations.

    Central differences, no smoothing, of the colour channel with the strongest gradient (Dalal and Triggs, Sec. 6.2).
    """
    image = rgb.permute(0, 3, 1, 2).float() / 255
    dx, dy = (_difference(image, axis=axis) for axis in (3, 2))
    strongest = (dx.square() + dy.square()).argmax(dim=1, keepdim=True)
    dx, dy = dx.gather(1, strongest)[:, 0], dy.gather(1, strongest)[:, 0]
    magnitude = torch.hypot(dx, dy) * torch.where(_at_border(mask), silhouette, 1.0)
    turn = 2 * math.pi if signed else math.pi
    place = torch.atan2(dy, dx).remainder(turn) * (orientations / turn)
    bins = torch.arange(orientations, device=rgb.device).view(1, -1, 1, 1)
    apart = (place[:, None] - bins).abs()
    share = 1 - torch.minimum(apart, orientations - apart)
    return share.clamp_(min=0) * magnitude[:, None]


def pooled(energy: Float[Tensor, "n o S S"], *, cells: int) -> Float[Tensor, "n o h w"]:
    """Mean energy per cell, smoothed over its neighbours by (1 2 1) / 4: windows that overlap, twice a cell wide."""
    size = energy.shape[-1]
    if size % cells:
        energy = interpolate(energy, (cells * math.ceil(size / cells),) * 2, mode="bilinear", align_corners=False)
    mean = avg_pool2d(energy, energy.shape[-1] // cells)
    kernel = torch.tensor([0.25, 0.5, 0.25], device=energy.device)
    flat = mean.flatten(0, 1)[:, None]
    flat = conv2d(conv2d(flat, kernel.view(1, 1, 1, 3), padding=(0, 1)), kernel.view(1, 1, 3, 1), padding=(1, 0))
    return flat.view_as(mean)


def with_context(histograms: Float[Tensor, "n o h w"], *, distance: int, contrast: float) -> Float[Tensor, "n c h w"]:
    """Each cell's histogram beside those of 8 neighbours, scaled to length 1 where energy exceeds ``contrast``."""
    n, _, h, w = histograms.shape
    if distance:
        histograms = unfold(histograms, 3, dilation=distance, padding=distance).view(n, -1, h, w)
    length = histograms.square().sum(1, keepdim=True)
    return histograms / (length + contrast**2).sqrt()


def _difference(image: Float[Tensor, "n 3 S S"], *, axis: int) -> Float[Tensor, "n 3 S S"]:
    sides = (1, 1, 0, 0) if axis == 3 else (0, 0, 1, 1)
    padded = pad(image, sides, mode="replicate")
    size = image.shape[axis]
    return (padded.narrow(axis, 2, size) - padded.narrow(axis, 0, size)) / 2


def _at_border(mask: Bool[Tensor, "n S S"]) -> Bool[Tensor, "n S S"]:
    """Pixels whose central difference crosses the mask's border."""
    m = pad(mask[:, None].float(), (1, 1, 1, 1), mode="replicate")[:, 0]
    cross = torch.stack([m[:, 1:-1, :-2], m[:, 1:-1, 2:], m[:, :-2, 1:-1], m[:, 2:, 1:-1], m[:, 1:-1, 1:-1]])
    return cross.amax(0) != cross.amin(0)
