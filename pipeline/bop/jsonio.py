"""JSON files and their fields, checked where they are read."""

from __future__ import annotations

import gzip
import io
import json
import re
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.errors import BadInput
from pipeline.io.files import read_file

_PACKED_TIMES, _PACKED_BYTES = 100, 1 << 26
"""JSON unpacks to ten times its size or so; what unpacks to more than 100 times it and 64 MiB is to fill memory."""


def read_json(path: Path) -> Any:
    """Contents of a ``.json`` or ``.json.gz`` file, UTF-8 with or without a byte order mark.

    Raises BadInput, with the line for a syntax error; also for a name that an object has twice, since one of its
    two values would be lost.
    """
    try:
        data = read_file(path, "a JSON file")
        text = (_unpacked(path, data) if path.suffix == ".gz" else data).decode("utf-8-sig")
    except (OSError, EOFError, zlib.error, UnicodeDecodeError) as error:
        raise BadInput(path, found=f"{type(error).__name__}: {error}", needed="a readable JSON file") from None
    try:
        return json.loads(text, object_pairs_hook=_object)
    except json.JSONDecodeError as error:
        found = f"invalid JSON at line {error.lineno}, column {error.colno} ({error.msg})"
        raise BadInput(path, found=found, needed="valid JSON") from None
    except RecursionError:
        raise BadInput(path, found="JSON nested too deeply", needed="valid JSON") from None
    except ValueError as error:  # a name twice, or an integer of more digits than Python reads
        raise BadInput(path, found=str(error).split(";")[0], needed="valid JSON") from None


def _unpacked(path: Path, data: bytes) -> bytes:
    most = max(_PACKED_BYTES, _PACKED_TIMES * len(data))
    with gzip.open(io.BytesIO(data)) as stream:
        text = stream.read(most + 1)
    if len(text) > most:
        found = f"{len(data)} bytes that unpack to more than {most}"
        raise BadInput(path, found=found, needed="packed JSON; unpack it first if it is")
    return text


def _object(pairs: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"the name {next(n for n in names if names.count(n) > 1)[:40]!r} twice in one object")
    return content


_ID = re.compile(r"-?[0-9]{1,18}")


def read_by_id(path: Path) -> dict[int, Any]:
    """A JSON object keyed by ids ("17": ...), as scene_camera.json and models_info.json are."""
    content = read_json(path)
    if not isinstance(content, dict):
        raise BadInput(path, found=f"a JSON {_kind(content)}", needed="a JSON object keyed by id")
    strange = next((key for key in content if not _ID.fullmatch(key)), None)
    if strange is not None:
        raise BadInput(path, found=f"the key {strange[:40]!r}", needed="integer ids as keys")
    found = {int(key): value for key, value in content.items()}
    if len(found) < len(content):
        raise BadInput(path, found="an id written in two ways", needed="every id once")
    return found


def describe_place(path: Path, *, field: str = "", **ids: int) -> str:
    """Where in a file: ``place(p, scene=2, image=17, field="cam_K")`` is "p, scene 2, image 17, field cam_K"."""
    parts = [str(path), *(f"{name} {value}" for name, value in ids.items()), *([f"field {field}"] if field else [])]
    return ", ".join(parts)


def get_field(record: Any, field: str, where: str) -> Any:
    """A field of a JSON object. Raises BadInput when it is not there."""
    if not isinstance(record, dict):
        raise BadInput(where, found=f"a JSON {_kind(record)}", needed=f"a JSON object with the field {field}")
    if field not in record:
        raise BadInput(f"{where}, field {field}", found="nothing", needed=f"the field (there: {', '.join(record)})")
    return record[field]


def get_integer(record: Any, field: str, where: str) -> int:
    """An integer field."""
    value = get_field(record, field, where)
    if type(value) is not int or abs(value) >= 1 << 63:
        raise BadInput(f"{where}, field {field}", found=abbreviate(value), needed="an integer")
    return value


def get_numbers(record: Any, field: str, count: int, where: str) -> Float[np.ndarray, " n"]:
    """A field of ``count`` finite numbers."""
    return parse_vector(get_field(record, field, where), count, f"{where}, field {field}")


def parse_vector(value: Any, count: int, where: str) -> Float[np.ndarray, " n"]:
    """A JSON list of ``count`` finite numbers."""
    if not isinstance(value, list) or len(value) != count or not all(is_number(v) for v in value):
        raise BadInput(where, found=abbreviate(value), needed=f"{count} numbers")
    array = np.array(value, dtype=np.float64)
    if not np.isfinite(array).all():
        at = int(np.flatnonzero(~np.isfinite(array))[0])
        raise BadInput(where, found=f"{array[at]} at position {at}", needed=f"{count} finite numbers")
    return array


def is_number(value: Any) -> bool:
    """True for float, and for int that a float can hold; not for bool."""
    return isinstance(value, float) or (type(value) is int and abs(value) < 1 << 63)


def abbreviate(value: Any, *, length: int = 60) -> str:
    """A value as text of one short line; long lists say how many elements they have."""
    try:
        text = json.dumps(value)
    except (RecursionError, ValueError):
        return f"a JSON {_kind(value)} too large to show"
    if len(text) <= length:
        return text
    return f"{text[:length]}... ({len(value)} elements)" if isinstance(value, (list, dict)) else f"{text[:length]}..."


def _kind(value: Any) -> str:
    names = {dict: "object", list: "list", str: "string", bool: "boolean", type(None): "null"}
    return names.get(type(value), "number")
