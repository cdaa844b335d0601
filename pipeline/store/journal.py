"""Journal of an unfinished entry: the rows each writer has stored, with the checksums of their chunks.

A run that resumes the entry keeps a row only if one writer stored its chunks in all arrays, and these still match that
writer's checksums. The journal is removed on completion, when the completion record takes over the checksums.
"""

from __future__ import annotations

import asyncio
import json
import time
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
RUNNING_S = 120.0  # a writer that stored rows more recently may still be running


@dataclass(frozen=True)
class StoredRows:
    """Rows that one writer stored in its folder of the entry: checksums by array name and row."""

    folder: str
    checksums: Mapping[str, RowChecksums]

    @property
    def rows(self) -> set[int]:
        """Rows that have a chunk in every array."""
        return set.intersection(*(set(rows) for rows in self.checksums.values())) if self.checksums else set()


def note_rows(
    store: ZarrStore, ref: Ref, writer: str, *, folder: str, first: int, arrays: Mapping[str, str], chunks: Any
) -> None:
    """Add consecutive rows to the journal.

    ``arrays``: array name -> digest of its metadata. ``chunks``: array name -> checksums of the rows in hex.
    """
    content = {"folder": folder, "first": first, "arrays": dict(arrays), "chunks": chunks, "at": time.time()}
    text = json.dumps(content | {"seal": digest([ref.key, content])})
    write_bytes(store, f"{ref.path}/{FOLDER}/{writer}-{first}", text.encode())


def note_end(store: ZarrStore, ref: Ref, writer: str, *, folder: str) -> None:
    """Record that the writer ended early, so that others may take over its rows without waiting."""
    note_rows(store, ref, writer, folder=folder, first=-1, arrays={}, chunks={})


def read_journal(store: ZarrStore, ref: Ref, arrays: Mapping[str, str], *, has_locks: bool) -> list[StoredRows]:
    """Rows stored by all writers of an entry whose arrays have this metadata, and those in its withdrawn record.

    Without locks, rows of writers that may still be running are left out, so that no entry mixes rows of two writers
    whose bytes differ.
    """
    found: list[StoredRows] = []
    (attributes,) = read_attributes(store, [ref.path])
    notes = _read_notes(store, ref)
    running = set() if has_locks else _running_writers(notes)
    records: list[Any] = [note for note in notes if note.get("folder") not in running]
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


def _running_writers(notes: Sequence[Mapping[str, Any]]) -> set[str]:
    """Folders of writers that wrote to the journal recently and have not recorded their end."""
    recent = {note["folder"] for note in notes if abs(time.time() - note["at"]) < RUNNING_S}
    return recent - {note["folder"] for note in notes if note["first"] == -1}


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
