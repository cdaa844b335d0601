"""Weights of SAM and SAM 2: found, checked, loaded. safetensors only; nothing is ever unpickled."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.errors import BadInput

FIELD = "detect.proposals.weights"
# model_type of config.json -> class; SAM 2 is published as its video model, whose image part is a Sam2Model
CLASSES = {"sam": "SamModel", "sam2": "Sam2Model", "sam2_video": "Sam2Model"}
_PATTERNS = ("config.json", "model*.safetensors", "model.safetensors.index.json")


@dataclass(frozen=True)
class SamWeights:
    """A folder of transformers with the config and weights of a SamModel or a Sam2Model."""

    root: Path
    class_name: str

    @property
    def files(self) -> dict[str, Path]:
        """Config and weights, by name."""
        tensors = sorted(self.root.glob("model*.safetensors"))
        return {path.name: path for path in [self.root / "config.json", *tensors]}

    def model(self) -> Any:
        """The model, float32 on the CPU. Raises BadInput for weights that do not fit the config."""
        import transformers

        cls = getattr(transformers, self.class_name, None)
        if cls is None:
            found = f"transformers {transformers.__version__}, which has no {self.class_name}"
            raise BadInput(FIELD, found=found, needed="a newer transformers, or weights of SAM")
        try:
            with _quiet():
                model, seen = cls.from_pretrained(
                    self.root, local_files_only=True, use_safetensors=True, output_loading_info=True
                )
        except Exception as error:  # whatever transformers and safetensors make of a broken folder
            raise BadInput(self.root, found=_one_line(error), needed=f"a {self.class_name}") from None
        if missing := sorted(seen["missing_keys"]):  # transformers would draw them at random
            found = f"no tensor for {missing[0]} ({len(missing)} missing)"
            raise BadInput(self.root, found=found, needed=f"all weights of a {self.class_name}")
        return model.float()


def find(weights: str, revision: str | None) -> SamWeights:
    """What lies in a folder or at a hub id. Raises BadInput for what is no SAM or no safetensors."""
    path = Path(weights).expanduser()
    if not path.exists():
        if weights.startswith(("/", "./", "../", "~")):
            raise BadInput(
                FIELD, found=f"{weights!r}, which does not exist", needed="a folder of SamModel or Sam2Model"
            )
        path = _download(weights, revision)
    config = path / "config.json"
    try:
        model_type = json.loads(config.read_text(encoding="utf-8")).get("model_type")
    except (OSError, ValueError, AttributeError) as error:
        raise BadInput(config, found=_one_line(error), needed="the config of a SamModel or Sam2Model") from None
    if model_type not in CLASSES:
        raise BadInput(config, found=f"model_type {model_type!r}", needed=f"one of {', '.join(CLASSES)}")
    if not any(path.glob("model*.safetensors")):
        needed = "safetensors: convert it (save_pretrained), pickled weights are never opened"
        raise BadInput(path / "model.safetensors", found="no such file", needed=needed)
    return SamWeights(path, CLASSES[model_type])


def _download(hub_id: str, revision: str | None) -> Path:
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import HfHubHTTPError, HFValidationError

    try:
        return Path(snapshot_download(hub_id, revision=revision, allow_patterns=list(_PATTERNS)))
    except (HfHubHTTPError, HFValidationError, OSError) as error:
        found = f"{hub_id!r}, which is no local path and was not fetched: {_one_line(error)}"
        needed = "a reachable hub; or fetch it elsewhere (hf download) and give its local folder"
        raise BadInput(FIELD, found=found, needed=needed) from None


def _one_line(error: Exception) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0][:200]


@contextmanager
def _quiet() -> Iterator[None]:
    """Without the progress bars and remarks of transformers while it reads weights."""
    from transformers.utils import logging

    before = logging.get_verbosity()
    logging.set_verbosity_error()
    logging.disable_progress_bar()
    try:
        yield
    finally:
        logging.set_verbosity(before)
        logging.enable_progress_bar()
