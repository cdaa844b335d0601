"""A vision transformer in a transformers folder, located, checked and loaded. Only safetensors are read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import nn

from pipeline.backbones.pretrained import full_text, load_pretrained, silence_libraries
from pipeline.errors import BadInput
from pipeline.io.checkpoints import (
    fetch_snapshot,
    is_local,
    list_pickles,
    list_shards,
    read_json,
    resolve_hub_cache,
    sweep_hint,
)
from pipeline.io.digests import file_exists

FIELD = "extract.weights"
MAX_SIZE = 16384  # of width, depth, heads, patch and image; a larger number is a mistake
CLASSES = {
    "vit": "ViTModel",
    "dinov2": "Dinov2Model",
    "dinov2_with_registers": "Dinov2WithRegistersModel",
    "dinov3_vit": "DINOv3ViTModel",
}
"""model_type of a config -> the transformers class of the backbone without a head."""

_INDEX, _SINGLE = "model.safetensors.index.json", "model.safetensors"
_PATTERNS = ["config.json", _INDEX, _SINGLE, "model-[0-9]*-of-[0-9]*.safetensors"]


@dataclass(frozen=True)
class VitSizes:
    """Sizes of a transformer. ``patch``: side of a patch in pixels; ``registers``: number of register tokens."""

    width: int
    depth: int
    heads: int
    patch: int
    registers: int


def open_folder(weights: str, revision: str | None, model_types: tuple[str, ...], name: str) -> TransformersFolder:
    """Locate weights at a hub id or in a folder. ``name``: the model's field in ``weights``. Raises BadInput."""
    if not is_local(weights):
        return TransformersFolder(fetch_snapshot(weights, revision, _PATTERNS, field=FIELD, name=name), model_types)
    path = Path(weights).expanduser()
    if not path.is_dir():
        found = f"{weights!r}, which is {'a file' if path.exists() else 'not there'}"
        needed = "a folder as save_pretrained writes it, or a hub id" + sweep_hint(name)
        raise BadInput(FIELD, found=found, needed=needed)
    return TransformersFolder(resolve_hub_cache(path, FIELD), model_types)


@dataclass(frozen=True)
class TransformersFolder:
    """A folder written by transformers' save_pretrained, with a model of one of ``model_types``."""

    root: Path
    model_types: tuple[str, ...]

    @property
    def files(self) -> dict[str, Path]:
        """The files whose bytes determine the features, by name."""
        return {path.name: path for path in (self._json, *self._list_tensors())}

    def read_sizes(self) -> VitSizes:
        """Sizes from the config. Raises BadInput for a model of another class."""
        config = self._read_config()
        registers = getattr(config, "num_register_tokens", 0)
        for name in ("hidden_size", "num_hidden_layers", "num_attention_heads", "patch_size", "image_size"):
            size = getattr(config, name)
            if not isinstance(size, int) or not 1 <= size <= MAX_SIZE:
                raise BadInput(self._json, found=f"{name} {size!r}", needed=f"a whole number from 1 to {MAX_SIZE}")
        return VitSizes(
            config.hidden_size, config.num_hidden_layers, config.num_attention_heads, config.patch_size, registers
        )

    def load_model(self, dtype: torch.dtype) -> nn.Module:
        """The backbone, on the CPU. Raises BadInput for weights that are missing or do not fit the config."""
        self._read_config()
        tensors = [path for path in self._list_tensors() if path.suffix == ".safetensors"]
        options = {"add_pooling_layer": False} if self._read_model_type() == "vit" else {}
        model = load_pretrained(CLASSES[self._read_model_type()], self.root, tensors, **options)
        for parameter in model.parameters():  # buffers, such as the frequencies of a rotation, stay float32
            parameter.data = parameter.data.to(dtype)
        return model

    @property
    def _json(self) -> Path:
        return self.root / "config.json"

    def _read_model_type(self) -> str:
        """Raises BadInput for a config of another class."""
        needed = f"a {' or '.join(CLASSES[name] for name in self.model_types)} of transformers"
        if not self._json.exists():
            seen = sorted(path.name for path in self.root.glob("*") if not path.name.startswith("."))
            raise BadInput(
                self._json, found=f"no such file ({', '.join(seen[:8]) or 'an empty folder'})", needed=needed
            )
        config = read_json(self._json)
        model_type, classes = config.get("model_type"), config.get("architectures") or []
        if model_type not in self.model_types or any(name != CLASSES[model_type] for name in classes):
            named = ", ".join(map(str, classes)) or config.get("_class_name") or "a config without architectures"
            raise BadInput(self._json, found=f"{named} (model_type {model_type})", needed=needed)
        return str(model_type)

    def _read_config(self) -> Any:
        import transformers

        name = CLASSES[self._read_model_type()].removesuffix("Model") + "Config"
        cls: Any = getattr(transformers, name, None)
        if cls is None:
            found = f"transformers {transformers.__version__}, which has no {name}"
            raise BadInput(self._json, found=found, needed="a newer transformers, or weights of another class")
        try:
            with silence_libraries():
                return cls.from_dict(read_json(self._json))
        except Exception as error:  # the type for a wrong value differs between versions of transformers
            raise BadInput(self._json, found=full_text(error), needed=f"the fields of a {cls.__name__}") from None

    def _list_tensors(self) -> list[Path]:
        """One weight file, or an index and its shards."""
        if file_exists(self.root / _SINGLE):
            return [self.root / _SINGLE]
        if file_exists(self.root / _INDEX):
            return [self.root / _INDEX, *list_shards(self.root / _INDEX)]
        pickled = list_pickles(self.root)
        found = f"only {', '.join(pickled)}" if pickled else "no such file"
        needed = "safetensors: convert it (save_pretrained), or name a revision of the hub that has them"
        raise BadInput(self.root / _SINGLE, found=found, needed=needed if pickled else f"the weights; {needed}")
