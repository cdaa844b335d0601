"""Weights of Stable Diffusion into the models of diffusers and transformers: empty ones made, filled, asked."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from pipeline.backbones.pretrained import silence_libraries
from pipeline.errors import BadInput
from pipeline.io.checkpoints import check_missing, first_line, tensor_shapes

_ATTENTION_NAMES = {"query": "to_q", "key": "to_k", "value": "to_v", "proj_attn": "to_out.0"}
_PORTION = 1 << 26  # values read before a file is mapped anew
_BOS, _EOS = 49406, 49407  # of CLIP's vocabulary (Radford et al., ICML 2021)


def tokenize_empty_prompt(text: str, where: Path, *, open_clip: bool, length: int) -> Int[Tensor, "1 l"]:
    """Token ids of "" without a tokenizer: begin, end, padding. Raises BadInput for any other text.

    Stable Diffusion 1.x pads CLIP's text with the end token, 2.x pads OpenCLIP's with 0.
    """
    if text:
        raise BadInput(
            "extract.prompt", found=f"{text!r} and no tokenizer at {where}", needed='"", or a diffusers folder with one'
        )
    padding = 0 if open_clip else _EOS
    return torch.tensor([[_BOS, _EOS] + [padding] * (length - 2)])


def allocate_model(cls: Any, config: Mapping[str, Any], dtype: torch.dtype, where: object = "config") -> nn.Module:
    """A model of a diffusers class, its memory set aside and not yet written to. Raises BadInput."""
    try:
        with torch.device("meta"), silence_libraries():
            model = cls.from_config(dict(config)).to(dtype)
    except (ValueError, TypeError, KeyError, IndexError, RuntimeError, NotImplementedError) as error:
        raise BadInput(where, found=first_line(error), needed=f"a config of {cls.__name__}") from None
    return model.to_empty(device="cpu")


def allocate_unet(config: Mapping[str, Any], dtype: torch.dtype, where: object = "config") -> nn.Module:
    """An empty UNet2DConditionModel. Raises BadInput as ``allocate_model``."""
    from diffusers import UNet2DConditionModel

    return allocate_model(UNet2DConditionModel, config, dtype, where)


def allocate_encoder(config: Mapping[str, Any], dtype: torch.dtype, where: object = "config") -> nn.Module:
    """An empty AutoencoderKL with its encoder alone. Raises BadInput as ``allocate_model``."""
    from diffusers import AutoencoderKL

    return drop_decoder(allocate_model(AutoencoderKL, config, dtype, where))


def build_untrained(unet: dict[str, Any], vae: dict[str, Any]) -> tuple[Any, Any]:
    """U-Net and autoencoder of the given configs, freshly initialised: for training."""
    from diffusers import AutoencoderKL, UNet2DConditionModel

    return UNet2DConditionModel(**unet), AutoencoderKL(**vae)


def build_text_encoder(config: Mapping[str, Any], where: object) -> tuple[nn.Module, nn.Module]:
    """A CLIPTextModel, and the part of it that holds the weights: itself, within a wrapper until transformers 5.6."""
    from transformers import CLIPTextConfig, CLIPTextModel

    try:
        with silence_libraries():
            model: Any = CLIPTextModel(CLIPTextConfig.from_dict(dict(config)))
    except (ValueError, TypeError, KeyError, RuntimeError, AttributeError) as error:
        raise BadInput(where, found=first_line(error), needed="a config of CLIPTextModel") from None
    return model, getattr(model, "text_model", model)


def modernize_name(name: str) -> str:
    """A weight's name today: no wrapper around the text encoder; the VAE's attention as since diffusers 0.17."""
    name = name.removeprefix("text_model.")
    former = re.match(r"(.+\.attentions\.\d+\.)(query|key|value|proj_attn)(\.(?:weight|bias))$", name)
    return former[1] + _ATTENTION_NAMES[former[2]] + former[3] if former else name


def fill(model: nn.Module, paths: Sequence[Path], name_of: Callable[[str], str | None] = modernize_name) -> None:
    """Weights from safetensors files into a model's own memory. Raises BadInput for ones that do not fit.

    ``name_of``: the model's name of a stored tensor. A file stays mapped for some hundred megabytes only: what has been
    read of it would count as a second copy.
    """
    from safetensors import safe_open

    missing = dict(model.named_parameters())
    for path in paths:
        stored = {name: s for s in tensor_shapes(path) if (name := name_of(s)) is not None and name in missing}
        for names in _portions(stored, missing):
            with safe_open(str(path), framework="pt") as tensors, torch.no_grad():
                for name in names:
                    where = f"{path}, tensor {stored[name]}"
                    copy_weight(tensors.get_tensor(stored[name]), missing.pop(name), where)
    check_missing(sorted(missing), paths[0])


def _portions(names: Iterable[str], parameters: Mapping[str, nn.Parameter]) -> list[list[str]]:
    portions: list[list[str]] = [[]]
    size = 0
    for name in names:
        portions[-1].append(name)
        size += parameters[name].numel()
        if size > _PORTION:
            portions.append([])
            size = 0
    return portions


def copy_weight(value: Tensor, parameter: nn.Parameter, where: str) -> None:
    """A stored weight into a model's memory. Raises BadInput for another shape."""
    if value.numel() == parameter.numel() and value.ndim > parameter.ndim:
        value = value.view(parameter.shape)  # 1x1 kernels that became matrices
    if value.shape != parameter.shape:
        raise BadInput(
            where, found=f"shape {tuple(value.shape)}", needed=f"{tuple(parameter.shape)}, as the config says"
        )
    parameter.copy_(value)


def last_hidden_state(text_encoder: nn.Module, ids: Int[Tensor, "1 l"]) -> Float[Tensor, "1 l d"]:
    """The text encoder's answer after its final layer norm, float32."""
    with torch.no_grad():
        return text_encoder.float().eval()(ids)[0].clone()


def drop_decoder(vae: Any) -> nn.Module:
    """The VAE with its encoder alone."""
    vae.decoder, vae.post_quant_conv = None, None
    return vae
