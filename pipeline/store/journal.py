"""Journal of an unfinished entry: which rows a writer has stored, and the checksums of their chunks.

A run that resumes the entry keeps a row only if one writer stored its chunks of all arrays, and these still have the
checksums that this writer noted. The journal ends with the entry's completion, whose record has the same checksums.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from zarr.abc.store import Store as ZarrStore
from zarr.core.buffer import default_buffer_prototype
from zarr.core.sync import sync

from pipeline.spec import digest
from pipeline.store.arrays import list_keys, read_attributes, write_bytes
from pipeline.store.checksums import RowChecksums, from_hex
from pipeline.store.completion import intact_record
from pipeline.store.keys import Ref

FOLDER = ".written"


@dataclass(frozen=True)
class StoredRows:
    """Rows that one writer stored in a folder of the entry: checksums by array name and row."""

    folder: str
    checksums: Mapping[str, RowChecksums]

    @property
    def rows(self) -> set[int]:
        """Rows with a chunk of every array."""
        return set.intersection(*(set(rows) for rows in self.checksums.values())) if self.checksums else set()


def note_rows(
    store: ZarrStore, ref: Ref, writer: str, *, folder: str, first: int, arrays: Mapping[str, str], chunks: Any
) -> None:
    """Add consecutive rows to the journal.

    ``arrays``: array name -> digest of its metadata. ``chunks``: array name -> checksums of the rows in hex.
    """
    content = {"folder": folder, "first": first, "arrays": dict(arrays), "chunks": chunks}
    text = json.dumps(content | {"seal": digest([ref.key, content])})
    write_bytes(store, f"{ref.path}/{FOLDER}/{writer}-{first}", text.encode())


def read_journal(store: ZarrStore, ref: Ref, arrays: Mapping[str, str]) -> list[StoredRows]:
    """What writers stored of an entry whose arrays have this metadata; also what its withdrawn record lists."""
    found: list[StoredRows] = []
    (attributes,) = read_attributes(store, [ref.path])
    records: list[Any] = _read_notes(store, ref)
    if attributes is not None and (damaged := intact_record(attributes, "damaged", ref.key)):
        records.append(dict(damaged) | {"first": 0})
    for record in records:
        try:
            if record["arrays"] != arrays or not isinstance(record["folder"], str):
                continue
            checksums = {name: from_hex(text, record["first"]) for name, text in record["chunks"].items()}
            if checksums.keys() == arrays.keys():
                found.append(StoredRows(record["folder"], checksums))
        except (KeyError, TypeError, ValueError, AttributeError):  # a record without checksums, of an older version
            continue
    return found


def forget_rows(store: ZarrStore, ref: Ref) -> None:
    """Remove the journal."""
    sync(store.delete_dir(f"{ref.path}/{FOLDER}"))


def _read_notes(store: ZarrStore, ref: Ref) -> list[Any]:
    keys: Sequence[str] = sorted(list_keys(store, f"{ref.path}/{FOLDER}"))

    async def read_all() -> list[Any]:
        return await asyncio.gather(*(store.get(key, default_buffer_prototype()) for key in keys))

    notes = [_parse(value.to_bytes(), ref) for value in sync(read_all()) if value is not None]
    return [note for note in notes if note is not None]


def _parse(text: bytes, ref: Ref) -> dict[str, Any] | None:
    try:
        note = json.loads(text)
        seal = note.pop("seal")
        return note if seal == digest([ref.key, note]) else None
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None
