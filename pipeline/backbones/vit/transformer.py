"""A vision transformer of the transformers library: images -> tokens -> maps of blocks, up to the deepest one needed.

Submodules are looked up by any of their known names, because transformers renames them between versions.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, conv2d, interpolate, pad

from pipeline.items.features import CLASS_FACET_LAYER, CLASS_TOKEN_LAYER, SALIENCY_LAYER

Facet = Literal["key", "query", "value", "token"]

_IMAGENET_MEAN, _IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
_PROJECTIONS = {"query": ("q_proj", "query"), "key": ("k_proj", "key"), "value": ("v_proj", "value")}
_FIRST_NORM = ("norm1", "layernorm_before")


def standardise(image: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n 3 H W"]:
    """Normalise images in [0, 1] by ImageNet's mean and standard deviation, as DINO and DINOv2 were trained."""
    mean, std = (torch.tensor(v, device=image.device).view(3, 1, 1) for v in (_IMAGENET_MEAN, _IMAGENET_STD))
    return (image - mean) / std


def pad_border(image: Float[Tensor, "n 3 S S"], *, overhang: int) -> Float[Tensor, "n 3 R R"]:
    """Pad images with ``overhang`` / 2 black pixels on each side, the colour that crops have outside the image.

    If ``overhang`` is odd, the image is shifted by half a pixel with bilinear interpolation.
    """
    image = pad(image, ((overhang + 1) // 2,) * 4)
    return avg_pool2d(image, 2, stride=1) if overhang % 2 else image


def embed_patches(model: Any, image: Float[Tensor, "n 3 S S"], *, stride: int) -> Float[Tensor, "n t c"]:
    """Class token, registers if the model has any, and patch tokens in row-major order, with position embeddings.

    Patches overlap where ``stride`` (px) is smaller than a patch (Amir et al., ECCVW 2022).
    """
    parts = model.embeddings
    kernel = getattr(parts.patch_embeddings, "projection", parts.patch_embeddings)
    patches = conv2d(image, kernel.weight, kernel.bias, stride=stride)
    registers = getattr(parts, "register_tokens", None)
    positions = getattr(parts, "position_embeddings", None)
    if positions is None:  # the blocks rotate queries and keys instead
        unplaced = (parts.cls_token, parts.register_tokens, patches.flatten(2).transpose(1, 2))
        return torch.cat([t.expand(len(image), -1, -1) for t in unplaced], dim=1)
    grid = resize_positions(positions[:, 1:], cells=patches.shape[-1], antialias=registers is not None)
    first = [parts.cls_token + positions[:, :1], *([] if registers is None else [registers])]
    tokens = patches.flatten(2).transpose(1, 2) + grid
    return torch.cat([*(t.expand(len(image), -1, -1) for t in first), tokens], dim=1)


def resize_positions(positions: Float[Tensor, "1 p c"], *, cells: int, antialias: bool) -> Float[Tensor, "1 t c"]:
    """Position embeddings of ``cells`` x ``cells`` tokens: bicubic in float32, edges of both grids aligned.

    ``antialias``: when shrinking; DINOv2 was trained so with registers (Darcet et al., ICLR 2024), but not without.
    """
    side = round(positions.shape[1] ** 0.5)
    if side == cells:
        return positions
    square = positions.float().reshape(1, side, side, -1).permute(0, 3, 1, 2)
    resized = interpolate(square, (cells, cells), mode="bicubic", align_corners=False, antialias=antialias)
    return resized.flatten(2).transpose(1, 2).to(positions.dtype)


Rotation = tuple[Float[Tensor, "p d"], Float[Tensor, "p d"]]
"""Cosines and sines by which DINOv3's attention rotates each head's queries and keys of the patches (RoPE)."""


def rotate_patches(model: Any, tokens: Float[Tensor, "n t c"], *, skipped: int) -> Rotation | None:
    """The rotation of a square of patches, each at its cell's centre in [-1, 1]; None for a model without."""
    rope = getattr(model, "rope_embeddings", None)
    if rope is None:
        return None
    side = round((tokens.shape[1] - skipped) ** 0.5) * int(model.config.patch_size)
    cos, sin = rope(tokens.new_empty(1, 1, side, side))
    return cos, sin


def read_block_tokens(
    model: Any,
    tokens: Float[Tensor, "n t c"],
    *,
    layers: Collection[int],
    facet: Facet,
    norm_last: bool,
    saliency_heads: Sequence[int],
    skipped: int,
) -> dict[int, Float[Tensor, "n _t _c"]]:
    """Tokens of the given blocks without the first ``skipped`` ones (class token, registers).

    Queries, keys and values are those of the block's attention before any rotation, with all heads concatenated;
    "token" is the block's output, after the model's last norm if ``norm_last``. Pseudo-layers: the class token (n 1 c),
    its attention (n t 1), and its query, key or value in the last block (n 1 c).
    """
    blocks = find_blocks(model)
    last = len(blocks) - 1
    deepest = last if min(layers, default=0) < 0 else max(layers, default=-1)
    rotation = rotate_patches(model, tokens, skipped=skipped)
    rotated = {} if rotation is None else {"position_embeddings": rotation}
    found: dict[int, Tensor] = {}
    for layer, block in enumerate(blocks[: deepest + 1]):
        if layer in layers and facet != "token":
            found[layer] = project_facet(block, tokens, facet)[:, skipped:]
        if layer == last and CLASS_FACET_LAYER in layers:
            found[CLASS_FACET_LAYER] = project_facet(block, tokens[:, :1], facet)
        if layer == last and SALIENCY_LAYER in layers:
            found[SALIENCY_LAYER] = class_attention(
                block, tokens, heads=saliency_heads, model=model, skipped=skipped, rotation=rotation
            )
        if layer == deepest and CLASS_TOKEN_LAYER not in layers and not (layer in layers and facet == "token"):
            break
        output = block(tokens, **rotated)
        tokens = output if isinstance(output, Tensor) else output[0]
        if layer in layers and facet == "token":
            found[layer] = (find_last_norm(model)(tokens) if norm_last else tokens)[:, skipped:]
    if CLASS_TOKEN_LAYER in layers:
        found[CLASS_TOKEN_LAYER] = find_last_norm(model)(tokens[:, :1])
    return found


def find_blocks(model: nn.Module) -> nn.ModuleList:
    """The transformer's blocks: its only ModuleList."""
    return next(module for module in model.modules() if isinstance(module, nn.ModuleList))


def find_last_norm(model: Any) -> nn.Module:
    """The norm after the last block."""
    norm: nn.Module = getattr(model, "layernorm", None) or model.norm
    return norm


def project_facet(block: nn.Module, tokens: Float[Tensor, "n t c"], facet: str) -> Float[Tensor, "n t c"]:
    """Queries, keys or values of a block's attention, computed from the block's input tokens."""
    return find_submodule(block, _PROJECTIONS[facet])(find_submodule(block, _FIRST_NORM)(tokens))


def class_attention(
    block: nn.Module,
    tokens: Float[Tensor, "n t c"],
    *,
    heads: Sequence[int],
    model: Any,
    skipped: int,
    rotation: Rotation | None,
) -> Float[Tensor, "n p 1"]:
    """Saliency: the class token's attention to every patch, averaged over ``heads``, scaled to [0, 1] in each image.

    Amir et al., ECCVW 2022, and their code. A uniform image gives 0.
    """
    count = model.config.num_attention_heads
    query = project_facet(block, tokens[:, :1], "query").unflatten(-1, (count, -1))
    key = project_facet(block, tokens, "key").unflatten(-1, (count, -1))
    if rotation is not None:
        cos, sin = (value[:, None] for value in rotation)
        first, second = key[:, skipped:].chunk(2, dim=-1)
        turned = key[:, skipped:] * cos + torch.cat([-second, first], dim=-1) * sin
        key = torch.cat([key[:, :skipped], turned], dim=1)
    scores = torch.einsum("nshd,nthd->nht", query.float(), key.float()) * key.shape[-1] ** -0.5
    attention = scores.softmax(-1)[:, list(heads), skipped:].mean(1)
    low, high = attention.amin(1, keepdim=True), attention.amax(1, keepdim=True)
    relative = (attention - low) / (high - low).clamp_min(torch.finfo(torch.float32).tiny)
    return relative[..., None].to(tokens.dtype)


def find_submodule(block: nn.Module, names: Collection[str]) -> nn.Module:
    """The submodule of a block that has one of the names."""
    return next(module for path, module in block.named_modules() if path.rpartition(".")[2] in names)
