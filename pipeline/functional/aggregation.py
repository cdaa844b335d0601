"""Feature maps of several layers -> one descriptor per cell, by a small trained network."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import gelu, interpolate, pixel_shuffle


class Aggregation(nn.Module):
    """Layer aggregation: normalise each cell, project each layer linearly, upsample, add, then one residual MLP.

    Follows Luo et al., "Diffusion Hyperfeatures", NeurIPS 2023, with one timestep and one matrix per layer instead of
    a bottleneck. The output is upsampled by 2 with a sub-pixel convolution (Shi et al., CVPR 2016) that learns the
    residual to bilinear interpolation. ``channels``: layer -> its number of channels; ``dim``: channels of the output.
    """

    def __init__(self, channels: Mapping[int, int], dim: int) -> None:
        super().__init__()
        self.channels = dict(channels)
        self.layers = tuple(channels)
        self.mix = nn.ModuleList([nn.Conv2d(channels[layer], dim, 1) for layer in self.layers])
        self.widen, self.narrow = nn.Conv2d(dim, 2 * dim, 1), nn.Conv2d(2 * dim, dim, 1)
        self.split = nn.Conv2d(dim, 4 * dim, 3, padding=1)

    def forward(self, maps: Mapping[int, Float[Tensor, "n _c _h _w"]]) -> Float[Tensor, "n d H W"]:
        """Descriptors at twice the resolution of the finest layer, not normalised."""
        cells = max(maps[layer].shape[-1] for layer in self.layers)
        total = self._mix_layers(maps, self.layers, cells)
        total = total + self.narrow(gelu(self.widen(total)))
        smooth = interpolate(total, scale_factor=2, mode="bilinear", align_corners=False)
        return smooth + pixel_shuffle(self.split(gelu(total)), 2)

    def _mix_layers(self, maps: Mapping[int, Tensor], layers: Sequence[int], cells: int) -> Tensor:
        """Sum of the projected layers at ``cells`` x ``cells``."""
        total: Tensor | None = None
        for layer, mix in zip(layers, self.mix, strict=True):
            x = maps[layer]
            x = mix(x * torch.rsqrt(x.square().mean(dim=1, keepdim=True) + 1e-4))
            if x.shape[-1] != cells:
                x = interpolate(x, size=(cells, cells), mode="bilinear", align_corners=False)
            total = x if total is None else total + x
        assert total is not None
        return total
