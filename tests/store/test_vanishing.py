"""Chunks that vanish, move or change after an entry was opened: never a number, on any backend."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from zarr.core.sync import sync

from pipeline.store import DamagedEntry, Entry, Layout, LocalStoreConfig, MemoryStoreConfig, Store, make_ref
from pipeline.store.admin import verify
from pipeline.store.arrays import delete_keys, list_keys, read_bytes, write_bytes

SOURCE = make_ref("sources", {"kind": "source"}, {})
OTHER = make_ref("sources", {"kind": "source"}, {"other": "1"})
RESULT = make_ref("results", {"kind": "result"}, {"source": SOURCE.key})
REPORT = make_ref("reports", {"kind": "report"}, {"source": SOURCE.key})
ROWS = 6
LAYOUT = {
    "plain": Layout((4, 4), "float32"),
    "packed": Layout((8, 8), "uint8", compress=True),
    "line": Layout((3,), "int64"),
}


def values(name: str, rows, offset: int = 1) -> np.ndarray:
    layout = LAYOUT[name]
    return np.stack([np.full(layout.row, 10 * row + offset, layout.dtype) for row in rows])


def fill(store: Store, ref=SOURCE, offset: int = 1, **more) -> None:
    compute = lambda rows: {ref.key: {name: values(name, rows, offset) for name in LAYOUT}}  # noqa: E731
    store.fill({ref: LAYOUT}, rows=ROWS, batch=4, compute=compute, **more)


@pytest.fixture(params=["local", "memory", pytest.param("s3", marks=pytest.mark.faults)])
def store(request, tmp_path: Path) -> Store:
    if request.param == "s3":
        return Store(request.getfixturevalue("s3").config())
    return Store(LocalStoreConfig(root=str(tmp_path / "cache")) if request.param == "local" else MemoryStoreConfig())


def another(store: Store) -> Store:
    """The same store as another process opens it."""
    opened = Store(store.config)
    if isinstance(store.config, MemoryStoreConfig):
        opened.backend = store.backend
    return opened


def chunk(store: Store, name: str, row: int, ref=SOURCE) -> str:
    (key,) = [k for k in list_keys(store.backend.zarr, ref.path) if f"/{name}/c.{row}." in k]
    return key


def lose_one(store: Store, entry: Entry, name: str) -> None:
    delete_keys(store.backend.zarr, [chunk(store, name, 3)])


def lose_array(store: Store, entry: Entry, name: str) -> None:
    sync(store.backend.zarr.delete_dir(chunk(store, name, 3).partition("/c.")[0]))


def lose_entry(store: Store, entry: Entry, name: str) -> None:
    store.delete(SOURCE.path)


def empty(store: Store, entry: Entry, name: str) -> None:
    write_bytes(store.backend.zarr, chunk(store, name, 3), b"")


def exchange_rows(store: Store, entry: Entry, name: str) -> None:
    exchange(store, chunk(store, name, 3), chunk(store, name, 0))


def exchange_entries(store: Store, entry: Entry, name: str) -> None:
    fill(store, OTHER, offset=2)
    exchange(store, chunk(store, name, 3), chunk(store, name, 3, OTHER))


def reverse_rows(store: Store, entry: Entry, name: str) -> None:
    for row in range(ROWS // 2):
        exchange(store, chunk(store, name, row), chunk(store, name, ROWS - 1 - row))


def replace(store: Store, entry: Entry, name: str) -> None:
    """Another process removes the entry and computes it again, with other bytes."""
    store.delete(SOURCE.path)
    fill(another(store), offset=5)


def exchange(store: Store, a: str, b: str) -> None:
    zarr = store.backend.zarr
    x, y = read_bytes(zarr, a), read_bytes(zarr, b)
    assert x is not None
    assert y is not None
    write_bytes(zarr, a, y)
    write_bytes(zarr, b, x)


FAULTS = [lose_one, lose_array, lose_entry, empty, exchange_rows, exchange_entries, reverse_rows, replace]


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("name", LAYOUT)
def test_what_happens_after_an_entry_was_opened_is_noticed_on_reading(store: Store, name: str, fault: Callable):
    fill(store)
    entry = store.read(SOURCE)
    entry.array(name, [1])
    fault(store, entry, name)
    for rows in ([3], [2, 3], None):
        with pytest.raises(DamagedEntry):
            entry.array(name, rows)


@pytest.mark.parametrize("fault", [lose_one, reverse_rows])
def test_what_happens_on_s3_after_an_entry_was_opened_is_noticed_on_reading(s3, fault: Callable):
    store = Store(s3.config())
    fill(store)
    entry = store.read(SOURCE)
    entry.array("plain", [1])
    fault(store, entry, "plain")
    with pytest.raises(DamagedEntry):
        entry.array("plain", [3])


@pytest.mark.parametrize("fault", FAULTS)
def test_results_of_what_vanished_are_not_completed_and_the_next_run_repairs_them(store: Store, fault: Callable):
    fill(store)
    entry, done = store.read(SOURCE), []

    def compute(rows: list[int]) -> dict:
        if done:
            fault(store, entry, "packed")
        done.append(rows)
        return {RESULT.key: {name: entry.array(name, rows) for name in LAYOUT}}

    with pytest.raises(DamagedEntry):
        store.fill({RESULT: LAYOUT}, rows=ROWS, batch=3, compute=compute)
    assert not store.is_complete(RESULT)
    fill(store)
    again = store.read(SOURCE)
    store.fill(
        {RESULT: LAYOUT},
        rows=ROWS,
        batch=3,
        compute=lambda rows: {RESULT.key: {n: again.array(n, rows) for n in LAYOUT}},
    )
    assert not any(problem for path, problem in verify(store).items() if path in (SOURCE.path, RESULT.path))


@pytest.mark.parametrize("fault", [lose_entry, replace])
def test_results_of_what_was_read_before_it_vanished_are_not_completed(store: Store, fault: Callable):
    fill(store)
    entry = store.read(SOURCE)
    total = float(entry.array("plain").sum())
    fault(store, entry, "plain")
    with pytest.raises(DamagedEntry, match="was removed or replaced while results were computed from it; run again"):
        store.put_document(REPORT, {"total": total}, rows=1)
    assert store.state(REPORT) == "missing"


def test_equal_bytes_of_another_process_are_no_change(store: Store):
    fill(store)
    total = float(store.read(SOURCE).array("plain").sum())
    store.delete(SOURCE.path)
    fill(another(store))
    store.put_document(REPORT, {"total": total}, rows=1)
    assert store.is_complete(REPORT)


def test_exchanged_chunks_of_an_unfinished_entry_are_not_kept(store: Store):
    def stop(rows: list[int]) -> dict:
        if rows[0] >= 4:
            raise RuntimeError
        return {SOURCE.key: {name: values(name, rows) for name in LAYOUT}}

    with pytest.raises(RuntimeError):
        store.fill({SOURCE: LAYOUT}, rows=ROWS, batch=2, compute=stop)
    exchange(store, chunk(store, "plain", 0), chunk(store, "plain", 1))
    computed: list[int] = []

    def compute(rows: list[int]) -> dict:
        computed.extend(rows)
        return {SOURCE.key: {name: values(name, rows) for name in LAYOUT}}

    store.fill({SOURCE: LAYOUT}, rows=ROWS, batch=2, compute=compute)
    assert computed == [0, 1, 4, 5]
    np.testing.assert_array_equal(store.read(SOURCE).array("plain"), values("plain", range(ROWS)))


def test_two_writers_of_unequal_bytes_leave_one_entry_of_one_writer(s3):
    first, second = Store(s3.config()), Store(s3.config())

    def compute(rows: list[int]) -> dict:
        if rows[0] == 4:
            fill(second, offset=2)  # starts and completes while the first writes
        return {SOURCE.key: {name: values(name, rows) for name in LAYOUT}}

    first.fill({SOURCE: LAYOUT}, rows=ROWS, batch=2, compute=compute)
    for store in (first, second):
        for name in LAYOUT:
            np.testing.assert_array_equal(store.read(SOURCE).array(name), values(name, range(ROWS), 2))


def test_a_reader_of_one_writer_is_not_disturbed_by_another(s3):
    first, second = Store(s3.config()), Store(s3.config())
    fill(first)
    reader = first.read(SOURCE)
    reader.array("plain", [0])
    record = read_bytes(first.backend.zarr, f"{SOURCE.path}/zarr.json")
    assert record is not None
    text = record.decode().replace('"complete"', '"hidden"')  # as the second writer found it, before the first ended
    write_bytes(first.backend.zarr, f"{SOURCE.path}/zarr.json", text.encode())
    fill(second, offset=2)
    np.testing.assert_array_equal(reader.array("packed"), values("packed", range(ROWS)))
    np.testing.assert_array_equal(second.read(SOURCE).array("packed"), values("packed", range(ROWS), 2))
