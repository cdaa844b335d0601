"""images -> histograms of oriented gradients by cell (Dalal and Triggs, CVPR 2005), with those of the cells around."""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, normalize, pad

ORIENTATIONS, CONTRAST = 8, 0.02
EDGES = 12  # the layer of edge histograms: past the decoder's 0 to 11


def edge_histograms(
    rgb: UInt8[Tensor, "n S S 3"], mask: Bool[Tensor, "n S S"], *, cells: int
) -> Float[Tensor, "n 8 h w"]:
    """Histograms of signed gradients, the mask's border among them, in overlapping windows of two cells a side."""
    energy = oriented_energy(rgb, mask, orientations=ORIENTATIONS, signed=True, silhouette=1.0)
    return smooth_histograms(cell_means(energy, cells=cells))


def append_edges(
    descriptors: Float[Tensor, "n d h w"], histograms: Float[Tensor, "n 8 h w"], *, weight: float
) -> Float[Tensor, "n d+72 h w"]:
    """Descriptors at length 1, beside the histograms of each cell and its neighbours at length ``weight`` or less.

    Cosines of the whole are means of both cosines, weighted by 1 and ``weight`` squared.
    """
    edges = append_neighbours(histograms, distance=1, contrast=CONTRAST)
    return torch.cat([normalize(descriptors.float(), dim=1), weight * edges], dim=1)


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
    dx, dy = (_central_difference(image, axis=axis) for axis in (3, 2))
    length = torch.hypot(dx, dy)
    magnitude, strongest = length.max(dim=1, keepdim=True)
    dx, dy, magnitude = dx.gather(1, strongest)[:, 0], dy.gather(1, strongest)[:, 0], magnitude[:, 0]
    magnitude = magnitude / 255 * torch.where(_crosses_border(mask), silhouette, 1.0)
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


def smooth_histograms(histograms: Float[Tensor, "n o h w"]) -> Float[Tensor, "n o h w"]:
    """Weighted (1 2 1) / 4 with the neighbours along both axes: windows twice a cell wide that overlap by half."""
    h, w = histograms.shape[2:]
    x = pad(histograms, (1, 1, 1, 1))
    x = (x.narrow(3, 0, w) + 2 * x.narrow(3, 1, w) + x.narrow(3, 2, w)) / 4
    return (x.narrow(2, 0, h) + 2 * x.narrow(2, 1, h) + x.narrow(2, 2, h)) / 4


def append_neighbours(
    histograms: Float[Tensor, "n o h w"], *, distance: int, contrast: float
) -> Float[Tensor, "n c h w"]:
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


def _central_difference(image: Float[Tensor, "n 3 S S"], *, axis: int) -> Float[Tensor, "n 3 S S"]:
    sides = (1, 1, 0, 0) if axis == 3 else (0, 0, 1, 1)
    padded = pad(image, sides, mode="replicate")
    size = image.shape[axis]
    return (padded.narrow(axis, 2, size) - padded.narrow(axis, 0, size)) / 2


def _crosses_border(mask: Bool[Tensor, "n S S"]) -> Bool[Tensor, "n S S"]:
    """Pixels whose central difference crosses the mask's border."""
    m = pad(mask[:, None].float(), (1, 1, 1, 1), mode="replicate")[:, 0]
    cross = torch.stack([m[:, 1:-1, :-2], m[:, 1:-1, 2:], m[:, :-2, 1:-1], m[:, 2:, 1:-1], m[:, 1:-1, 1:-1]])
    return cross.amax(0) != cross.amin(0)
