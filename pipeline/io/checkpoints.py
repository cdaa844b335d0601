"""Weight files of any model: located on disk or downloaded from a hub, listed and read. safetensors only."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from types import MappingProxyType
from typing import Any

from pipeline.errors import BadInput
from pipeline.io.files import read_file

PICKLES = (".bin", ".ckpt", ".pt", ".pth")
_OTHER_CONTENT = {
    b"version https://git-lfs": "a git-lfs pointer instead of the file: run `git lfs pull`, or download it again",
    b"<!doctype html": "a web page instead of the file: download it again, with a token if the model is gated",
    b"<html": "a web page instead of the file: download it again, with a token if the model is gated",
    b"entry not found": "a hub's error message instead of the file: download it again",
    b"access to model": "a hub's error message instead of the file: the model is gated, download it with a token",
    b"invalid username": "a hub's error message instead of the file: download it again",
    b'{"error"': "a hub's error message instead of the file: download it again",
    b"gguf": "a GGUF file, which holds quantised weights",
    b"pk\x03\x04": "a zip archive or pickled weights, which are never loaded",
    b"\x80\x02": "pickled weights, which are never loaded",
}
"""Beginnings (lower case) of files that are often mistaken for weights."""
_offline: ContextVar[bool] = ContextVar("offline", default=False)


def sweep_hint(name: str) -> str:
    """Message suffix with the option that sets these weights for all methods of a sweep."""
    return f" (weights.{name}=FOLDER sets it for all methods)"


class NotDownloaded(BadInput):
    """Inside ``offline()``, the weights of a hub id are not in the local hub cache."""


@contextmanager
def offline() -> Iterator[None]:
    """Disable downloads inside the block, because a plan must be free."""
    token = _offline.set(True)
    try:
        yield
    finally:
        _offline.reset(token)


def is_local(weights: str) -> bool:
    """True for a path rather than a hub id: it exists, starts like a path, or has the suffix of a weight file."""
    return (
        weights.startswith(("/", "./", "../", "~"))
        or weights.endswith((".safetensors", *PICKLES))
        or Path(weights).exists()
    )


def fetch_snapshot(
    hub_id: str,
    revision: str | None,
    patterns: Sequence[str],
    *,
    field: str,
    name: str,
    mirrors: Mapping[str, str] = MappingProxyType({}),
) -> Path:
    """Local folder with the hub's files matching ``patterns``, downloaded if necessary.

    Raises BadInput for ``field`` with the hint ``sweep_hint(name)``, and NotDownloaded inside ``offline()``.
    ``mirrors``: ids that were removed from the hub -> ids that have the same weights, for the message.
    """
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import HfHubHTTPError, HFValidationError, LocalEntryNotFoundError

    local_only = _offline.get()
    try:
        folder = Path(
            snapshot_download(hub_id, revision=revision, allow_patterns=list(patterns), local_files_only=local_only)
        )
        if local_only and not any(folder.rglob("*.safetensors")):
            raise LocalEntryNotFoundError("only a part of the snapshot is in the local cache")
        return folder
    except LocalEntryNotFoundError as error:
        if local_only:
            found = f"{hub_id!r}, a hub id that is not downloaded yet: its revision is not known offline"
            raise NotDownloaded(field, found=found, needed="a run, which downloads it, or a local folder") from None
        cause: Exception = error
    except (HfHubHTTPError, HFValidationError, OSError) as error:
        cause = error
    reason = first_line(cause).removeprefix("Got: ")
    found = f"{hub_id!r}, which is not a local path and could not be downloaded: {reason}"
    needed = f"{_name_remedy(hub_id, cause, mirrors)}; or its local folder, downloaded elsewhere (hf download)"
    raise BadInput(field, found=found, needed=needed + sweep_hint(name))


def _name_remedy(hub_id: str, error: Exception, mirrors: Mapping[str, str]) -> str:
    """What to change so that a download that failed with ``error`` succeeds."""
    from huggingface_hub.errors import GatedRepoError, RepositoryNotFoundError

    if hub_id in mirrors:
        return f"{mirrors[hub_id]}, a mirror of the same weights: this repository was removed from the hub"
    if isinstance(error, GatedRepoError):
        return "its licence accepted on the model's page of the hub, and a login (hf auth login)"
    if isinstance(error, RepositoryNotFoundError):
        others = ", ".join(sorted(set(mirrors.values())))
        return "an id that the hub serves" + (f", such as {others}" if others else "")
    return "a reachable hub"


def list_shards(index: Path) -> list[Path]:
    """Files named in the index of sharded weights, sorted. Raises BadInput."""
    weight_map = read_json(index).get("weight_map")
    if not isinstance(weight_map, dict) or not weight_map:
        raise BadInput(index, found=f"weight_map {weight_map!r}", needed="the file of each tensor")
    names = sorted({str(name) for name in weight_map.values()})
    for name in names:
        if name != Path(name).name or name in ("", ".", ".."):
            raise BadInput(index, found=f"a shard named {name[:80]!r}", needed="file names in the index's folder")
    return [index.parent / name for name in names]


def list_pickles(folder: Path) -> list[str]:
    """Names of pickled weight files in a folder, sorted; these are never loaded."""
    return sorted(path.name for path in folder.glob("*") if path.suffix in PICKLES)


def tensor_shapes(path: Path) -> dict[str, tuple[int, ...]]:
    """Shape of each tensor by name, from a safetensors header. Raises BadInput for a broken or truncated file."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(str(path), framework="pt") as tensors:
            return {name: tuple(tensors.get_slice(name).get_shape()) for name in tensors.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        found = describe_other_content(path) or first_line(error)
        raise BadInput(path, found=found, needed="a complete safetensors file") from None


def describe_other_content(path: Path) -> str:
    """What a file is instead of weights or a config, such as a git-lfs pointer; "" if it is no known mistake."""
    try:
        with path.open("rb") as file:
            head = file.read(512)
    except OSError:
        return ""
    text = head.lstrip().lower()
    for beginning, content in _OTHER_CONTENT.items():
        if text.startswith(beginning):
            return content
    return "an empty file" if not head else ""


def resolve_hub_cache(folder: Path, field: str) -> Path:
    """The folder, or the snapshot in it if it is a model's folder in the hub cache (refs, blobs, snapshots).

    Raises BadInput, listing the snapshots, unless there is exactly one.
    """
    if not ((folder / "snapshots").is_dir() and ((folder / "blobs").is_dir() or (folder / "refs").is_dir())):
        return folder
    snapshots = sorted(path for path in (folder / "snapshots").iterdir() if path.is_dir())
    if len(snapshots) == 1:
        return snapshots[0]
    names = ", ".join(path.name for path in snapshots) or "none"
    found = f"{str(folder)!r}, a model's folder in the hub's cache with {len(snapshots)} snapshots"
    raise BadInput(field, found=found, needed=f"one of its folders snapshots/<commit>: {names}")


def check_missing(names: Sequence[str], where: Path) -> None:
    """Raise BadInput for missing ``names``, which diffusers and transformers would initialise at random."""
    if names:
        raise BadInput(where, found=f"no tensor for {names[0]} ({len(names)} missing)", needed="all weights")


def read_json(path: Path) -> dict[str, Any]:
    """A JSON file's object. Raises BadInput."""
    try:
        value = json.loads(read_file(path, "valid JSON"))
    except (ValueError, RecursionError) as error:
        found = describe_other_content(path) or first_line(error)
        raise BadInput(path, found=found, needed="valid JSON") from None
    if not isinstance(value, dict):
        raise BadInput(path, found=type(value).__name__, needed="a JSON object")
    return value


def first_line(error: Exception) -> str:
    """First line of an error's text, at most 200 characters, for a BadInput."""
    text = str(error).strip() or type(error).__name__
    return text.splitlines()[0][:200]
