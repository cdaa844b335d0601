"""One contract for all backends, and the faults that only a local disk can have."""

import json
import multiprocessing
import os
import signal
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.errors import BadInput
from pipeline.store import DamagedEntry, Layout, LocalStoreConfig, MemoryStoreConfig, Store, make_ref
from pipeline.store.admin import collect_garbage, find_entry, list_entries, verify

REF = make_ref("features/toy/t0/layer2", {"kind": "toy", "version": 1, "dim": 4}, {"crops": "a" * 64})
OTHER = make_ref("features/toy/t0/layer5", {"kind": "toy", "version": 1, "dim": 8}, {"crops": "a" * 64})
LAYOUT = {"maps": Layout((3, 4), "float16")}
ROWS = 10


def values(rows: list[int]) -> np.ndarray:
    return np.stack([np.full((3, 4), row, np.float16) for row in rows])


def compute(rows: list[int], log: list[list[int]] | None = None) -> dict:
    if log is not None:
        log.append(rows)
    return {ref.key: {"maps": values(rows)} for ref in (REF, OTHER)}


def fill(store: Store, log: list[list[int]] | None = None, refs=(REF,)):
    return store.fill(dict.fromkeys(refs, LAYOUT), rows=ROWS, batch=4, compute=lambda rows: compute(rows, log))


@pytest.fixture(params=["local", "memory", "s3"])
def store(request, tmp_path: Path) -> Store:
    if request.param == "s3":
        return Store(request.getfixturevalue("s3").config())
    return Store(LocalStoreConfig(root=str(tmp_path / "cache")) if request.param == "local" else MemoryStoreConfig())


@pytest.fixture
def local(tmp_path: Path) -> Store:
    return Store(LocalStoreConfig(root=str(tmp_path / "cache")))


def entry_folder(store: Store) -> Path:
    return Path(store.place) / REF.path


def test_filled_values_are_read_back_by_row_and_all_at_once(store: Store):
    filled = fill(store)
    assert (filled.computed, filled.reused) == (ROWS, 0)
    entry = store.read(REF)
    np.testing.assert_array_equal(entry.array("maps"), values(list(range(ROWS))))
    np.testing.assert_array_equal(entry.array("maps", [7, 2]), values([7, 2]))
    assert (entry.rows, store.size(REF), store.state(REF)) == (ROWS, ROWS * 12 * 2, "cached")


def test_a_complete_entry_is_not_computed_again(store: Store):
    fill(store)
    log: list[list[int]] = []
    assert fill(store, log).reused == ROWS
    assert log == []


def test_an_interrupted_fill_is_a_miss_and_the_next_run_computes_only_what_is_missing(store: Store):
    def fail_in_the_second_batch(rows: list[int]) -> dict:
        if rows[0] == 4:
            raise RuntimeError("interrupted")
        return compute(rows)

    with pytest.raises(RuntimeError, match="interrupted"):
        store.fill({REF: LAYOUT}, rows=ROWS, batch=4, compute=fail_in_the_second_batch)
    assert store.state(REF) == "partial"
    with pytest.raises(DamagedEntry, match="not complete"):
        store.read(REF)
    log: list[list[int]] = []
    assert fill(store, log).computed == 6
    assert log == [[4, 5, 6, 7], [8, 9]]
    np.testing.assert_array_equal(store.read(REF).array("maps"), values(list(range(ROWS))))


def test_entries_that_share_rows_are_filled_in_one_pass(store: Store):
    log: list[list[int]] = []
    fill(store, log, refs=(REF, OTHER))
    assert len(log) == 3
    assert store.is_complete(REF)
    assert store.is_complete(OTHER)


def test_a_complete_layer_is_untouched_when_another_is_added(store: Store):
    fill(store)
    before = store.attributes(REF.path)
    fill(store, refs=(REF, OTHER))
    assert store.attributes(REF.path) == before
    assert store.is_complete(OTHER)


def test_a_row_of_zeros_is_stored(store: Store):
    store.fill(
        {REF: LAYOUT}, rows=2, batch=2, compute=lambda rows: {REF.key: {"maps": np.zeros((2, 3, 4), np.float16)}}
    )
    np.testing.assert_array_equal(store.read(REF).array("maps"), np.zeros((2, 3, 4)))


