"""Loads weights of Stable Diffusion into models of diffusers and transformers, without a second copy in memory."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from pipeline.backbones.pretrained import silence_libraries
from pipeline.backbones.stable_diffusion.identity import Part
from pipeline.errors import BadInput
from pipeline.io.checkpoints import check_missing, first_line, tensor_shapes

Stored = tuple[str, Tensor, str]
"""Name, value and place (file and name in it) of a stored tensor."""

_ATTENTION_NAMES = {"query": "to_q", "key": "to_k", "value": "to_v", "proj_attn": "to_out.0"}
_PORTION = 1 << 26  # values read before a file is unmapped and mapped again
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
    """A model of a diffusers class with uninitialised weights. Raises BadInput for a config it does not take."""
    return _build_empty(cls, config, where, dtype).to_empty(device="cpu")


def _build_empty(cls: Any, config: Mapping[str, Any], where: object, dtype: torch.dtype = torch.float32) -> nn.Module:
    """A model of a diffusers class on the meta device: without memory."""
    try:
        with torch.device("meta"), silence_libraries():
            model: nn.Module = cls.from_config(dict(config)).to(dtype)
    except (ValueError, TypeError, KeyError, IndexError, RuntimeError, NotImplementedError) as error:
        raise BadInput(where, found=first_line(error), needed=f"a config of {cls.__name__}") from None
    return model


def allocate_unet(config: Mapping[str, Any], dtype: torch.dtype, where: object = "config") -> nn.Module:
    """An uninitialised UNet2DConditionModel. Raises BadInput as ``allocate_model``."""
    from diffusers import UNet2DConditionModel

    return allocate_model(UNet2DConditionModel, config, dtype, where)


def allocate_encoder(config: Mapping[str, Any], dtype: torch.dtype, where: object = "config") -> nn.Module:
    """An uninitialised AutoencoderKL without its decoder. Raises BadInput as ``allocate_model``."""
    from diffusers import AutoencoderKL

    return drop_decoder(allocate_model(AutoencoderKL, config, dtype, where))


def build_untrained(unet: dict[str, Any], vae: dict[str, Any]) -> tuple[Any, Any]:
    """U-Net and autoencoder with the default initialisation, for training."""
    from diffusers import AutoencoderKL, UNet2DConditionModel

    return UNet2DConditionModel(**unet), AutoencoderKL(**vae)


def build_text_encoder(config: Mapping[str, Any], where: object) -> tuple[nn.Module, nn.Module]:
    """A CLIPTextModel, and the module that holds its weights: a submodule before transformers 5.6, then itself."""
    from transformers import CLIPTextConfig, CLIPTextModel

    try:
        with silence_libraries():
            model: Any = CLIPTextModel(CLIPTextConfig.from_dict(dict(config)))
    except (ValueError, TypeError, KeyError, RuntimeError, AttributeError) as error:
        raise BadInput(where, found=first_line(error), needed="a config of CLIPTextModel") from None
    return model, getattr(model, "text_model", model)


def to_current_name(name: str) -> str:
    """A weight's current name: without the text encoder's wrapper; the VAE's attention as of diffusers 0.17."""
    name = name.removeprefix("text_model.")
    old = re.match(r"(.+\.attentions\.\d+\.)(query|key|value|proj_attn)(\.(?:weight|bias))$", name)
    return old[1] + _ATTENTION_NAMES[old[2]] + old[3] if old else name


def lay_out(part: Part, config: Mapping[str, Any], where: object) -> dict[str, nn.Parameter]:
    """The parameters of a part that are used, by name, without memory: their shapes. Raises BadInput."""
    from diffusers import AutoencoderKL, UNet2DConditionModel

    if part == "text_encoder":
        with torch.device("meta"):
            return dict(build_text_encoder(config, where)[1].named_parameters())
    if part == "unet":
        return dict(_build_empty(UNet2DConditionModel, config, where).named_parameters())
    return dict(drop_decoder(_build_empty(AutoencoderKL, config, where)).named_parameters())


def read_tensors(
    paths: Sequence[Path],
    wanted: Mapping[str, Tensor],
    name_of: Callable[[str], str | None] = to_current_name,
) -> Iterator[Stored]:
    """Tensors of safetensors files whose names are wanted. Raises BadInput if one is missing.

    ``name_of``: maps a stored tensor's name to the model's, None to skip it. A file is mapped again every few hundred
    megabytes, because the pages already read would count as a second copy of the weights.
    """
    from safetensors import safe_open

    missing = dict(wanted)
    for path in paths:
        stored = {name: s for s in tensor_shapes(path) if (name := name_of(s)) is not None and name in missing}
        for names in _portions(stored, missing):
            with safe_open(str(path), framework="pt") as tensors:
                for name in names:
                    missing.pop(name)
                    yield name, tensors.get_tensor(stored[name]), f"{path}, tensor {stored[name]}"
    check_missing(sorted(missing), paths[0])


def _portions(names: Iterable[str], tensors: Mapping[str, Tensor]) -> list[list[str]]:
    portions: list[list[str]] = [[]]
    size = 0
    for name in names:
        portions[-1].append(name)
        size += tensors[name].numel()
        if size > _PORTION:
            portions.append([])
            size = 0
    return portions


def copy_weight(value: Tensor, parameter: nn.Parameter, where: str) -> None:
    """Copy a stored weight into a parameter. Raises BadInput for another shape."""
    if value.numel() == parameter.numel() and value.ndim > parameter.ndim:
        value = value.view(parameter.shape)  # 1x1 kernels, stored before they became matrices
    if value.shape != parameter.shape:
        raise BadInput(
            where, found=f"shape {tuple(value.shape)}", needed=f"{tuple(parameter.shape)}, as the config says"
        )
    parameter.copy_(value)


def encode_text(text_encoder: nn.Module, ids: Int[Tensor, "1 l"]) -> Float[Tensor, "1 l d"]:
    """The text encoder's output after its final layer norm, float32."""
    with torch.no_grad():
        return text_encoder.float().eval()(ids)[0].clone()


def drop_decoder(vae: Any) -> nn.Module:
    """Remove the VAE's decoder, which features do not need."""
    vae.decoder, vae.post_quant_conv = None, None
    return vae
