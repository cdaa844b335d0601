"""Completion records: an attribute, written last, that marks a group of arrays as a complete entry.

The record has digests of the document and of every array's metadata, the checksum of every chunk, the subfolder that
holds the arrays, and a checksum (``seal`` on disk) of itself, the key and the recipe. An entry whose record is missing
or inconsistent counts as incomplete.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from datetime import UTC, datetime
from secrets import token_hex
from typing import Any

import zarr

from pipeline.errors import DzopError
from pipeline.spec import digest
from pipeline.store.keys import Ref

FORMAT = 1


class NewerEntry(DzopError):
    """An entry was written by a newer version; it cannot be read and must not be changed."""


def metadata_digest(array: zarr.Array) -> str:
    """Digest of an array's shape, dtype, chunks and codecs."""
    return digest(json.loads(json.dumps(array.metadata.to_dict(), default=str)))


def identity(ref: Ref) -> dict[str, Any]:
    """Attributes of an entry that is still being written: its key, recipe and inputs."""
    return {"format": FORMAT, "key": ref.key, "made_from": json.loads(ref.made_from)}


def complete_attributes(
    ref: Ref,
    arrays: Mapping[str, zarr.Array],
    document: Any,
    *,
    rows: int,
    time_s: float,
    nbytes: int,
    folder: str = "",
    chunks: Mapping[str, str] | None = None,
    made_by: Mapping[str, str] | None = None,
) -> dict[str, Any]:
    """Attributes of a complete entry: identity, document and completion record. Write them last, in one request.

    ``folder``: where its arrays are, relative to the entry. ``chunks``: array name -> checksums of its rows in hex.
    ``made_by``: the process that completes it, as ``machine.describe_machine`` gives it.
    """
    record = {
        "rows": rows,
        "bytes": nbytes,
        "time_s": round(time_s, 4),
        "at": datetime.now(UTC).isoformat(timespec="seconds"),
        "arrays": {name: metadata_digest(array) for name, array in arrays.items()},
        "document": digest(document),
        "folder": folder,
        "chunks": dict(chunks or {}),
        "made_by": dict(made_by or {}),
        "writer": token_hex(8),  # makes every record unique
    }
    known = identity(ref)
    seal = _checksum(ref.key, known["made_from"], record)
    return known | {"document": document, "complete": record | {"seal": seal}}


def completion_record(attributes: Mapping[str, Any], key: str) -> Mapping[str, Any] | None:
    """The completion record in an entry's attributes; None unless all its digests and its checksum match."""
    record = intact_record(attributes, "complete", key)
    try:
        return record if record and digest(attributes["document"]) == record["document"] else None
    except (KeyError, TypeError, ValueError):
        return None


def intact_record(attributes: Mapping[str, Any], name: str, key: str) -> Mapping[str, Any] | None:
    """A record of this entry under an attribute's name, None unless its checksum matches.

    ``damaged`` is the name of a completion record that was withdrawn.
    """
    try:
        record = dict(attributes[name])
        intact = (
            is_ours(attributes, key)
            and attributes["format"] == FORMAT
            and record["seal"] == _checksum(key, attributes["made_from"], _without_seal(record))
            and digest(attributes["made_from"]) == key
        )
    except (KeyError, TypeError, ValueError, AttributeError):
        return None
    return record if intact else None


def content_of(record: Mapping[str, Any]) -> Any:
    """The part of a completion record that is equal if two processes computed the same arrays.

    Entries without arrays are read in one request, so any complete one will do; their documents may differ in measured
    seconds. Older records do not list chunks: these are compared as a whole.
    """
    if not record["arrays"]:
        return "document"
    names = ("arrays", "chunks", "document") if record.get("chunks") else ("seal",)
    return [record[name] for name in names]


def withdraw_record(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Attributes with the completion record moved to ``damaged``, where it still identifies intact rows."""
    left = {name: value for name, value in attributes.items() if name not in ("complete", "damaged")}
    return left | ({"damaged": attributes["complete"]} if "complete" in attributes else {})


def is_ours(attributes: Mapping[str, Any], key: str) -> bool:
    """Whether these are attributes of the entry with this key, complete or not, in this or a newer format."""
    known = isinstance(attributes.get("format"), int) and isinstance(attributes.get("made_from"), Mapping)
    return known and attributes.get("key") == key


def check_format(attributes: Mapping[str, Any], where: str) -> None:
    """Raise NewerEntry for an entry of a newer format."""
    if is_newer(attributes):
        found = f"an entry of format {attributes['format']}, needs format {FORMAT}"
        raise NewerEntry(f"{where}: found {found}: update dzop, or use another store.root")


def is_newer(attributes: Mapping[str, Any]) -> bool:
    """Whether an entry's format is newer than the one this version writes."""
    found = attributes.get("format")
    return isinstance(found, int) and not isinstance(found, bool) and found > FORMAT


def _without_seal(record: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in record.items() if name != "seal"}


def _checksum(key: str, made_from: Any, record: Mapping[str, Any]) -> str:
    return digest([FORMAT, key, made_from, dict(record)])
