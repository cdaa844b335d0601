"""images -> histograms of oriented gradients per cell (Dalal and Triggs, CVPR 2005), with neighbouring cells."""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, pad

from pipeline.functional.maps import normalize_channels

ORIENTATIONS, CONTRAST = 8, 0.02
NEIGHBOURHOOD = 9  # cells whose histograms append_edges concatenates
EDGES = 12  # layer number of the edge histograms, after the decoder's 0 to 11


def edge_histograms(
    rgb: UInt8[Tensor, "n S S 3"], mask: Bool[Tensor, "n S S"], *, cells: int
) -> Float[Tensor, "n 8 h w"]:
    """Histograms of signed gradients, silhouette included, over overlapping windows of 2 x 2 cells."""
    energy = oriented_energy(rgb, mask, orientations=ORIENTATIONS, signed=True, silhouette=1.0)
    return smooth_histograms(cell_means(energy, cells=cells))


def append_edges(
    descriptors: Float[Tensor, "n d h w"], histograms: Float[Tensor, "n 8 h w"], *, weight: float
) -> Float[Tensor, "n d+72 h w"]:
    """Descriptors of length 1, concatenated with edge histograms of each cell's 3 x 3 neighbourhood.

    The histograms have length at most ``weight``, so the cosine of the result weights the descriptors' cosine by 1 and
    the histograms' by up to ``weight`` squared.
    """
    edges = append_neighbours(histograms, distance=1, contrast=CONTRAST)
    return torch.cat([normalize_channels(descriptors.float()), weight * edges], dim=1)


def oriented_energy(
    rgb: UInt8[Tensor, "n S S 3"],
    mask: Bool[Tensor, "n S S"],
    *,
    orientations: int,
    signed: bool,
    silhouette: float,
) -> Float[Tensor, "n o S S"]:
    """Gradient magnitude per pixel (grey levels 0..1 per px), split linearly between the two nearest orientations.

    Central differences without smoothing, of the colour channel with the strongest gradient (Dalal and Triggs, Sec.
    6.2). ``signed``: orientations cover 360 instead of 180 degrees. ``silhouette``: factor for gradients that cross the
    mask's border.
    """
    image = rgb.permute(0, 3, 1, 2).float()  # integer values, so that ties between channels are exact
    dx, dy = (_central_difference(image, axis=axis) for axis in (3, 2))
    length = torch.hypot(dx, dy)
    magnitude, strongest = length.max(dim=1, keepdim=True)
    dx, dy, magnitude = dx.gather(1, strongest)[:, 0], dy.gather(1, strongest)[:, 0], magnitude[:, 0]
    magnitude = magnitude / 255 * torch.where(_crosses_border(mask), silhouette, 1.0)
    period = 2 * math.pi if signed else math.pi
    bin_position = torch.atan2(dy, dx).remainder(period) * (orientations / period)
    share = bin_position.frac() * magnitude
    lower = bin_position.long() % orientations
    energy = torch.zeros(len(rgb), orientations, *mask.shape[1:], device=rgb.device)
    energy.scatter_(1, lower[:, None], (magnitude - share)[:, None])
    return energy.scatter_(1, ((lower + 1) % orientations)[:, None], share[:, None])


def cell_means(energy: Float[Tensor, "n o S S"], *, cells: int) -> Float[Tensor, "n o h w"]:
    """Mean energy per cell. A crop whose size is not a multiple of ``cells`` is first enlarged to the next multiple."""
    size = energy.shape[-1]
    if size % cells:
        size = cells * math.ceil(size / cells)
        energy = interpolate(energy, (size, size), mode="bilinear", align_corners=False)
    return avg_pool2d(energy, size // cells)


def smooth_histograms(histograms: Float[Tensor, "n o h w"]) -> Float[Tensor, "n o h w"]:
    """Histograms smoothed with (1 2 1) / 4 along both axes: windows two cells wide that overlap by half."""
    h, w = histograms.shape[2:]
    x = pad(histograms, (1, 1, 1, 1))
    x = (x.narrow(3, 0, w) + 2 * x.narrow(3, 1, w) + x.narrow(3, 2, w)) / 4
    return (x.narrow(2, 0, h) + 2 * x.narrow(2, 1, h) + x.narrow(2, 2, h)) / 4


def append_neighbours(
    histograms: Float[Tensor, "n o h w"], *, distance: int, contrast: float
) -> Float[Tensor, "n c h w"]:
    """Each cell's histogram concatenated with those of its 8 neighbours, ``distance`` cells away, and normalised.

    All are divided by sqrt(|v|^2 + ``contrast``^2), v the concatenation, so that cells without contrast stay near zero
    (L2-norm of Dalal and Triggs, Sec. 6.4). ``distance`` 0: the cell alone, c = o; otherwise c = 9 o.
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
    padding = (1, 1, 0, 0) if axis == 3 else (0, 0, 1, 1)
    padded = pad(image, padding, mode="replicate")
    size = image.shape[axis]
    return (padded.narrow(axis, 2, size) - padded.narrow(axis, 0, size)) / 2


def _crosses_border(mask: Bool[Tensor, "n S S"]) -> Bool[Tensor, "n S S"]:
    """Pixels whose central difference crosses the mask's border."""
    m = pad(mask[:, None].float(), (1, 1, 1, 1), mode="replicate")[:, 0]
    cross = torch.stack([m[:, 1:-1, :-2], m[:, 1:-1, 2:], m[:, :-2, 1:-1], m[:, 2:, 1:-1], m[:, 1:-1, 1:-1]])
    return cross.amax(0) != cross.amin(0)
