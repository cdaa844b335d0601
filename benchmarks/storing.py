"""Bytes per second of the store compared with numpy's memmap, on the layer 2 maps of 300 templates at SD 1.5's size."""

from __future__ import annotations

import tempfile
from itertools import count
from pathlib import Path

import numpy as np

from benchmarks.inputs import SD15, TEMPLATES
from benchmarks.measure import Measurement, time_interleaved
from pipeline.store import Layout, LocalStoreConfig, Ref, Store, make_ref

_BATCH = 8


def storing(*, device: str, repeats: int) -> list[Measurement]:
    """GB/s of writing and reading 300 templates (49 MB), milliseconds for one template; from the page cache."""
    channels, cells = SD15[2]
    maps = np.random.default_rng(0).standard_normal((TEMPLATES, channels, cells, cells), dtype=np.float32)
    bank = maps.astype(np.float16)
    with tempfile.TemporaryDirectory() as folder:
        store, numbers = Store(LocalStoreConfig(root=f"{folder}/cache")), count()

        def write() -> Ref:
            ref = make_ref("features/bench", {"kind": "bench"}, {"number": str(next(numbers))})
            layouts = {ref: {"maps": Layout(bank.shape[1:], "float16")}}
            store.fill(layouts, rows=len(bank), batch=_BATCH, compute=lambda rows: {ref.key: {"maps": bank[rows]}})
            return ref

        def write_mapped() -> None:
            mapped = np.lib.format.open_memmap(f"{folder}/written.npy", "w+", bank.dtype, bank.shape)
            for first in range(0, len(bank), _BATCH):
                mapped[first : first + _BATCH] = bank[first : first + _BATCH]
            mapped.flush()

        ref, path = write(), Path(folder) / "bank.npy"
        np.save(path, bank)
        warm = store.read(ref)
        warm.array("maps", [0])
        times = time_interleaved(
            {
                "write": write,
                "write memmap": write_mapped,
                "read": lambda: store.read(ref).array("maps"),
                "read memmap": lambda: np.array(np.load(path, mmap_mode="r")),
                "row": lambda: store.read(ref).array("maps", [7]),
                "row again": lambda: warm.array("maps", [7]),
            },
            repeats=repeats,
        )
    speed = {name: bank.nbytes / 1e9 / t.cpu_s for name, t in times.items()}
    return [
        Measurement("layer 2 of 300 templates, read", speed["read"], "GB/s of one core", "", 1.0, "more"),
        Measurement("layer 2 of 300 templates, read", speed["read"] / speed["read memmap"], "x", "numpy.memmap"),
        Measurement("layer 2 of 300 templates, written", speed["write"], "GB/s of one core"),
        Measurement("layer 2 of 300 templates, written", speed["write"] / speed["write memmap"], "x", "numpy.memmap"),
        Measurement("layer 2 of one template, opening the entry", 1e3 * times["row"].cpu_s, "ms of one core"),
        Measurement("layer 2 of one template, entry already open", 1e3 * times["row again"].cpu_s, "ms of one core"),
    ]
