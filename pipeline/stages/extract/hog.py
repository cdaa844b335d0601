"""crops -> histograms of oriented gradients: a control without weights (Dalal and Triggs, CVPR 2005)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, pad

from pipeline.items.features import FeatureMaps
from pipeline.items.views import Crops
from pipeline.spec import Fraction, NonNegative, Positive, PositiveFloat, Runtime, Spec, spec
from pipeline.stages.extract.fitting import Footprint, fitting_batch, maps_bytes
from pipeline.stages.extract.grid import CELLS, cells_of

_CROP_PX = 256  # a batch is sized for crops of this side


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
    signed: bool = True
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

    def footprint(self, layers: Sequence[int], crop_size: int, device: str = "cpu") -> Footprint:
        """As fitting.Sized: gradients of three channels, energies by orientation, and the maps with their context."""
        maps = 2 * maps_bytes([self.feature_shape(layer) for layer in layers])
        return Footprint(0, 0, 4 * (28 + 3 * self.orientations) * crop_size**2 + maps, most=32)

    def load(self, runtime: Runtime) -> HogBackbone:
        """Nothing to load."""
        return HogBackbone(self, runtime)


class HogBackbone:
    """A Hog spec on a device."""

    def __init__(self, spec: Hog, runtime: Runtime) -> None:
        self.spec, self.device = spec, torch.device(runtime.torch_device())
        footprint = spec.footprint(tuple(CELLS), _CROP_PX)
        self.batch = runtime.batch or fitting_batch(footprint, runtime, self.device)

    @torch.no_grad()
    def __call__(self, crops: Crops, layers: Sequence[int]) -> FeatureMaps:
        """Maps of the given layers, float32."""
        cells = {layer: cells_of(layer) for layer in layers}
        rgb, mask = (torch.from_numpy(np.ascontiguousarray(x)).to(self.device) for x in (crops.rgb, crops.mask))
        s = self.spec
        energy = oriented_energy(rgb, mask, orientations=s.orientations, signed=s.signed, silhouette=s.silhouette)
        # always through the finest cells: a layer has the same bytes whichever others are asked for
        finest = cell_means(energy, cells=max(CELLS.values()))
        return {k: self._map(cell_means(finest, cells=n)) for k, n in cells.items()}

    def _map(self, histograms: Float[Tensor, "n o h w"]) -> Float[Tensor, "n c h w"]:
        return with_context(smoothed(histograms), distance=self.spec.context_cells, contrast=self.spec.contrast)


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
    image = rgb.permute(0, 3, 1, 2).float()  # whole numbers: two channels that tie do so exactly
    dx, dy = (_difference(image, axis=axis) for axis in (3, 2))
    length = torch.hypot(dx, dy)
    magnitude, strongest = length.max(dim=1, keepdim=True)
    dx, dy, magnitude = dx.gather(1, strongest)[:, 0], dy.gather(1, strongest)[:, 0], magnitude[:, 0]
    magnitude = magnitude / 255 * torch.where(_at_border(mask), silhouette, 1.0)
    turn = 2 * math.pi if signed else math.pi
    place = torch.atan2(dy, dx).remainder(turn) * (orientations / turn)
    share = place.frac() * magnitude
    lower = place.long() % orientations
    energy = torch.zeros(len(rgb), orientations, *mask.shape[1:], device=rgb.device)
    energy.scatter_(1, lower[:, None], (magnitude - share)[:, None])
    return energy.scatter_(1, ((lower + 1) % orientations)[:, None], share[:, None])


def cell_means(energy: Float[Tensor, "n o S S"], *, cells: int) -> Float[Tensor, "n o h w"]:
    """Mean energy per cell; a crop whose side is no multiple of the cells is enlarged to one first."""
    size = energy.shape[-1]
    if size % cells:
        size = cells * math.ceil(size / cells)
        energy = interpolate(energy, (size, size), mode="bilinear", align_corners=False)
    return avg_pool2d(energy, size // cells)


def smoothed(histograms: Float[Tensor, "n o h w"]) -> Float[Tensor, "n o h w"]:
    """Weighted (1 2 1) / 4 with the neighbours along both axes: windows twice a cell wide that overlap by half."""
    h, w = histograms.shape[2:]
    x = pad(histograms, (1, 1, 1, 1))
    x = (x.narrow(3, 0, w) + 2 * x.narrow(3, 1, w) + x.narrow(3, 2, w)) / 4
    return (x.narrow(2, 0, h) + 2 * x.narrow(2, 1, h) + x.narrow(2, 2, h)) / 4


def with_context(histograms: Float[Tensor, "n o h w"], *, distance: int, contrast: float) -> Float[Tensor, "n c h w"]:
    """Each cell's histogram beside those of 8 neighbours, all scaled by one number to a length of 1 where energy is.

    The length is sqrt(energy^2 + ``contrast``^2): flat cells stay near zero (L2 norm of Dalal and Triggs, Sec. 6.4).
    """
    h, w = histograms.shape[2:]
    x = pad(histograms, (distance,) * 4)
    steps = (0, distance, 2 * distance) if distance else (0,)
    shifts = [(i, j) for i in steps for j in steps]
    energy = x.square().sum(1, keepdim=True)
    energy = torch.stack([energy[:, :, i : i + h, j : j + w] for i, j in shifts]).sum(0)
    x = torch.cat([x[:, :, i : i + h, j : j + w] for i, j in shifts], dim=1)
    return x.mul_((energy + contrast**2).rsqrt())


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
