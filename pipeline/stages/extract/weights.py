"""Weights of Stable Diffusion: found, and their configs checked. safetensors only; nothing is ever unpickled."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from pipeline.checkpoints import everywhere, fetched, is_local, one_line, pickled_in, read_json, shards
from pipeline.errors import BadInput
from pipeline.stages.extract.diffusion import Architecture
from pipeline.stages.extract.loading import (
    empty_model,
    empty_prompt,
    empty_text_encoder,
    fill,
    last_hidden_state,
    without_decoder,
)

FIELD = "extract.weights"
_NAME = "stable_diffusion"  # below weights in the configuration
_SCHEDULE = {"num_train_timesteps": 1000, "beta_start": 0.00085, "beta_end": 0.012, "beta_schedule": "scaled_linear"}
_SCHEDULE_FIELDS = (*_SCHEDULE, "trained_betas", "rescale_betas_zero_snr")
_TOKENIZER_FILES = ("vocab.json", "merges.txt", "tokenizer.json", "tokenizer_config.json", "special_tokens_map.json")
_STEMS = {"unet": "diffusion_pytorch_model", "vae": "diffusion_pytorch_model", "text_encoder": "model"}


class Weights(Protocol):
    """A place that holds a Stable Diffusion model. ``files``: all that is read from it, by name."""

    @property
    def files(self) -> dict[str, Path]:
        """The files whose bytes decide the features."""
        ...

    def architecture(self) -> Architecture:
        """Configs, checked to be Stable Diffusion 1.x or 2.x. Raises BadInput."""
        ...

    def unet(self, dtype: torch.dtype) -> nn.Module:
        """The U-Net. Raises BadInput for weights that do not fit the config."""
        ...

    def vae(self, dtype: torch.dtype) -> nn.Module:
        """The VAE, its decoder dropped. Raises BadInput as ``unet`` does."""
        ...

    def prompt(self, text: str) -> Float[Tensor, "1 l d"]:
        """The text encoder's last hidden state, float32; the encoder is freed. Raises BadInput as ``unet`` does."""
        ...


def find(weights: str, revision: str | None) -> Weights:
    """What lies at a hub id, in a diffusers folder, or in one .safetensors file of the original layout."""
    from pipeline.stages.extract.single_file import SingleFile

    if not is_local(weights):
        return DiffusersFolder(_download(weights, revision))
    path = Path(weights).expanduser()
    if not path.exists():
        needed = "a diffusers folder or a .safetensors file" + everywhere(_NAME)
        raise BadInput(FIELD, found=f"{weights!r}, which does not exist", needed=needed)
    if path.is_dir():
        return DiffusersFolder(path)
    if path.suffix != ".safetensors":
        raise BadInput(FIELD, found=f"{weights!r}", needed="safetensors: convert it, pickled weights are never opened")
    return SingleFile(path)


