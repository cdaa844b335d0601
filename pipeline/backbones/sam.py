"""Weights of SAM and SAM 2, located and checked. Only safetensors are read; nothing is unpickled."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.backbones.pretrained import load_pretrained
from pipeline.errors import BadInput
from pipeline.io.checkpoints import fetch_snapshot, is_local, read_json, resolve_hub_cache, sweep_hint
from pipeline.io.digests import file_exists

FIELD = "detect.proposals.weights"
_NAME = "sam"  # of the field weights.sam in the configuration
# model_type of config.json -> class; SAM 2 is published as a video model, whose image part is a Sam2Model
CLASSES = {"sam": "SamModel", "sam2": "Sam2Model", "sam2_video": "Sam2Model"}
_PATTERNS = ("config.json", "model*.safetensors", "model.safetensors.index.json")


@dataclass(frozen=True)
class SamWeights:
    """A transformers folder with the config and weights of a SamModel or a Sam2Model."""

    root: Path
    class_name: str

    @property
    def tensors(self) -> list[Path]:
        """The weight files."""
        return sorted(self.root.glob("model*.safetensors"))

    @property
    def files(self) -> dict[str, Path]:
        """Config and weight files, by name; the index where it says which file each tensor is in."""
        index = [] if file_exists(self.root / "model.safetensors") else [self.root / "model.safetensors.index.json"]
        named = [self.root / "config.json", *self.tensors, *filter(file_exists, index)]
        return {path.name: path for path in named}

    def load_model(self) -> Any:
        """The model, float32 on the CPU. Raises BadInput for weights that do not fit the config."""
        return load_pretrained(self.class_name, self.root, self.tensors).float()


def open_sam_weights(weights: str, revision: str | None) -> SamWeights:
    """Locate weights in a folder or at a hub id. Raises BadInput for other models and formats than safetensors."""
    path = Path(weights).expanduser()
    if not is_local(weights):
        path = fetch_snapshot(weights, revision, _PATTERNS, field=FIELD, name=_NAME)
    elif not path.exists():
        needed = "a folder of SamModel or Sam2Model" + sweep_hint(_NAME)
        raise BadInput(FIELD, found=f"{weights!r}, which does not exist", needed=needed)
    else:
        path = resolve_hub_cache(path, FIELD)
    config = path / "config.json"
    model_type = read_json(config).get("model_type")
    if model_type not in CLASSES:
        raise BadInput(config, found=f"model_type {model_type!r}", needed=f"one of {', '.join(CLASSES)}")
    found = SamWeights(path, CLASSES[model_type])
    if not found.tensors:
        needed = "safetensors: convert it (save_pretrained), pickled weights are never opened"
        raise BadInput(path / "model.safetensors", found="no such file", needed=needed)
    return found