def test_chunks_written_directly_are_those_that_zarr_writes(tmp_path: Path):
    random = np.random.default_rng(0)
    values = {
        "maps": random.standard_normal((5, 6, 4)).astype(np.float16),
        "rgb": random.integers(0, 3, (5, 32, 32, 3)).astype(np.uint8),
        "mask": random.random((5, 9, 9)) > 0.5,
        "depth_mm": np.zeros((5, 20, 20), np.float32),
    }
    layouts = {name: Layout(v.shape[1:], v.dtype.name, compress=name != "maps") for name, v in values.items()}
    found, ref = [], make_ref("entries", {"kind": "entry"}, {})
    for folder, is_direct in ((tmp_path / "direct", True), (tmp_path / "zarr", False)):
        store = Store(LocalStoreConfig(root=str(folder)))
        if not is_direct:
            store.backend = replace(store.backend, folder=None)
        store.fill(
            {ref: layouts}, rows=5, batch=2, compute=lambda rows: {ref.key: {n: v[rows] for n, v in values.items()}}
        )
        for reader in (store, Store(LocalStoreConfig(root=str(folder)))):
            for name, expected in values.items():
                assert np.array_equal(reader.read(ref).array(name, [3, 1]), expected[[3, 1]])
        found.append({path.relative_to(folder): path.read_bytes() for path in folder.rglob("c.*") if path.is_file()})
    assert len(found[0]) == 20
    assert found[0] == found[1]


def test_documents_are_read_back_unchanged(store: Store):
    store.put_document(REF, {"answers": [1, 1.5, "ü", None]}, rows=4)
    assert store.read(REF).document == {"answers": [1, 1.5, "ü", None]}


def test_an_entry_records_what_it_was_made_from(store: Store):
    fill(store)
    assert store.attributes(REF.path)["made_from"] == json.loads(REF.made_from)
    assert find_entry(store, REF.key[:8]).path == REF.path
    with pytest.raises(BadInput, match="0 entries whose key starts with 'zz'"):
        find_entry(store, "zz")


def test_a_changed_layout_under_the_same_key_starts_from_scratch(store: Store):
    def other(rows: list[int]) -> dict:
        if rows[0] == 3:
            raise RuntimeError("interrupted")
        return {REF.key: {"maps": np.ones((1, 5), np.float32)}}

    with pytest.raises(RuntimeError, match="interrupted"):
        store.fill({REF: {"maps": Layout((5,), "float32")}}, rows=ROWS, batch=1, compute=other)
    assert fill(store).computed == ROWS


@pytest.mark.parametrize("position", [0, 11, -1])
def test_a_flipped_byte_in_a_chunk_is_detected_and_repaired(local: Store, position: int):
    fill(local)
    chunk = entry_folder(local) / "maps" / "c.3.0.0"
    damaged = bytearray(chunk.read_bytes())
    damaged[position] ^= 1
    chunk.write_bytes(damaged)
    with pytest.raises(DamagedEntry, match="run again to recompute only what is damaged"):
        local.read(REF).array("maps")
    assert local.state(REF) == "partial"
    log: list[list[int]] = []
    fill(local, log)
    assert log == [[0, 1, 2, 3]]
    np.testing.assert_array_equal(local.read(REF).array("maps"), values(list(range(ROWS))))


@pytest.mark.parametrize("keep", [0, 5])
def test_a_truncated_chunk_is_detected(local: Store, keep: int):
    fill(local)
    chunk = entry_folder(local) / "maps" / "c.9.0.0"
    chunk.write_bytes(chunk.read_bytes()[:keep])
    with pytest.raises(DamagedEntry):
        local.read(REF).array("maps", [9])


def test_a_missing_chunk_never_reads_as_zeros(local: Store):
    fill(local)
    (entry_folder(local) / "maps" / "c.5.0.0").unlink()
    with pytest.raises(DamagedEntry, match="lacks 1 of 10 chunks"):
        local.read(REF).array("maps", [5])
    fill(local)
    np.testing.assert_array_equal(local.read(REF).array("maps", [5]), values([5]))


def test_changed_metadata_is_detected(local: Store):
    fill(local)
    meta = entry_folder(local) / "maps" / "zarr.json"
    meta.write_text(meta.read_text().replace('"float16"', '"int16"'))
    with pytest.raises(DamagedEntry, match="metadata of array maps changed"):
        local.read(REF).array("maps")
    fill(local)
    np.testing.assert_array_equal(local.read(REF).array("maps"), values(list(range(ROWS))))


