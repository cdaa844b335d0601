"""Files of weights, whatever model they are of: found on disk or on a hub, listed, read. safetensors only."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any

from pipeline.errors import BadInput

PICKLES = (".bin", ".ckpt", ".pt", ".pth")
_offline: ContextVar[bool] = ContextVar("offline", default=False)


def sweep_hint(name: str) -> str:
    """How weights are named once for all methods, as sweeps want it."""
    return f" (weights.{name}=FOLDER: for all methods)"


class NotDownloaded(BadInput):
    """Weights of a hub id that are not here, while nothing is to be fetched."""


@contextmanager
def offline() -> Iterator[None]:
    """Fetch nothing meanwhile: a plan spends nothing."""
    before = _offline.set(True)
    try:
        yield
    finally:
        _offline.reset(before)


def is_local(weights: str) -> bool:
    """True for what looks like a path: it exists, begins as a path does, or ends like a file of weights."""
    return (
        weights.startswith(("/", "./", "../", "~"))
        or weights.endswith((".safetensors", *PICKLES))
        or Path(weights).exists()
    )


def fetch_snapshot(hub_id: str, revision: str | None, patterns: Sequence[str], *, field: str, name: str) -> Path:
    """Local folder of the hub's files that match ``patterns``.

    Raises BadInput naming ``field`` and what ``name`` is set by for all methods; NotDownloaded where ``offline`` rules.
    """
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import HfHubHTTPError, HFValidationError, LocalEntryNotFoundError

    here = _offline.get()
    try:
        folder = Path(
            snapshot_download(hub_id, revision=revision, allow_patterns=list(patterns), local_files_only=here)
        )
        if here and not any(folder.rglob("*.safetensors")):
            raise LocalEntryNotFoundError("a part of the snapshot alone is here")
        return folder
    except LocalEntryNotFoundError as error:
        if here:
            found = f"{hub_id!r}, a hub id that was not fetched yet: its revision is not known offline"
            raise NotDownloaded(field, found=found, needed="a run, which fetches it, or a local folder") from None
        told = first_line(error)
    except (HfHubHTTPError, HFValidationError, OSError) as error:
        told = first_line(error)
    found = f"{hub_id!r}, which is no local path and was not fetched: {told.removeprefix('Got: ')}"
    needed = "a reachable hub; or fetch it elsewhere (hf download) and give its local folder" + sweep_hint(name)
    raise BadInput(field, found=found, needed=needed)


def list_shards(index: Path) -> list[Path]:
    """The files that an index of sharded weights names. Raises BadInput."""
    weight_map = read_json(index).get("weight_map")
    if not isinstance(weight_map, dict) or not weight_map:
        raise BadInput(index, found=f"weight_map {weight_map!r}", needed="the file of each tensor")
    return sorted({index.parent / str(name) for name in weight_map.values()})


def list_pickles(folder: Path) -> list[str]:
    """Names of the files that would have to be unpickled."""
    return sorted(path.name for path in folder.glob("*") if path.suffix in PICKLES)


def tensor_shapes(path: Path) -> dict[str, tuple[int, ...]]:
    """Names and shapes from a safetensors header. Raises BadInput for a file that is broken or cut off."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(str(path), framework="pt") as tensors:
            return {name: tuple(tensors.get_slice(name).get_shape()) for name in tensors.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise BadInput(path, found=first_line(error), needed="a complete safetensors file") from None


def check_missing(names: Sequence[str], where: Path) -> None:
    """Raises BadInput when weights are missing: diffusers and transformers would draw them at random."""
    if names:
        raise BadInput(where, found=f"no tensor for {names[0]} ({len(names)} missing)", needed="all weights")


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object. Raises BadInput."""
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise BadInput(path, found=first_line(error), needed="valid JSON") from None
    if not isinstance(value, dict):
        raise BadInput(path, found=type(value).__name__, needed="a JSON object")
    return value


def first_line(error: Exception) -> str:
    """The first line of an error's text, for a BadInput."""
    text = str(error).strip() or type(error).__name__
    return text.splitlines()[0][:200]
