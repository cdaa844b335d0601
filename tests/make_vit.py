"""Writes a folder as transformers' save_pretrained does, with seeded random weights: for tests, nothing learned.

Names of tensors and config are those of the hub's checkpoints, for any installed version of transformers.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file

from pipeline.stages.extract.random_sd import draw_gaussian

WIDTH, HEADS = 48, 6
PATCH = {"vit": 8, "dinov2": 14, "dinov2_with_registers": 14}
CLASS = {"vit": "ViTModel", "dinov2": "Dinov2Model", "dinov2_with_registers": "Dinov2WithRegistersModel"}
REGISTERS = 4


def write_vit(root: Path, model_type: str = "vit", *, depth: int = 12, grid: int = 4, seed: int = 0) -> Path:
    """``grid``: side of the position embeddings."""
    root.mkdir(parents=True)
    (root / "config.json").write_text(json.dumps(config(model_type, depth=depth, grid=grid)))
    shapes = tensor_shapes(model_type, depth=depth, grid=grid)
    save_file({name: _drawn(name, shape, seed) for name, shape in shapes.items()}, root / "model.safetensors")
    return root


def config(model_type: str, *, depth: int, grid: int) -> dict[str, Any]:
    common = {
        "architectures": [CLASS[model_type]],
        "model_type": model_type,
        "hidden_size": WIDTH,
        "num_hidden_layers": depth,
        "num_attention_heads": HEADS,
        "hidden_act": "gelu",
        "image_size": grid * PATCH[model_type],
        "patch_size": PATCH[model_type],
        "num_channels": 3,
        "qkv_bias": True,
        "layer_norm_eps": 1e-6,
    }
    if model_type == "vit":
        return common | {"intermediate_size": 2 * WIDTH}
    return common | {"mlp_ratio": 2} | ({"num_register_tokens": REGISTERS} if "registers" in model_type else {})


def tensor_shapes(model_type: str, *, depth: int, grid: int) -> dict[str, tuple[int, ...]]:
    patch, c = PATCH[model_type], WIDTH
    shapes: dict[str, tuple[int, ...]] = {
        "embeddings.cls_token": (1, 1, c),
        "embeddings.position_embeddings": (1, 1 + grid**2, c),
        "embeddings.patch_embeddings.projection.weight": (c, 3, patch, patch),
        "embeddings.patch_embeddings.projection.bias": (c,),
        "layernorm.weight": (c,),
        "layernorm.bias": (c,),
    }
    if model_type != "vit":
        shapes["embeddings.mask_token"] = (1, c)
    if "registers" in model_type:
        shapes["embeddings.register_tokens"] = (1, REGISTERS, c)
    norms = ("layernorm_before", "layernorm_after") if model_type == "vit" else ("norm1", "norm2")
    mlp = ("intermediate.dense", "output.dense") if model_type == "vit" else ("mlp.fc1", "mlp.fc2")
    for i in range(depth):
        block = f"encoder.layer.{i}."
        linear = {f"attention.attention.{facet}": (c, c) for facet in ("query", "key", "value")}
        linear |= {"attention.output.dense": (c, c), mlp[0]: (2 * c, c), mlp[1]: (c, 2 * c)}
        for name, shape in linear.items():
            shapes |= {f"{block}{name}.weight": shape, f"{block}{name}.bias": shape[:1]}
        for name in norms:
            shapes |= {f"{block}{name}.weight": (c,), f"{block}{name}.bias": (c,)}
        if model_type != "vit":
            shapes |= {f"{block}layer_scale{k}.lambda1": (c,) for k in (1, 2)}
    return shapes


def write_dinov3(root: Path, *, depth: int = 3, gated: bool = False, seed: int = 0) -> Path:
    """DINOv3 in the layout of the hub: blocks are named ``layer.k``, queries and values have biases, keys have none."""
    c = WIDTH
    shapes: dict[str, tuple[int, ...]] = {
        "embeddings.cls_token": (1, 1, c),
        "embeddings.mask_token": (1, 1, c),
        "embeddings.register_tokens": (1, REGISTERS, c),
        "embeddings.patch_embeddings.weight": (c, 3, 16, 16),
        "embeddings.patch_embeddings.bias": (c,),
        "norm.weight": (c,),
        "norm.bias": (c,),
    }
    for i in range(depth):
        block = f"layer.{i}."
        linear = {f"attention.{x}_proj": (c, c) for x in "qkvo"} | {
            "mlp.up_proj": (2 * c, c),
            "mlp.down_proj": (c, 2 * c),
        }
        linear |= {"mlp.gate_proj": (2 * c, c)} if gated else {}
        for name, shape in linear.items():
            shapes |= {f"{block}{name}.weight": shape} | (
                {} if "k_proj" in name else {f"{block}{name}.bias": shape[:1]}
            )
        shapes |= {f"{block}{name}": (c,) for name in ("norm1.weight", "norm1.bias", "norm2.weight", "norm2.bias")}
        shapes |= {f"{block}layer_scale{k}.lambda1": (c,) for k in (1, 2)}
    fields = {
        "architectures": ["DINOv3ViTModel"], "model_type": "dinov3_vit", "hidden_size": c, "intermediate_size": 2 * c,
        "num_hidden_layers": depth, "num_attention_heads": HEADS, "num_register_tokens": REGISTERS, "patch_size": 16,
        "image_size": 224, "hidden_act": "silu" if gated else "gelu", "layer_norm_eps": 1e-5, "rope_theta": 100.0,
        "query_bias": True, "key_bias": False, "value_bias": True, "proj_bias": True, "mlp_bias": True,
        "use_gated_mlp": gated,
    }  # fmt: skip
    root.mkdir(parents=True)
    (root / "config.json").write_text(json.dumps(fields))
    save_file({name: _drawn(name, shape, seed) for name, shape in shapes.items()}, root / "model.safetensors")
    return root


def _drawn(name: str, shape: tuple[int, ...], seed: int) -> torch.Tensor:
    drawn = draw_gaussian(name, shape, seed=seed)
    if name.endswith(("lambda1", "norm.weight", "norm1.weight", "norm2.weight", "before.weight", "after.weight")):
        return 1 + 0.1 * drawn
    # matrices keep the size of activations; attention that differs from patch to patch has scores beyond 1
    return drawn * 2 / math.prod(shape[1:]) ** 0.5 if len(shape) > 1 and name.endswith("weight") else 0.3 * drawn