@pytest.mark.parametrize("text", ["", "{", '{"node_type": "group"}'])
def test_damaged_attributes_make_the_entry_a_miss(local: Store, text: str):
    fill(local)
    (entry_folder(local) / "zarr.json").write_text(text)
    assert not local.is_complete(REF)
    fill(local)
    np.testing.assert_array_equal(local.read(REF).array("maps"), values(list(range(ROWS))))


def test_a_changed_document_makes_the_entry_a_miss(local: Store):
    local.put_document(REF, {"pose": 1.0}, rows=1)
    record = entry_folder(local) / "zarr.json"
    record.write_text(record.read_text().replace('"pose": 1.0', '"pose": 2.0'))
    assert not local.is_complete(REF)


def test_verify_reads_every_byte_and_gc_removes_only_incomplete_entries(local: Store):
    fill(local, refs=(REF, OTHER))
    assert verify(local) == {REF.path: "", OTHER.path: ""}
    chunk = entry_folder(local) / "maps" / "c.1.0.0"
    chunk.write_bytes(b"x" * len(chunk.read_bytes()))
    assert "checksum" in verify(local)[REF.path]
    assert [entry.path for entry in collect_garbage(local, older_than_h=None, dry_run=True)] == [REF.path]
    collect_garbage(local, older_than_h=None, dry_run=False)
    assert [entry.path for entry in list_entries(local)] == [OTHER.path]


def test_temporary_files_of_a_killed_run_are_removed_by_the_next(local: Store):
    folder = Path(local.place)
    above = [folder, folder / "features", folder / "features/toy/t0"]
    for group in above:
        group.mkdir(parents=True, exist_ok=True)
        (group / "zarr.0123abcd.partial").write_text("{")
    fill(local)
    assert not list(folder.rglob("*.partial"))
    assert all((group / "zarr.json").exists() for group in above)


def test_metadata_of_parent_groups_is_written_once(local: Store):
    fill(local)
    above = [group / "zarr.json" for group in entry_folder(local).parents if group.is_relative_to(local.place)]
    assert len(above) == 5
    before = [(path.stat().st_ino, path.stat().st_mtime_ns) for path in above]
    fill(local, refs=(OTHER,))
    assert [(path.stat().st_ino, path.stat().st_mtime_ns) for path in above] == before


def _fill_slowly(root: str, started, pid_file: str) -> None:
    store = Store(LocalStoreConfig(root=root))
    Path(pid_file).write_text(str(os.getpid()))

    def slow(rows: list[int]) -> dict:
        started.set()
        time.sleep(0.05)
        return compute(rows)

    store.fill({REF: LAYOUT}, rows=200, batch=1, compute=slow)


def test_a_killed_process_leaves_no_entry_that_looks_complete_and_no_lock(tmp_path: Path):
    context = multiprocessing.get_context("spawn")
    started = context.Event()
    process = context.Process(target=_fill_slowly, args=(str(tmp_path / "cache"), started, str(tmp_path / "pid")))
    process.start()
    assert started.wait(60)
    time.sleep(1.5)  # rows are noted every half second
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    store = Store(LocalStoreConfig(root=str(tmp_path / "cache")))
    assert not store.is_complete(REF)
    log: list[list[int]] = []
    filled = store.fill({REF: LAYOUT}, rows=200, batch=1, compute=lambda rows: compute(rows, log))
    assert 0 < filled.reused < 200
    np.testing.assert_array_equal(store.read(REF).array("maps"), values(list(range(200))))


def _fill_counting(root: str, counter) -> None:
    def count(rows: list[int]) -> dict:
        with counter.get_lock():
            counter.value += len(rows)
        time.sleep(0.02)
        return compute(rows)

    Store(LocalStoreConfig(root=root)).fill({REF: LAYOUT}, rows=ROWS, batch=1, compute=count)


def test_two_processes_that_need_the_same_entry_compute_it_once(tmp_path: Path):
    context = multiprocessing.get_context("spawn")
    counter = context.Value("i", 0)
    both = [context.Process(target=_fill_counting, args=(str(tmp_path / "cache"), counter)) for _ in range(2)]
    for process in both:
        process.start()
    for process in both:
        process.join(120)
    assert [process.exitcode for process in both] == [0, 0]
    assert counter.value == ROWS


def test_a_folder_that_cannot_be_created_is_reported_in_one_line(tmp_path: Path):
    (tmp_path / "file").write_text("")
    with pytest.raises(BadInput, match=r"store.root: found .*file/cache"):
        Store(LocalStoreConfig(root=str(tmp_path / "file" / "cache")))
