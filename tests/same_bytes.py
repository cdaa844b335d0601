"""Contents of stores and results files that must be equal between runs: everything except measured seconds."""

from hashlib import sha256
from pathlib import Path
from typing import Any

from pipeline.store import Store
from pipeline.store.admin import list_entries


def contents(store: Store) -> dict[str, Any]:
    """Digest of every array, and every document without measured seconds, by path; all entries must be complete.

    Digests, because the arrays of several runs on photographs take gigabytes.
    """
    found: dict[str, Any] = {}
    for info in list_entries(store):
        assert info.complete, info.path
        entry = store.read(info.ref)
        found[info.path] = _remove_times(entry.document)
        found |= {f"{info.path}/{name}": sha256(entry.array(name)).hexdigest() for name in entry.arrays}
    return found


def poses(out: Path) -> bytes:
    """The only results csv below a folder, without its last column, the seconds."""
    (csv,) = out.glob("*/*/*.csv")
    return b"\n".join(line.rpartition(b",")[0] for line in csv.read_bytes().splitlines())


def _remove_times(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _remove_times(item) for name, item in value.items() if name not in ("time_s", "times_s")}
    return [_remove_times(item) for item in value] if isinstance(value, list) else value