@dataclass(frozen=True)
class DiffusersFolder:
    """A folder as diffusers' save_pretrained writes it: unet, vae, text_encoder; tokenizer and scheduler if present."""

    root: Path

    @property
    def files(self) -> dict[str, Path]:
        """Configs and weights in use; a file nobody reads does not count."""
        paths = [self._json(part) for part in _STEMS]
        paths += [path for part in _STEMS for path in self._tensors(part)]
        paths += [self.root / "scheduler" / "scheduler_config.json"]
        paths += [self.root / "tokenizer" / name for name in _TOKENIZER_FILES]
        return {path.relative_to(self.root).as_posix(): path for path in paths if path.exists()}

    def architecture(self) -> Architecture:
        """See Weights."""
        if (self.root / "text_encoder_2").exists():
            raise BadInput(
                self.root / "text_encoder_2", found="a second text encoder", needed="Stable Diffusion 1.x or 2.x"
            )
        unet, vae = self._config("unet"), self._config("vae")
        check_unet(unet, self._json("unet"))
        check_class(vae, "AutoencoderKL", self._json("vae"))
        check_fields(vae, ("block_out_channels",), self._json("vae"))
        check_latents(unet, vae, self._json("unet"))
        scheduler = self.root / "scheduler" / "scheduler_config.json"
        return Architecture(unet, vae, alphas_cumprod(read_json(scheduler) if scheduler.exists() else {}, scheduler))

    def unet(self, dtype: torch.dtype) -> nn.Module:
        """See Weights."""
        from diffusers import UNet2DConditionModel

        return self._filled(self._empty(UNet2DConditionModel, "unet", dtype), "unet")

    def vae(self, dtype: torch.dtype) -> nn.Module:
        """See Weights."""
        from diffusers import AutoencoderKL

        return self._filled(without_decoder(self._empty(AutoencoderKL, "vae", dtype)), "vae")

    def prompt(self, text: str) -> Float[Tensor, "1 l d"]:
        """See Weights."""
        config, width = self._config("text_encoder"), self._config("unet")["cross_attention_dim"]
        if config.get("hidden_size") != width:
            found = f"hidden_size {config.get('hidden_size')}"
            raise BadInput(self._json("text_encoder"), found=found, needed=f"{width}, as the U-Net attends to")
        ids = self._token_ids(text, config)
        outer, inner = empty_text_encoder(config, self._json("text_encoder"))
        self._filled(inner, "text_encoder")
        return last_hidden_state(outer, ids)

    def _token_ids(self, text: str, config: Mapping[str, Any]) -> Int[Tensor, "1 l"]:
        folder, length = self.root / "tokenizer", int(config.get("max_position_embeddings", 77))
        if not any((folder / name).exists() for name in ("vocab.json", "tokenizer.json")):
            return empty_prompt(text, folder, open_clip=config.get("hidden_act") == "gelu", length=length)
        from transformers import CLIPTokenizer

        try:
            tokenizer = CLIPTokenizer.from_pretrained(str(folder), local_files_only=True)
            ids = tokenizer(text, padding="max_length", max_length=length, truncation=False)["input_ids"]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise BadInput(folder, found=one_line(error), needed="the files of a CLIP tokenizer") from None
        if len(ids) > length:
            raise BadInput(
                "extract.prompt", found=f"{len(ids)} tokens", needed=f"at most {length}, begin and end included"
            )
        return torch.tensor([ids])

    def _json(self, part: str) -> Path:
        return self.root / part / "config.json"

    def _config(self, part: str) -> dict[str, Any]:
        path = self._json(part)
        if not path.exists():
            seen = sorted(p.parent.name for p in self.root.glob("*/config.json"))
            needed = "a Stable Diffusion 1.x or 2.x folder with unet, vae and text_encoder"
            raise BadInput(path, found=f"no such file (configs of: {', '.join(seen) or 'nothing'})", needed=needed)
        return read_json(path)

    def _tensors(self, part: str) -> list[Path]:
        """Files of a part's weights, full precision where there is a choice: one, or an index and its shards."""
        folder, stem = self.root / part, _STEMS[part]
        for variant in ("", ".fp16"):
            index = folder / f"{stem}.safetensors.index{variant}.json"
            if (single := folder / f"{stem}{variant}.safetensors").exists():
                return [single]
            if index.exists():
                return [index, *shards(index)]
        pickled = pickled_in(folder)
        found = f"only {', '.join(pickled)}" if pickled else "no such file"
        needed = "safetensors: convert it (save_pretrained, safe_serialization=True)" if pickled else "the weights"
        raise BadInput(folder / f"{stem}.safetensors", found=found, needed=needed)

    def _empty(self, cls: Any, part: str, dtype: torch.dtype) -> nn.Module:
        return empty_model(cls, self._config(part), dtype, self._json(part))

    def _filled(self, model: nn.Module, part: str) -> nn.Module:
        fill(model, [path for path in self._tensors(part) if path.suffix == ".safetensors"])
        return model


