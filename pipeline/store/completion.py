"""What makes an entry count: a record written last, sealed over all it vouches for."""

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
    """The attributes of an entry that is not complete yet: what it will be made from."""
    return {"format": FORMAT, "key": ref.key, "made_from": json.loads(ref.made_from)}


def finished(
    ref: Ref,
    arrays: Mapping[str, zarr.Array],
    document: Any,
    *,
    rows: int,
    time_s: float,
    nbytes: int,
) -> dict[str, Any]:
    """All attributes of a complete entry. Written last and at once, they make it count."""
    record = {
        "rows": rows,
        "bytes": nbytes,
        "time_s": round(time_s, 4),
        "at": datetime.now(UTC).isoformat(timespec="seconds"),
        "arrays": {name: metadata_digest(array) for name, array in arrays.items()},
        "document": digest(document),
    }
    known = identity(ref)
    return known | {"document": document, "complete": record | {"seal": _seal(ref.key, known["made_from"], record)}}


def _seal(key: str, made_from: Any, record: Mapping[str, Any]) -> str:
    return digest([FORMAT, key, made_from, dict(record)])


def completeness(attributes: Mapping[str, Any], key: str) -> Mapping[str, Any] | None:
    """An entry's record of completeness from its attributes, None unless every part of it holds together."""
    try:
        record = dict(attributes["complete"])
        seal = record.pop("seal")
        whole = (
            attributes["key"] == key
            and attributes["format"] == FORMAT
            and seal == _seal(key, attributes["made_from"], record)
            and digest(attributes["document"]) == record["document"]
            and digest(attributes["made_from"]) == key
        )
    except (KeyError, TypeError, ValueError, AttributeError):
        return None
    return record if whole else None
