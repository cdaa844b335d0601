"""A vision transformer of the transformers library: images -> tokens -> maps by block, and no block past the deepest.

The library's parts are found by their roles, since their names differ between its versions.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, conv2d, interpolate, pad

from pipeline.items.features import CLASS_TOKEN_LAYER, SALIENCY_LAYER

Facet = Literal["key", "query", "value", "token"]

_IMAGENET_MEAN, _IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
_PROJECTIONS = {"query": ("q_proj", "query"), "key": ("k_proj", "key"), "value": ("v_proj", "value")}
_FIRST_NORM = ("norm1", "layernorm_before")


def standardise(image: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n 3 H W"]:
    """Images in [0, 1] as DINO and DINOv2 were trained on them: ImageNet's mean and standard deviation."""
    mean, std = (torch.tensor(v, device=image.device).view(3, 1, 1) for v in (_IMAGENET_MEAN, _IMAGENET_STD))
    return (image - mean) / std


def pad_border(image: Float[Tensor, "n 3 S S"], *, overhang: int) -> Float[Tensor, "n 3 R R"]:
    """Images with half of ``overhang`` more pixels on each side, black as the crop stage has it outside the image.

    Half an odd number: black all the same, and the image half a pixel off, bilinear.
    """
    image = pad(image, ((overhang + 1) // 2,) * 4)
    return avg_pool2d(image, 2, stride=1) if overhang % 2 else image


def embed_patches(model: Any, image: Float[Tensor, "n 3 S S"], *, stride: int) -> Float[Tensor, "n t c"]:
    """Class token, registers where there are any, and the tokens of all patches, rows first, with their positions.

    A patch every ``stride`` pixels, so that patches overlap when it is smaller than they are (Amir et al., ECCVW 2022).
    """
    parts = model.embeddings
    kernel = parts.patch_embeddings.projection
    patches = conv2d(image, kernel.weight, kernel.bias, stride=stride)
    registers = getattr(parts, "register_tokens", None)
    positions = parts.position_embeddings
    grid = resize_positions(positions[:, 1:], cells=patches.shape[-1], antialias=registers is not None)
    first = [parts.cls_token + positions[:, :1], *([] if registers is None else [registers])]
    tokens = patches.flatten(2).transpose(1, 2) + grid
    return torch.cat([*(t.expand(len(image), -1, -1) for t in first), tokens], dim=1)


def resize_positions(positions: Float[Tensor, "1 p c"], *, cells: int, antialias: bool) -> Float[Tensor, "1 t c"]:
    """Position embeddings of ``cells`` x ``cells`` tokens: bicubic, grid edges on grid edges, in float32.

    ``antialias`` when shrinking, as DINOv2 was trained with registers (Darcet et al., ICLR 2024) and not without.
    """
    side = round(positions.shape[1] ** 0.5)
    if side == cells:
        return positions
    square = positions.float().reshape(1, side, side, -1).permute(0, 3, 1, 2)
    resized = interpolate(square, (cells, cells), mode="bicubic", align_corners=False, antialias=antialias)
    return resized.flatten(2).transpose(1, 2).to(positions.dtype)


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
    """Tokens of the given blocks, the ``skipped`` first ones (class token, registers) left out.

    Queries, keys and values are those of the block's attention, all heads side by side; "token" is its output, behind
    the model's last norm if ``norm_last``. The pseudo-layers give the class token (n 1 c) and its attention (n t 1).
    """
    blocks = find_blocks(model)
    last = len(blocks) - 1
    deepest = last if {SALIENCY_LAYER, CLASS_TOKEN_LAYER} & set(layers) else max(layers, default=-1)
    found: dict[int, Tensor] = {}
    for layer, block in enumerate(blocks[: deepest + 1]):
        if layer in layers and facet != "token":
            found[layer] = project_facet(block, tokens, facet)[:, skipped:]
        if layer == last and SALIENCY_LAYER in layers:
            found[SALIENCY_LAYER] = saliency(block, tokens, heads=saliency_heads, model=model, skipped=skipped)
        if layer == deepest and CLASS_TOKEN_LAYER not in layers and not (layer in layers and facet == "token"):
            break
        output = block(tokens)
        tokens = output if isinstance(output, Tensor) else output[0]
        if layer in layers and facet == "token":
            found[layer] = (model.layernorm(tokens) if norm_last else tokens)[:, skipped:]
    if CLASS_TOKEN_LAYER in layers:
        found[CLASS_TOKEN_LAYER] = model.layernorm(tokens[:, :1])
    return found


def find_blocks(model: nn.Module) -> nn.ModuleList:
    """The transformer's blocks, its only list of modules."""
    return next(module for module in model.modules() if isinstance(module, nn.ModuleList))


def project_facet(block: nn.Module, tokens: Float[Tensor, "n t c"], facet: str) -> Float[Tensor, "n t c"]:
    """Queries, keys or values of a block's attention, from the tokens that enter the block."""
    return part(block, _PROJECTIONS[facet])(part(block, _FIRST_NORM)(tokens))


def saliency(
    block: nn.Module, tokens: Float[Tensor, "n t c"], *, heads: Sequence[int], model: Any, skipped: int
) -> Float[Tensor, "n p 1"]:
    """The class token's attention to every patch, mean of ``heads``, from 0 (least) to 1 (most) in each image.

    Amir et al., ECCVW 2022, and their code. An image that is the same everywhere gives 0.
    """
    count = model.config.num_attention_heads
    query = project_facet(block, tokens[:, :1], "query").unflatten(-1, (count, -1))
    key = project_facet(block, tokens, "key").unflatten(-1, (count, -1))
    scores = torch.einsum("nshd,nthd->nht", query.float(), key.float()) * key.shape[-1] ** -0.5
    seen = scores.softmax(-1)[:, list(heads), skipped:].mean(1)
    least, most = seen.amin(1, keepdim=True), seen.amax(1, keepdim=True)
    relative = (seen - least) / (most - least).clamp_min(torch.finfo(torch.float32).tiny)
    return relative[..., None].to(tokens.dtype)


def part(block: nn.Module, names: Collection[str]) -> nn.Module:
    """The part of a block that has one of the names."""
    return next(module for path, module in block.named_modules() if path.rpartition(".")[2] in names)
