"""Completion records: the attribute, written last, that turns a group of arrays into a usable entry.

The record holds digests of the document and of every array's metadata, and a checksum (``seal`` on disk) over itself,
the key and the recipe. An entry whose record is missing or inconsistent counts as incomplete.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any

import zarr

from pipeline.spec import digest
from pipeline.store.keys import Ref

FORMAT = 1


def metadata_digest(array: zarr.Array) -> str:
    """Digest of an array's shape, dtype, chunks and codecs."""
    return digest(json.loads(json.dumps(array.metadata.to_dict(), default=str)))


def identity(ref: Ref) -> dict[str, Any]:
    """Attributes of an entry that is still being written: its key and what it is made from."""
    return {"format": FORMAT, "key": ref.key, "made_from": json.loads(ref.made_from)}


def complete_attributes(
    ref: Ref,
    arrays: Mapping[str, zarr.Array],
    document: Any,
    *,
    rows: int,
    time_s: float,
    nbytes: int,
) -> dict[str, Any]:
    """Attributes of a complete entry: its identity, document and completion record. Write them last, in one request."""
    record = {
        "rows": rows,
        "bytes": nbytes,
        "time_s": round(time_s, 4),
        "at": datetime.now(UTC).isoformat(timespec="seconds"),
        "arrays": {name: metadata_digest(array) for name, array in arrays.items()},
        "document": digest(document),
    }
    known = identity(ref)
    seal = _checksum(ref.key, known["made_from"], record)
    return known | {"document": document, "complete": record | {"seal": seal}}


def completion_record(attributes: Mapping[str, Any], key: str) -> Mapping[str, Any] | None:
    """The completion record among an entry's attributes; None unless every digest and the checksum match."""
    try:
        record = dict(attributes["complete"])
        seal = record.pop("seal")
        intact = (
            attributes["key"] == key
            and attributes["format"] == FORMAT
            and seal == _checksum(key, attributes["made_from"], record)
            and digest(attributes["document"]) == record["document"]
            and digest(attributes["made_from"]) == key
        )
    except (KeyError, TypeError, ValueError, AttributeError):
        return None
    return record if intact else None


def _checksum(key: str, made_from: Any, record: Mapping[str, Any]) -> str:
    return digest([FORMAT, key, made_from, dict(record)])
