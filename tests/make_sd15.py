"""Writes a diffusers folder of Stable Diffusion's architecture with seeded random weights: for tests, nothing learned.

    python tests/make_sd15.py FOLDER [--dtype float16] [--small] [--version 2]

Full size is that of SD 1.5 (or 2.1): 2.1 GB in float16, 4.3 GB in float32. The tokenizer has CLIP's ids for begin, end,
padding and single letters; it knows no words.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import torch

from pipeline.backbones.stable_diffusion.loading import allocate_model
from pipeline.stages.extract.random_sd import randomise_weights

VOCABULARY = 49408


def unet_config(*, small: bool, version: int) -> dict[str, Any]:
    channels = (32, 32, 64, 64) if small else (320, 640, 1280, 1280)
    return {
        "sample_size": 64,
        "block_out_channels": channels,
        "layers_per_block": 2,
        "cross_attention_dim": text_width(small=small, version=version),
        "attention_head_dim": 8 if version == 1 else [max(1, c // 64) for c in channels],
        "use_linear_projection": version == 2,
        "down_block_types": ("CrossAttnDownBlock2D",) * 3 + ("DownBlock2D",),
        "up_block_types": ("UpBlock2D",) + ("CrossAttnUpBlock2D",) * 3,
    }


def vae_config(*, small: bool) -> dict[str, Any]:
    return {
        "block_out_channels": (32, 32, 32, 64) if small else (128, 256, 512, 512),
        "layers_per_block": 1 if small else 2,
        "latent_channels": 4,
        "down_block_types": ("DownEncoderBlock2D",) * 4,
        "up_block_types": ("UpDecoderBlock2D",) * 4,
        "scaling_factor": 0.18215,
    }


def text_config(*, small: bool, version: int) -> dict[str, Any]:
    width = text_width(small=small, version=version)
    return {
        "vocab_size": VOCABULARY,
        "hidden_size": width,
        "intermediate_size": 4 * width,
        "num_hidden_layers": 2 if small else {1: 12, 2: 23}[version],
        "num_attention_heads": max(1, width // 64),
        "max_position_embeddings": 77,
        "hidden_act": {1: "quick_gelu", 2: "gelu"}[version],
    }


def text_width(*, small: bool, version: int) -> int:
    return 32 if small else {1: 768, 2: 1024}[version]


def write_folder(
    root: Path,
    *,
    small: bool = True,
    version: int = 1,
    dtype: str = "float32",
    seed: int = 0,
    blank: bool = False,
    unet: Mapping[str, Any] = MappingProxyType({}),
) -> Path:
    """The folder, with full-precision file names for any dtype.

    ``blank``: zero weights, since a billion random numbers take seconds. ``unet``: fields of its config that differ.
    """
    from diffusers import AutoencoderKL, DDIMScheduler, UNet2DConditionModel

    torch_dtype = getattr(torch, dtype)
    for part, cls, config in (
        ("unet", UNet2DConditionModel, unet_config(small=small, version=version) | dict(unet)),
        ("vae", AutoencoderKL, vae_config(small=small)),
    ):
        model = allocate_model(cls, config, torch_dtype)
        (clear_weights(model) if blank else randomise_weights(model, seed=seed)).save_pretrained(root / part)
    text = text_config(small=small, version=version)
    write_text_encoder(root / "text_encoder", text, seed=seed, dtype=torch_dtype, blank=blank)
    write_tokenizer(root / "tokenizer", padding={1: "<|endoftext|>", 2: "!"}[version])
    DDIMScheduler(beta_start=0.00085, beta_end=0.012, beta_schedule="scaled_linear").save_pretrained(root / "scheduler")
    return root


def write_text_encoder(
    folder: Path, config: dict[str, Any], *, seed: int, dtype: torch.dtype, blank: bool = False
) -> None:
    from transformers import CLIPTextConfig, CLIPTextModel

    torch.manual_seed(seed)
    if blank:
        with torch.device("meta"):
            model = CLIPTextModel(CLIPTextConfig(**config)).to(dtype)
        clear_weights(model.to_empty(device="cpu")).save_pretrained(folder)
    else:
        CLIPTextModel(CLIPTextConfig(**config)).to(dtype).save_pretrained(folder)


def clear_weights(model: torch.nn.Module) -> torch.nn.Module:
    """The model with all weights and buffers zero."""
    with torch.no_grad():
        for values in (*model.parameters(), *model.buffers()):
            values.zero_()
    return model


def write_tokenizer(folder: Path, *, padding: str) -> None:
    printable = [*range(ord("!"), ord("~") + 1), *range(0xA1, 0xAD), *range(0xAE, 0x100)]
    letters = [chr(b) for b in printable] + [chr(256 + i) for i in range(256 - len(printable))]
    tokens = [*letters, *(f"{x}</w>" for x in letters)]
    tokens += [f"unused{i}" for i in range(VOCABULARY - 2 - len(tokens))] + ["<|startoftext|>", "<|endoftext|>"]
    folder.mkdir(parents=True)
    (folder / "vocab.json").write_text(json.dumps({token: i for i, token in enumerate(tokens)}))
    (folder / "merges.txt").write_text("#version: 0.2\n")
    special = {"bos_token": "<|startoftext|>", "eos_token": "<|endoftext|>", "unk_token": "<|endoftext|>"}
    config = special | {"pad_token": padding, "model_max_length": 77, "tokenizer_class": "CLIPTokenizer"}
    (folder / "tokenizer_config.json").write_text(json.dumps(config))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--dtype", choices=("float16", "float32"), default="float16")
    parser.add_argument("--small", action="store_true", help="20 MB, the same blocks")
    parser.add_argument("--version", type=int, choices=(1, 2), default=1, help="of Stable Diffusion")
    given = parser.parse_args()
    write_folder(given.folder, small=given.small, version=given.version, dtype=given.dtype)
