"""One .safetensors file in the layout of CompVis and Stability; its configs are inferred from tensor shapes."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Int
from torch import Tensor

from pipeline.backbones.stable_diffusion.configs import alphas_cumprod, check_latents
from pipeline.backbones.stable_diffusion.features import DiffusionConfigs
from pipeline.backbones.stable_diffusion.identity import Part
from pipeline.backbones.stable_diffusion.loading import Stored, read_tensors, tokenize_empty_prompt
from pipeline.backbones.stable_diffusion.weights import Weights
from pipeline.errors import BadInput
from pipeline.io.checkpoints import check_missing, tensor_shapes

Shapes = Mapping[str, tuple[int, ...]]

_UNET, _VAE = "model.diffusion_model.", "first_stage_model."
_CLIP, _OPEN_CLIP = "cond_stage_model.transformer.", "cond_stage_model.model."
_HEADS_SD1 = 8  # SD 1.x: 8 heads on every level (v1-inference.yaml, num_heads)
_HEAD_WIDTH_SD2 = 64  # SD 2.x: heads of 64 channels (v2-inference.yaml, num_head_channels)
_CLIP_HEAD_WIDTH = 64  # of every text encoder of CLIP and OpenCLIP
_OPEN_CLIP_NAMES = {
    "ln_1": "layer_norm1",
    "ln_2": "layer_norm2",
    "mlp.c_fc": "mlp.fc1",
    "mlp.c_proj": "mlp.fc2",
    "attn.out_proj": "self_attn.out_proj",
}


@dataclass(frozen=True)
class SingleFile(Weights):
    """U-Net, VAE and text encoder in one file; see Weights."""

    path: Path

    @property
    def files(self) -> dict[str, Path]:
        """The file itself."""
        return {"model.safetensors": self.path}

    @cached_property
    def shapes(self) -> Shapes:
        """Shapes by tensor name. Raises BadInput for a file that is not in the original layout."""
        shapes = tensor_shapes(self.path)
        for prefix in (_UNET, _VAE, "cond_stage_model."):
            if not any(name.startswith(prefix) for name in shapes):
                needed = "a whole Stable Diffusion 1.x or 2.x checkpoint in the original layout"
                raise BadInput(self.path, found=f"no tensor {prefix}*", needed=needed)
        return shapes

    def read_configs(self) -> DiffusionConfigs:
        """Configs inferred from the shapes; the noise schedule is Stable Diffusion's."""
        try:
            unet, vae = unet_config(select_prefix(self.shapes, _UNET)), vae_config(select_prefix(self.shapes, _VAE))
        except KeyError as error:
            needed = "the tensors of Stable Diffusion 1.x or 2.x"
            raise BadInput(self.path, found=f"no tensor {error.args[0]}", needed=needed) from None
        if "label_emb.0.0.weight" in select_prefix(self.shapes, _UNET):
            raise BadInput(self.path, found=f"{_UNET}label_emb", needed="Stable Diffusion 1.x or 2.x, not XL")
        check_latents(unet, vae, self.path)
        return DiffusionConfigs(unet, vae, alphas_cumprod({}))

    def read_config(self, part: Part | str) -> dict[str, Any]:
        """See Weights: inferred from the shapes; {} for the scheduler, which is Stable Diffusion's."""
        if part in ("unet", "vae"):
            configs = self.read_configs()
            return dict(configs.unet if part == "unet" else configs.vae)
        return self._read_text_config() if part == "text_encoder" else {}

    def config_place(self, part: Part) -> Path:
        """See Weights."""
        return self.path

    def read_tensors(self, part: Part, wanted: Mapping[str, Tensor]) -> Iterator[Stored]:
        """See Weights."""
        from diffusers.loaders.single_file_utils import convert_ldm_unet_checkpoint, convert_ldm_vae_checkpoint

        if part == "unet":
            # names in place of tensors: the converter of a U-Net only renames
            stored = {n: n for n in self.shapes if n.startswith(_UNET)}
            renamed = convert_ldm_unet_checkpoint(stored, self.read_config(part))
            yield from read_tensors([self.path], wanted, {stored: name for name, stored in renamed.items()}.get)
            return
        state = (
            convert_ldm_vae_checkpoint(self._read(_VAE), self.read_config(part))
            if part == "vae"
            else self._convert_text(self._read(self._text_prefix))
        )
        check_missing(sorted(wanted.keys() - state.keys()), self.path)
        for name in wanted:
            yield name, state[name], f"{self.path}, tensor {name}"

    def tokenize(self, text: str) -> Int[Tensor, "1 l"]:
        """See Weights. Such a file has no tokenizer, so only the empty text is possible."""
        length = self._read_text_config()["max_position_embeddings"]
        return tokenize_empty_prompt(text, self.path, open_clip=self._is_open_clip, length=length)

    @property
    def _is_open_clip(self) -> bool:
        return any(name.startswith(_OPEN_CLIP) for name in self.shapes)

    @property
    def _text_prefix(self) -> str:
        return _OPEN_CLIP if self._is_open_clip else _CLIP

    def _read_text_config(self) -> dict[str, Any]:
        shapes = select_prefix(self.shapes, self._text_prefix)
        state = self._convert_text({name: torch.empty(shape, device="meta") for name, shape in shapes.items()})
        try:
            return text_config({name: tuple(t.shape) for name, t in state.items()}, open_clip=self._is_open_clip)
        except KeyError as error:
            raise self._lacks(error) from None

    def _convert_text(self, state: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The text encoder's tensors with transformers' names."""
        try:
            return convert_open_clip(state) if self._is_open_clip else _strip_wrapper(state)
        except KeyError as error:
            raise self._lacks(error) from None

    def _lacks(self, error: KeyError) -> BadInput:
        needed = "the text encoder of CLIP or OpenCLIP"
        return BadInput(self.path, found=f"no tensor {error.args[0]}", needed=needed)

    def _read(self, prefix: str) -> dict[str, Tensor]:
        """Tensors whose names start with a prefix, by the rest of their name; of the VAE by the whole name."""
        from safetensors import safe_open

        kept = "" if prefix == _VAE else prefix  # diffusers' converter looks for the VAE's prefix itself
        with safe_open(str(self.path), framework="pt") as tensors:
            return {n.removeprefix(kept): tensors.get_tensor(n) for n in self.shapes if n.startswith(prefix)}


def select_prefix(shapes: Shapes, prefix: str) -> Shapes:
    """Shapes of the tensors whose name starts with a prefix, by the rest of their name."""
    return {name.removeprefix(prefix): shape for name, shape in shapes.items() if name.startswith(prefix)}


def unet_config(shapes: Shapes) -> dict[str, Any]:
    """Config of a UNet2DConditionModel; each level of its input blocks is some resnets, then a downsampler."""
    levels: list[list[int]] = [[]]
    attends: list[bool] = [False]
    for block in range(1, 1 + _highest(shapes, r"input_blocks\.(\d+)\.")):
        if f"input_blocks.{block}.0.op.weight" in shapes:
            levels.append([])
            attends.append(False)
        else:
            levels[-1].append(shapes[f"input_blocks.{block}.0.in_layers.2.weight"][0])
            attends[-1] |= f"input_blocks.{block}.1.norm.weight" in shapes
    channels = [level[-1] for level in levels]
    middle = "middle_block.1.transformer_blocks.0.attn2.to_k.weight"
    linear = len(shapes["middle_block.1.proj_in.weight"]) == 2
    return {
        "_class_name": "UNet2DConditionModel",
        "in_channels": shapes["input_blocks.0.0.weight"][1],
        "out_channels": shapes["out.2.weight"][0],
        "block_out_channels": channels,
        "layers_per_block": len(levels[0]),
        "cross_attention_dim": shapes[middle][1],
        "use_linear_projection": linear,
        "attention_head_dim": [max(1, c // _HEAD_WIDTH_SD2) for c in channels] if linear else _HEADS_SD1,
        "down_block_types": ["CrossAttnDownBlock2D" if a else "DownBlock2D" for a in attends],
        "up_block_types": ["CrossAttnUpBlock2D" if a else "UpBlock2D" for a in reversed(attends)],
    }


def vae_config(shapes: Shapes) -> dict[str, Any]:
    """Config of an AutoencoderKL."""
    levels = 1 + _highest(shapes, r"encoder\.down\.(\d+)\.")
    return {
        "_class_name": "AutoencoderKL",
        "block_out_channels": [shapes[f"encoder.down.{i}.block.0.conv1.weight"][0] for i in range(levels)],
        "layers_per_block": 1 + _highest(shapes, r"encoder\.down\.0\.block\.(\d+)\."),
        "latent_channels": shapes["quant_conv.weight"][0] // 2,
        "down_block_types": ["DownEncoderBlock2D"] * levels,
        "up_block_types": ["UpDecoderBlock2D"] * levels,
        "scaling_factor": 0.18215,
    }


def text_config(shapes: Shapes, *, open_clip: bool) -> dict[str, Any]:
    """Config of a CLIPTextModel under transformers' names."""
    vocabulary, width = shapes["embeddings.token_embedding.weight"]
    return {
        "vocab_size": vocabulary,
        "hidden_size": width,
        "intermediate_size": shapes["encoder.layers.0.mlp.fc1.weight"][0],
        "num_hidden_layers": 1 + _highest(shapes, r"encoder\.layers\.(\d+)\."),
        "num_attention_heads": max(1, width // _CLIP_HEAD_WIDTH),
        "max_position_embeddings": shapes["embeddings.position_embedding.weight"][0],
        "hidden_act": "gelu" if open_clip else "quick_gelu",
    }


def _strip_wrapper(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {name.removeprefix("text_model."): tensor for name, tensor in state.items()}


def convert_open_clip(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """OpenCLIP's text encoder with transformers' names, without its last layer, which SD 2.x does not use."""
    last = _highest(state, r"transformer\.resblocks\.(\d+)\.")
    renamed = {
        "embeddings.token_embedding.weight": state["token_embedding.weight"],
        "embeddings.position_embedding.weight": state["positional_embedding"],
        "final_layer_norm.weight": state["ln_final.weight"],
        "final_layer_norm.bias": state["ln_final.bias"],
    }
    for name, tensor in state.items():
        if (found := re.match(r"transformer\.resblocks\.(\d+)\.(.+)\.?(weight|bias)$", name)) and int(found[1]) < last:
            renamed |= _rename_layer(f"encoder.layers.{found[1]}", found[2].rstrip("._"), found[3], tensor)
    return renamed


def _rename_layer(layer: str, part: str, kind: str, tensor: Tensor) -> dict[str, Tensor]:
    if part == "attn.in_proj":
        return {f"{layer}.self_attn.{x}_proj.{kind}": t for x, t in zip("qkv", tensor.chunk(3), strict=True)}
    return {f"{layer}.{_OPEN_CLIP_NAMES[part]}.{kind}": tensor}


def _highest(names: Mapping[str, Any], pattern: str) -> int:
    """The highest number that a pattern matches in the names. Raises KeyError(pattern) without a match."""
    found = [int(match[1]) for name in names if (match := re.match(pattern, name))]
    if not found:
        raise KeyError(pattern)
    return max(found)
