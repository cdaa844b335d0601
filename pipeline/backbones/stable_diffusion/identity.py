"""Weights of Stable Diffusion -> their digest: what features are computed from, however it is stored.

A diffusers folder, its shards, its half-precision files of the same values and a single file have the same digest.
Every tensor enters by its name in diffusers and its float32 values, every config by its fields that change features.
"""

from __future__ import annotations

import inspect
import json
from collections.abc import Iterator, Mapping
from hashlib import sha256
from typing import Any, Literal, Protocol

from torch import Tensor

from pipeline.backbones.stable_diffusion.configs import schedule_fields
from pipeline.spec import digest

Part = Literal["unet", "vae", "text_encoder"]
PARTS: tuple[Part, ...] = ("unet", "vae", "text_encoder")
VERSION = "stable diffusion 1"
"""Raise the number when equal weights get another digest."""

_WITHOUT_EFFECT = {
    # upcast_attention: of diffusers' processors, only the one without torch's fused attention reads it
    "unet": ("sample_size", "upcast_attention", "dropout"),
    # the decoder is not used, and only pipelines read force_upcast, latents_mean and latents_std
    "vae": ("sample_size", "force_upcast", "out_channels", "up_block_types", "use_post_quant_conv", "latents_mean",
            "latents_std"),
}  # fmt: skip
_TEXT_FIELDS = {"num_attention_heads": 8, "hidden_act": "quick_gelu", "layer_norm_eps": 1e-5}
"""Fields of a CLIPTextConfig that tensor shapes do not show, with transformers' defaults."""


class Content(Protocol):
    """Weights whose configs and tensors can be read."""

    def read_config(self, part: Part | str) -> Mapping[str, Any]:
        """The config of a part, as diffusers or transformers write it. Raises BadInput."""
        ...

    def tensors(self, part: Part) -> Iterator[tuple[str, Tensor, str]]:
        """Name, value and place of each tensor that is used. Raises BadInput for missing ones."""
        ...


def digest_content(content: Content) -> str:
    """sha256 (hex) of what features are computed from. Reads every tensor once. Raises BadInput."""
    configs = [
        effective_config("unet", content.read_config("unet")),
        effective_config("vae", content.read_config("vae")),
        _text_fields(content.read_config("text_encoder")),
        schedule_fields(content.read_config("scheduler")),
    ]
    tensors = {f"{part}.{name}": digest_tensor(value) for part in PARTS for name, value, _ in content.tensors(part)}
    return digest([VERSION, json.loads(json.dumps(configs)), tensors])


def digest_tensor(value: Tensor) -> str:
    """sha256 (hex) of a tensor's shape and float32 values; 1 x 1 kernels count as the matrices they are used as."""
    values = value.detach().float().contiguous()
    shape = list(values.shape)
    while shape and shape[-1] == 1:
        shape.pop()
    hasher = sha256(f"{shape}\0".encode())
    hasher.update(values.numpy().astype("<f4", copy=False).data)
    return hasher.hexdigest()


def effective_config(part: Literal["unet", "vae"], config: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of a config that change features and differ from the default of its class in diffusers."""
    from diffusers import AutoencoderKL, UNet2DConditionModel

    cls: Any = {"unet": UNet2DConditionModel, "vae": AutoencoderKL}[part]
    defaults = {name: field.default for name, field in inspect.signature(cls.__init__).parameters.items()}
    given = {name: _to_tuple(value) for name, value in config.items() if name in defaults}
    if isinstance(heads := given.get("attention_head_dim", defaults.get("attention_head_dim")), int):
        given["attention_head_dim"] = (heads,) * len(config["block_out_channels"])  # one number stands for all levels
    return {
        name: value
        for name, value in sorted(given.items())
        if value != defaults[name] and name not in _WITHOUT_EFFECT[part]
    }


def _text_fields(config: Mapping[str, Any]) -> dict[str, Any]:
    return {name: config.get(name, default) for name, default in _TEXT_FIELDS.items()}


def _to_tuple(value: Any) -> Any:
    return tuple(map(_to_tuple, value)) if isinstance(value, (list, tuple)) else value
