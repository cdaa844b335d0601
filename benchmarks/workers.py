"""Compare ``runtime.workers=2`` with one process: wall time of a whole run, and identical bytes."""

from __future__ import annotations

import tempfile
from pathlib import Path

from benchmarks.cli_runs import run_dzop
from benchmarks.measure import Measurement
from pipeline.store import LocalStoreConfig, Store
from pipeline.store.admin import list_entries

DATA = ("dataset=demo", "dataset.objects=4", "dataset.images=8", "dataset.per_image=4", "render.count=150")


def two_workers(*, device: str, repeats: int) -> list[Measurement]:
    """Wall seconds of onboarding and poses with one process and with two, one thread each. Needs two idle cores."""
    found = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        run_dzop(folder, *DATA, "step=detect", f"dataset.root={folder / 'data'}")  # generates the data set
        for workers in (1, 2):
            chosen = (*DATA, f"dataset.root={folder / 'data'}", f"runtime.workers={workers}", "step=estimate")
            found[workers] = run_dzop(folder / str(workers), *chosen, f"runtime.device={device}").wall_s
        one, two = (_read_entries(folder / str(workers) / "cache") for workers in (1, 2))
    if one != two:
        raise AssertionError(f"two workers stored different bytes than one: {sorted(one.items() ^ two.items())[:3]}")
    return [
        Measurement("4 objects, 600 templates, 32 poses, one process", found[1], "s of wall time"),
        Measurement("4 objects, 600 templates, 32 poses, runtime.workers=2", found[2], "s of wall time"),
        Measurement("two workers: times faster, same bytes", found[1] / found[2], "x", "one process", 1.8, "more"),
    ]


def _read_entries(cache: Path) -> dict[str, bytes]:
    """Checksums of the chunks of each entry. Poses are documents without chunks, because their times differ."""
    store = Store(LocalStoreConfig(root=str(cache)))
    return {
        info.path: repr(sorted((store.attributes(info.path) or {})["complete"].get("chunks", {}).items())).encode()
        for info in list_entries(store)
        if info.complete
    }
