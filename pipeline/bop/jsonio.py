"""JSON files and their fields, validated as they are read."""

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

_MAX_RATIO, _MAX_BYTES = 100, 1 << 26
"""gzip compresses JSON about tenfold. A file that exceeds both limits is a decompression bomb."""


def read_json(path: Path) -> Any:
    """Contents of a ``.json`` or ``.json.gz`` file, UTF-8 with or without a byte order mark.

    Raises BadInput: for a syntax error with line and column; also for a duplicate name in an object, where Python's
    json would silently keep the last value.
    """
    try:
        data = read_file(path, "a JSON file")
        text = (_decompress(path, data) if path.suffix == ".gz" else data).decode("utf-8-sig")
    except (OSError, EOFError, zlib.error, UnicodeDecodeError) as error:
        raise BadInput(path, found=f"{type(error).__name__}: {error}", needed="a readable JSON file") from None
    try:
        return json.loads(text, object_pairs_hook=_parse_object)
    except json.JSONDecodeError as error:
        found = f"invalid JSON at line {error.lineno}, column {error.colno} ({error.msg})"
        raise BadInput(path, found=found, needed="valid JSON") from None
    except RecursionError:
        raise BadInput(path, found="JSON nested too deeply", needed="valid JSON") from None
    except ValueError as error:  # a repeated name, or an integer with more digits than Python parses
        raise BadInput(path, found=str(error).split(";")[0], needed="valid JSON") from None


def _decompress(path: Path, data: bytes) -> bytes:
    limit = max(_MAX_BYTES, _MAX_RATIO * len(data))
    with gzip.open(io.BytesIO(data)) as stream:
        text = stream.read(limit + 1)
    if len(text) > limit:
        found = f"{len(data)} bytes that decompress to more than {limit}"
        raise BadInput(path, found=found, needed="compressed JSON; decompress it first if it is")
    return text


def _parse_object(pairs: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"the name {next(n for n in names if names.count(n) > 1)[:40]!r} twice in one object")
    return content


_ID = re.compile(r"-?[0-9]{1,18}")


def read_by_id(path: Path) -> dict[int, Any]:
    """A JSON object keyed by ids ("17": ...), such as scene_camera.json or models_info.json."""
    content = read_json(path)
    if not isinstance(content, dict):
        raise BadInput(path, found=f"a JSON {_json_type(content)}", needed="a JSON object keyed by id")
    invalid = next((key for key in content if not _ID.fullmatch(key)), None)
    if invalid is not None:
        raise BadInput(path, found=f"the key {invalid[:40]!r}", needed="integer ids as keys")
    values = {int(key): value for key, value in content.items()}
    if len(values) < len(content):
        raise BadInput(path, found="an id written in two ways", needed="each id once")
    return values


def describe_place(path: Path, *, field: str = "", **ids: int) -> str:
    """A location for messages: ``p, scene=2, image=17, field="cam_K"`` gives "p, scene 2, image 17, field cam_K"."""
    parts = [str(path), *(f"{name} {value}" for name, value in ids.items()), *([f"field {field}"] if field else [])]
    return ", ".join(parts)


def get_field(record: Any, field: str, where: str) -> Any:
    """A field of a JSON object. Raises BadInput if it is missing."""
    if not isinstance(record, dict):
        raise BadInput(where, found=f"a JSON {_json_type(record)}", needed=f"a JSON object with the field {field}")
    if field not in record:
        raise BadInput(f"{where}, field {field}", found="nothing", needed=f"the field (there: {', '.join(record)})")
    return record[field]


def get_integer(record: Any, field: str, where: str) -> int:
    """An integer field of at most 63 bits. Raises BadInput."""
    value = get_field(record, field, where)
    if type(value) is not int or abs(value) >= 1 << 63:
        raise BadInput(f"{where}, field {field}", found=abbreviate(value), needed="an integer")
    return value


def get_numbers(record: Any, field: str, count: int, where: str) -> Float[np.ndarray, " n"]:
    """A field of ``count`` finite numbers. Raises BadInput."""
    return parse_vector(get_field(record, field, where), count, f"{where}, field {field}")


def parse_vector(value: Any, count: int, where: str) -> Float[np.ndarray, " n"]:
    """A JSON list of ``count`` finite numbers as an array. Raises BadInput."""
    if not isinstance(value, list) or len(value) != count or not all(is_number(v) for v in value):
        raise BadInput(where, found=abbreviate(value), needed=f"{count} numbers")
    array = np.array(value, dtype=np.float64)
    if not np.isfinite(array).all():
        at = int(np.flatnonzero(~np.isfinite(array))[0])
        raise BadInput(where, found=f"{array[at]} at position {at}", needed=f"{count} finite numbers")
    return array


def is_number(value: Any) -> bool:
    """True for a float, and for an int below 2^63; False for a bool."""
    return isinstance(value, float) or (type(value) is int and abs(value) < 1 << 63)


def abbreviate(value: Any, *, length: int = 60) -> str:
    """A JSON value as one short line of text; a truncated list or object is followed by its number of elements."""
    try:
        text = json.dumps(value)
    except (RecursionError, ValueError):
        return f"a JSON {_json_type(value)} too large to show"
    if len(text) <= length:
        return text
    return f"{text[:length]}... ({len(value)} elements)" if isinstance(value, (list, dict)) else f"{text[:length]}..."


def _json_type(value: Any) -> str:
    names = {dict: "object", list: "list", str: "string", bool: "boolean", type(None): "null"}
    return names.get(type(value), "number")
