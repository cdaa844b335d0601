"""A Stable Diffusion model whose U-Net is replaced by one of the same config, published as a file of its own."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxtyping import Int
from torch import Tensor

from pipeline.backbones.stable_diffusion.features import DiffusionConfigs
from pipeline.backbones.stable_diffusion.identity import Part
from pipeline.backbones.stable_diffusion.loading import Stored, read_tensors, to_current_name
from pipeline.backbones.stable_diffusion.weights import Weights
from pipeline.errors import BadInput
from pipeline.io.checkpoints import fetch_snapshot, is_local, resolve_hub_cache, sweep_hint, tensor_shapes


@dataclass(frozen=True)
class OtherUnet(Weights):
    """``base`` with the U-Net of ``path``, a .safetensors file with exactly the tensors of diffusers' state dict."""

    base: Weights
    path: Path

    @property
    def files(self) -> dict[str, Path]:
        """See Weights; the base's own U-Net is not read."""
        kept = {name: path for name, path in self.base.files.items() if not _holds_unet(name)}
        return kept | {self.path.name: self.path}

    def read_configs(self) -> DiffusionConfigs:
        """See Weights."""
        return self.base.read_configs()

    def read_config(self, part: Part | str) -> Mapping[str, Any]:
        """See Weights."""
        return self.base.read_config(part)

    def config_place(self, part: Part) -> Path:
        """See Weights."""
        return self.base.config_place(part)

    def read_tensors(self, part: Part, wanted: Mapping[str, Tensor]) -> Iterator[Stored]:
        """See Weights. Raises BadInput for a U-Net file with other tensors than the base's U-Net."""
        if part != "unet":
            yield from self.base.read_tensors(part, wanted)
            return
        self._check(wanted)
        yield from read_tensors([self.path], wanted)

    def tokenize(self, text: str) -> Int[Tensor, "1 l"]:
        """See Weights."""
        return self.base.tokenize(text)

    def _check(self, wanted: Mapping[str, Tensor]) -> None:
        """Raise BadInput for a tensor that the base's U-Net does not have, or has in another shape."""
        place = self.base.config_place("unet")
        for name, shape in tensor_shapes(self.path).items():
            model = wanted.get(to_current_name(name))
            if model is None:
                raise BadInput(self.path, found=f"a tensor {name}", needed=f"only those of the U-Net of {place}")
            if tuple(model.shape) != shape:
                needed = f"{tuple(model.shape)}, as in the U-Net of {place}: is it of another Stable Diffusion?"
                raise BadInput(f"{self.path}, tensor {name}", found=f"shape {shape}", needed=needed)


def find_unet(given: str, file: str, *, field: str, name: str) -> Path:
    """``file`` at a hub id (its default branch) or in a folder, or the file itself. Raises BadInput for ``field``."""
    if not is_local(given):
        return _require(fetch_snapshot(given, None, [file], field=field, name=name) / file, field, name)
    path = Path(given).expanduser()
    return _require(resolve_hub_cache(path, field) / file if path.is_dir() else path, field, name)


def _require(path: Path, field: str, name: str) -> Path:
    if not path.is_file() or path.suffix != ".safetensors":
        found = f"{str(path)!r}, which is {'no .safetensors file' if path.exists() else 'not there'}"
        raise BadInput(field, found=found, needed="the U-Net's .safetensors file, or its folder" + sweep_hint(name))
    return path


def _holds_unet(name: str) -> bool:
    return name.startswith("unet/") and name != "unet/config.json"