def check_unet(config: Mapping[str, Any], where: Path) -> None:
    """Raises BadInput, naming the field, for a U-Net that is not that of Stable Diffusion 1.x or 2.x."""
    check_class(config, "UNet2DConditionModel", where)
    for name in ("addition_embed_type", "class_embed_type", "encoder_hid_dim_type"):
        if config.get(name) is not None:
            raise BadInput(
                where, found=f"{name} {config[name]!r}", needed="none, as Stable Diffusion 1.x and 2.x have it"
            )
    check_fields(config, ("block_out_channels", "layers_per_block", "cross_attention_dim"), where)
    for name in ("layers_per_block", "cross_attention_dim"):
        if not isinstance(config[name], int):
            raise BadInput(where, found=f"{name} {config[name]!r}", needed="one whole number")
    if strange := sorted(set(config.get("up_block_types", ())) - {"UpBlock2D", "CrossAttnUpBlock2D"}):
        raise BadInput(where, found=f"up_block_types {strange[0]!r}", needed="UpBlock2D or CrossAttnUpBlock2D")


def check_class(config: Mapping[str, Any], name: str, where: Path) -> None:
    """Raises BadInput when a config belongs to another class."""
    if config.get("_class_name") != name:
        raise BadInput(where, found=f"_class_name {config.get('_class_name')!r}", needed=name)


def check_fields(config: Mapping[str, Any], names: Sequence[str], where: Path) -> None:
    """Raises BadInput when a config lacks a field."""
    for name in names:
        if not config.get(name):
            raise BadInput(where, found=f"no {name}", needed=f"the config of a {config['_class_name']}")


def check_latents(unet: Mapping[str, Any], vae: Mapping[str, Any], where: Path) -> None:
    """Raises BadInput for a U-Net that takes more than a latent: inpainting, depth, editing, upscaling."""
    needed = int(vae.get("latent_channels", 4))
    if unet.get("in_channels", 4) != needed:
        found = f"in_channels {unet['in_channels']}"
        raise BadInput(where, found=found, needed=f"{needed}, the latent alone (no inpainting or depth model)")


def alphas_cumprod(scheduler: Mapping[str, Any], where: Path | None = None) -> Float[np.ndarray, " timesteps"]:
    """abar_t of a scheduler's config; Stable Diffusion's scaled-linear betas for what it leaves open."""
    from diffusers import DDPMScheduler

    if "Flow" in str(scheduler.get("_class_name", "")):
        raise BadInput(where, found=f"_class_name {scheduler['_class_name']!r}", needed="a scheduler with betas")
    schedule = _SCHEDULE | {name: scheduler[name] for name in _SCHEDULE_FIELDS if scheduler.get(name) is not None}
    try:
        ddpm: Any = DDPMScheduler(**schedule)
        return ddpm.alphas_cumprod.double().numpy()
    except (NotImplementedError, TypeError, ValueError, RuntimeError) as error:
        raise BadInput(where, found=one_line(error), needed="a schedule of betas that diffusers knows") from None


def _download(hub_id: str, revision: str | None) -> Path:
    """Folder of the hub's files that are needed; the half-precision ones only where there are no others."""
    for variant in ("", ".fp16"):
        folder = fetched(hub_id, revision, _patterns(variant), field=FIELD, name=_NAME)
        if any((folder / "unet").glob("*.safetensors")):
            break
    return folder


def _patterns(variant: str) -> list[str]:
    tensors = [
        f"{part}/{stem}{end}"
        for part, stem in _STEMS.items()
        for end in (
            f"{variant}.safetensors",
            f".safetensors.index{variant}.json",
            f"{variant}-[0-9]*-of-[0-9]*.safetensors",
            f"-[0-9]*-of-[0-9]*{variant}.safetensors",
        )
    ]
    configs = [f"{part}/config.json" for part in _STEMS] + ["scheduler/scheduler_config.json"]
    return [*configs, *(f"tokenizer/{name}" for name in _TOKENIZER_FILES), *tensors]
