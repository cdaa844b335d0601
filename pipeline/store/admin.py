"""Maintenance of a store, for ``dzop cache``: list entries, verify their bytes, remove some."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from pipeline.errors import BadInput
from pipeline.store.completion import completion_record
from pipeline.store.entry import DamagedEntry
from pipeline.store.keys import Ref, make_ref
from pipeline.store.store import Store


@dataclass(frozen=True)
class EntryInfo:
    """One entry as ``dzop cache ls`` lists it. ``age_h``: hours since it was completed, None if it never was."""

    path: str
    complete: bool
    rows: int
    stored_bytes: int
    age_h: float | None
    kind: str
    made_from: Any

    @property
    def folder(self) -> str:
        """The path without the key."""
        return self.path.rpartition("/")[0]

    @property
    def key(self) -> str:
        """The entry's key."""
        return self.path.rpartition("/")[2]

    @property
    def ref(self) -> Ref:
        """Reference to read a complete entry by."""
        return make_ref(self.folder, self.made_from["recipe"], self.made_from["inputs"])


def list_entries(store: Store) -> list[EntryInfo]:
    """All entries, sorted by path."""
    return [_describe(store, path) for path in store.entry_paths()]


def _describe(store: Store, path: str) -> EntryInfo:
    attributes = store.attributes(path) or {}
    record = completion_record(attributes, path.rpartition("/")[2])
    made_from = attributes.get("made_from")
    recipe = made_from.get("recipe") if isinstance(made_from, dict) else None
    return EntryInfo(
        path=path,
        complete=record is not None,
        rows=0 if record is None else int(record["rows"]),
        stored_bytes=store.stored_bytes(path),
        age_h=None if record is None else _hours_since(record["at"]),
        kind=str(recipe.get("kind", "?")) if isinstance(recipe, dict) else "?",
        made_from=made_from,
    )


def _hours_since(time: str) -> float:
    seconds = (datetime.now(UTC) - datetime.fromisoformat(time)).total_seconds()
    return max(0.0, seconds / 3600)  # the clock may have been set back since


def verify(store: Store) -> dict[str, str]:
    """Read every byte of every entry: path -> problem, "" for an intact entry.

    A damaged entry is marked incomplete, so that the next run repairs it.
    """
    return {entry.path: _find_problem(store, entry) for entry in list_entries(store)}


def _find_problem(store: Store, info: EntryInfo) -> str:
    if not info.complete:
        return "incomplete: the next run that needs it completes it"
    try:
        entry = store.read(info.ref)
        for name in entry.arrays:
            for row in range(entry.rows):
                entry.array(name, [row])
    except DamagedEntry as damage:
        return str(damage)
    return ""


def collect_garbage(store: Store, *, older_than_h: float | None, dry_run: bool) -> list[EntryInfo]:
    """Remove incomplete entries, and complete ones older than ``older_than_h`` if given; returns them.

    ``dry_run`` removes nothing. Where the store has locks, an entry that is being written is waited for and kept.
    """
    garbage = [entry for entry in list_entries(store) if not entry.complete or _is_older(entry, older_than_h)]
    for entry in [] if dry_run else garbage:
        with store.backend.lock(entry.key, store.announce):
            if _describe(store, entry.path).complete == entry.complete:  # not completed while we waited
                store.delete(entry.path)
    return garbage


def _is_older(entry: EntryInfo, hours: float | None) -> bool:
    return hours is not None and (entry.age_h or 0.0) > hours


def find_entry(store: Store, prefix: str) -> EntryInfo:
    """The only entry whose key starts with ``prefix``. Raises BadInput for none or several."""
    found = [path for path in store.entry_paths() if path.rpartition("/")[2].startswith(prefix)]
    if len(found) != 1:
        found_text = f"{len(found)} entries whose key starts with {prefix!r}"
        raise BadInput("cache path", found=found_text, needed="exactly one")
    return _describe(store, found[0])
