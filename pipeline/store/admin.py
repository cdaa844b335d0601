"""``dzop cache``: what is in a store, what it takes, whether it is whole, and how to make room."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from pipeline.errors import BadInput
from pipeline.store.completion import completeness
from pipeline.store.entries import DamagedEntry, Store
from pipeline.store.keys import Ref, make_ref


@dataclass(frozen=True)
class Row:
    """One entry as ``ls`` shows it. ``state``: complete or incomplete; ``age_h`` None when it never was complete."""

    path: str
    state: str
    rows: int
    stored_bytes: int
    age_h: float | None
    kind: str
    made_from: Any


def entries(store: Store) -> list[Row]:
    """All entries by path."""
    return [_row(store, path) for path in store.entry_paths()]


def _row(store: Store, path: str) -> Row:
    attributes = store.attributes(path) or {}
    record = completeness(attributes, path.rsplit("/", 1)[-1])
    made_from = attributes.get("made_from")
    recipe = made_from.get("recipe") if isinstance(made_from, dict) else None
    age = None
    if record is not None:
        seconds = (datetime.now(UTC) - datetime.fromisoformat(record["at"])).total_seconds()
        age = max(0.0, seconds / 3600)  # a clock that was put back makes nothing old
    return Row(
        path=path,
        state="incomplete" if record is None else "complete",
        rows=0 if record is None else int(record["rows"]),
        stored_bytes=store.stored_bytes(path),
        age_h=age,
        kind=str(recipe.get("kind", "?")) if isinstance(recipe, dict) else "?",
        made_from=made_from,
    )


def verify(store: Store) -> list[tuple[str, str]]:
    """(path, verdict) of every entry: every byte of every array is read; "" means whole.

    A damaged entry is marked incomplete, so that the next run mends it.
    """
    verdicts = []
    for row in entries(store):
        if row.state != "complete":
            verdicts.append((row.path, "incomplete: the next run that needs it completes it"))
            continue
        entry = store.read(_ref(row))
        try:
            for name in entry.record["arrays"]:
                for index in range(entry.rows):
                    entry.array(name, [index])
        except DamagedEntry as damage:
            verdicts.append((row.path, str(damage)))
        else:
            verdicts.append((row.path, ""))
    return verdicts


def collect(store: Store, *, older_than_h: float | None, dry_run: bool) -> list[Row]:
    """Entries removed (or that would be): incomplete ones, and those older than a number of hours if given.

    An incomplete entry that another process is writing at this moment is left alone where the store has locks.
    """
    doomed = [
        row
        for row in entries(store)
        if row.state == "incomplete" or (older_than_h is not None and (row.age_h or 0.0) > older_than_h)
    ]
    for row in doomed if not dry_run else []:
        with store.backend.lock(row.path.rsplit("/", 1)[-1], store.announce):
            fresh = _row(store, row.path)
            if fresh.state == row.state:
                store.delete(row.path)
    return doomed


def find(store: Store, prefix: str) -> Row:
    """The one entry whose key starts with ``prefix``. Raises BadInput for none or several."""
    found = [path for path in store.entry_paths() if path.rsplit("/", 1)[-1].startswith(prefix)]
    if len(found) != 1:
        raise BadInput(
            "cache path", found=f"{len(found)} entries whose key starts with {prefix!r}", needed="exactly one"
        )
    return _row(store, found[0])


def _ref(row: Row) -> Ref:
    folder = row.path.rsplit("/", 1)[0]
    return make_ref(folder, row.made_from["recipe"], row.made_from["inputs"])
