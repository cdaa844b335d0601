"""What two stores and two results files must have in common: everything but seconds, which were measured."""

from pathlib import Path
from typing import Any

from pipeline.store import Store, make_ref
from pipeline.store.admin import entries


def contents(store: Store) -> dict[str, Any]:
    """Bytes of every array and every document without its seconds, by path; all entries must be complete."""
    found: dict[str, Any] = {}
    for row in entries(store):
        assert row.state == "complete", row.path
        entry = store.read(make_ref(row.path.rsplit("/", 1)[0], row.made_from["recipe"], row.made_from["inputs"]))
        found[row.path] = _untimed(entry.document)
        found |= {f"{row.path}/{name}": entry.array(name).tobytes() for name in entry.arrays}
    return found


def poses(out: Path) -> bytes:
    """The one results file below a folder without its last column, the seconds."""
    (csv,) = out.glob("*/*/*.csv")
    return b"\n".join(line.rpartition(b",")[0] for line in csv.read_bytes().splitlines())


def _untimed(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _untimed(item) for name, item in value.items() if name not in ("time_s", "times_s")}
    return [_untimed(item) for item in value] if isinstance(value, list) else value
