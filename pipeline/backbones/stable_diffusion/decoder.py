"""The decoder of a Stable Diffusion U-Net: its blocks, their sizes, and a pass that stops at the deepest one needed.

Block k is the k-th resnet of the decoder with its attention, counted over all up blocks in order; SD has 4 x 3 = 12.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

Hook = Literal["pre", "post", "resnet"]


class _AllCollected(Exception):
    """All requested blocks have been computed, so the rest of the U-Net can be skipped."""


def count_blocks(unet: Mapping[str, Any]) -> int:
    """Number of decoder blocks of a U-Net's config."""
    return len(unet["block_out_channels"]) * (unet["layers_per_block"] + 1)


def map_shape(unet: Mapping[str, Any], *, layer: int, hook: Hook, latent_size: int) -> tuple[int, int, int]:
    """(c, h, w) of a block's map, computed from the U-Net's config and the side of its latent."""
    channels: Sequence[int] = unet["block_out_channels"]
    coarsest = latent_size >> (len(channels) - 1)
    if hook == "pre":
        if layer == 0:
            return channels[-1], coarsest, coarsest
        return map_shape(unet, layer=layer - 1, hook="post", latent_size=latent_size)
    up_block, resnet = divmod(layer, unet["layers_per_block"] + 1)
    upsampled = hook == "post" and resnet == unet["layers_per_block"] and up_block < len(channels) - 1
    side = coarsest << (up_block + upsampled)
    return channels[-1 - up_block], side, side


def find_tapped_module(unet: Any, *, layer: int, hook: Hook) -> nn.Module:
    """The module whose output is the map of block ``layer``.

    ``pre``: the block's input before the skip connection is concatenated, i.e. the output of block ``layer`` - 1, of
    the mid block, or of the encoder where there is no mid block. ``post``: the block's output, including attention and,
    for the last resnet of an up block, the upsampler. ``resnet``: the residual branch, before the shortcut is added.
    """
    if hook == "pre":
        if layer > 0:
            return find_tapped_module(unet, layer=layer - 1, hook="post")
        return unet.mid_block if unet.mid_block is not None else unet.down_blocks[-1]
    up_block, resnet = _locate(unet, layer)
    if hook == "resnet":
        return up_block.resnets[resnet].conv2
    if resnet == len(up_block.resnets) - 1:
        return up_block
    return up_block.attentions[resnet] if hasattr(up_block, "attentions") else up_block.resnets[resnet]


def read_decoder_maps(
    unet: nn.Module,
    latent: Float[Tensor, "n c h w"],
    timestep: int,
    prompt: Float[Tensor, "1 l d"],
    *,
    layers: Sequence[int],
    hook: Hook,
) -> dict[int, Float[Tensor, "n _c _h _w"]]:
    """Maps of the given blocks from one pass of the U-Net, which stops after the deepest of them."""
    wanted = sorted(set(layers))
    maps: dict[int, Tensor] = {}

    def keep(layer: int) -> Callable[..., None]:
        def listener(_module: nn.Module, _inputs: Any, output: Any) -> None:
            maps[layer] = output if isinstance(output, Tensor) else output[0]
            if len(maps) == len(wanted):
                raise _AllCollected

        return listener

    taps = [find_tapped_module(unet, layer=k, hook=hook).register_forward_hook(keep(k)) for k in wanted]
    try:
        unet(latent, torch.tensor(timestep, device=latent.device), prompt.expand(len(latent), -1, -1))
    except _AllCollected:
        pass
    finally:
        for tap in taps:
            tap.remove()
    return maps


def _locate(unet: Any, layer: int) -> tuple[Any, int]:
    for up_block in unet.up_blocks:
        if layer < len(up_block.resnets):
            return up_block, layer
        layer -= len(up_block.resnets)
    raise IndexError(layer)
