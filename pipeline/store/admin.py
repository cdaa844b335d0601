"""Maintenance of a store, for ``dzop cache``: list entries, verify their bytes, remove some."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from pipeline.errors import BadInput, DzopError
from pipeline.store.arrays import delete_keys, list_keys, read_bytes, write_attributes
from pipeline.store.completion import completion_record, is_newer
from pipeline.store.entry import DamagedEntry, withdraw
from pipeline.store.keys import Ref, make_ref
from pipeline.store.leases import live_leases, remove_expired_leases
from pipeline.store.store import Store
from pipeline.store.writing import MARKER

COMPLETE, INCOMPLETE, NEWER, FOREIGN = "complete", "incomplete", "newer", "foreign"
"""States of an entry. Newer: written in a newer format. Foreign: a folder named like an entry, without our marker."""


@dataclass(frozen=True)
class EntryInfo:
    """One entry as ``dzop cache ls`` lists it. ``age_h``: hours since completion, None if incomplete.

    ``made_by``: the process that completed it (``pipeline.machine``), empty for older entries.
    """

    path: str
    state: str
    rows: int
    stored_bytes: int
    age_h: float | None
    kind: str
    made_from: Any
    made_by: Mapping[str, str]

    @property
    def complete(self) -> bool:
        """Whether it is complete and readable by this version."""
        return self.state == COMPLETE

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
    state, attributes, record = _read_state(store, path)
    made_from = attributes.get("made_from")
    recipe = made_from.get("recipe") if isinstance(made_from, dict) else None
    return EntryInfo(
        path=path,
        state=state,
        rows=0 if record is None else int(record["rows"]),
        stored_bytes=store.stored_bytes(path),
        age_h=None if record is None else _hours_since(record["at"]),
        kind=str(recipe.get("kind", "?")) if isinstance(recipe, dict) else "?",
        made_from=made_from,
        made_by={} if record is None else record.get("made_by", {}),
    )


def _read_state(store: Store, path: str) -> tuple[str, Mapping[str, Any], Mapping[str, Any] | None]:
    """State, attributes and completion record of an entry."""
    attributes = store.attributes(path) or {}
    if is_newer(attributes):
        return NEWER, attributes, None
    record = completion_record(attributes, path.rpartition("/")[2])
    if record is not None:
        return COMPLETE, attributes, record
    return INCOMPLETE if store.is_ours(path) else FOREIGN, attributes, None


def _hours_since(time: str) -> float:
    seconds = (datetime.now(UTC) - datetime.fromisoformat(time)).total_seconds()
    return max(0.0, seconds / 3600)  # the clock may have been set back in the meantime


def verify(store: Store) -> dict[str, str]:
    """Read every byte of every entry: path -> problem, "" for an intact entry.

    A damaged entry is marked incomplete, so that the next run repairs it. Skips entries of a newer format, with a
    message, and folders that are not entries.
    """
    return {entry.path: _find_problem(store, entry) for entry in _own_entries(store, "not verified")}


def _own_entries(store: Store, consequence: str) -> list[EntryInfo]:
    """Entries that this version may read and remove; prints a message for each of the others."""
    reasons = {NEWER: "is of a newer format; update dzop", FOREIGN: "has no marker of dzop, so it is not an entry"}
    entries = list_entries(store)
    for entry in entries:
        if entry.state in reasons:
            store.announce(f"{entry.path}: {consequence}: it {reasons[entry.state]}")
    return [entry for entry in entries if entry.state not in reasons]


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

    ``dry_run`` removes nothing. Entries in use by a running process, folders without our marker and entries of a newer
    format are kept, with a message. Where the store has locks, this waits for an entry that is being written and
    keeps it.
    """
    leases = live_leases(store.backend.zarr)
    garbage = []
    for entry in _own_entries(store, "kept"):
        is_garbage = not entry.complete or _is_older(entry, older_than_h)
        if entry.key in leases:
            if is_garbage:
                store.announce(f"{entry.path}: kept: process {leases[entry.key]} uses it")
        elif not is_garbage:
            if not dry_run:
                _remove_leftovers(store, entry)
        elif dry_run or _remove(store, entry):
            garbage.append(entry)
    if not dry_run:
        remove_expired_leases(store.backend.zarr)
    return garbage


def _remove(store: Store, entry: EntryInfo) -> bool:
    """Remove an entry unless it was completed or leased since it was listed."""
    with store.backend.lock(entry.key, store.announce):
        keys, (state, before, _) = list_keys(store.backend.zarr, entry.path), _read_state(store, entry.path)
        if state != entry.state:
            return False
        withdraw(store.backend, entry.path)  # from now on, a process that takes a lease finds no complete entry
        if entry.key in live_leases(store.backend.zarr):
            if before:
                write_attributes(store.backend.zarr, entry.path, before)
            store.announce(f"{entry.path}: kept: a process has just begun to use it")
            return False
        if store.backend.has_locks:
            store.delete(entry.path)
        else:  # only keys from before we looked for leases: a writer may have started since
            delete_keys(store.backend.zarr, keys)
        return True


def _remove_leftovers(store: Store, entry: EntryInfo) -> None:
    """Remove leftovers of other writers from a complete entry: folders that its record does not name, and journals."""
    with store.backend.lock(entry.key, store.announce):
        keys, attributes = list_keys(store.backend.zarr, entry.path), store.attributes(entry.path) or {}
        record = completion_record(attributes, entry.key)
        if record is None or entry.key in live_leases(store.backend.zarr):
            return
        used = [f"{record['folder']}/"] if record.get("folder") else [f"{name}/" for name in record["arrays"]]
        keep = tuple(f"{entry.path}/{name}" for name in (*used, "zarr.json", MARKER))
        delete_keys(store.backend.zarr, [key for key in keys if not key.startswith(keep)])


def _is_older(entry: EntryInfo, hours: float | None) -> bool:
    return hours is not None and (entry.age_h or 0.0) >= hours


def find_entry(store: Store, prefix: str) -> EntryInfo:
    """The only entry whose key starts with ``prefix``. Raises BadInput for none or several."""
    paths = [path for path in store.entry_paths() if path.rpartition("/")[2].startswith(prefix)]
    found = [path for path in paths if store.is_ours(path)]
    if len(found) != 1:
        found_text = f"{len(found)} entries whose key starts with {prefix!r}"
        raise BadInput("cache path", found=found_text, needed="exactly one")
    return _describe(store, found[0])


def check_is_store(store: Store) -> None:
    """Raise DzopError for a folder or bucket that is neither a store nor empty.

    A store has our marker in its root, or locks or entries if only older versions wrote to it.
    """
    zarr = store.backend.zarr
    if read_bytes(zarr, MARKER) is not None or (store.backend.folder and (store.backend.folder / ".locks").is_dir()):
        return
    keys = [key for key in list_keys(zarr, "") if not key.startswith(".")]
    if keys and not any(store.is_ours(path) for path in store.entry_paths()):
        raise DzopError(f"{store.place}: found a folder that is not a store, needs one that a run has written (--root)")
