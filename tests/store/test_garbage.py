"""What gc may remove: entries of ours that no running process uses. Everything else in a folder or bucket stays."""

import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import pipeline.store.leases
from pipeline.cli.cache import cache_command
from pipeline.errors import DzopError
from pipeline.store import DamagedEntry, Layout, LocalStoreConfig, Store, make_ref
from pipeline.store.admin import check_is_store, collect_garbage, list_entries, verify
from pipeline.store.arrays import list_keys, read_bytes, write_bytes
from pipeline.store.completion import FORMAT, NewerEntry
from pipeline.store.leases import live_leases

REF = make_ref("features/toy", {"kind": "toy"}, {"crops": "a" * 64})
OTHER = make_ref("crops", {"kind": "crops"}, {})
DOCUMENT = make_ref("runs", {"kind": "run"}, {})
LAYOUT = {"maps": Layout((3,), "float32")}
ROWS = 4
DIGEST = "0123456789abcdef" * 4
FOREIGN = [
    f"overlay2/{DIGEST}/diff/etc/passwd",  # a container's layer
    f"docker/registry/v2/blobs/sha256/01/{DIGEST}/data",  # a registry's blob
    f"objects/{DIGEST}",  # a file
    f"{DIGEST}/zarr.json",  # a Zarr group of someone else
    f"models/{DIGEST}/.dzop/readme.txt",
    f"runs/{DIGEST}/.dzop",  # a file of our marker's name, with other content
]


def fill(store: Store, ref=REF, stop_at: int | None = None) -> None:
    def compute(rows: list[int]) -> dict:
        if stop_at is not None and rows[0] >= stop_at:
            raise RuntimeError
        return {ref.key: {"maps": np.full((len(rows), 3), 1.5, np.float32)}}

    store.fill({ref: LAYOUT}, rows=ROWS, batch=1, compute=compute)


def leave_unfinished(store: Store, ref=REF) -> None:
    with pytest.raises(RuntimeError):
        fill(store, ref, stop_at=2)


def write_foreign(store: Store) -> dict[str, bytes]:
    contents = {
        key: json.dumps({"zarr_format": 3, "node_type": "group", "attributes": {"key": DIGEST}}).encode()
        for key in FOREIGN
    }
    for key, content in contents.items():
        write_bytes(store.backend.zarr, key, content)
    return contents


@pytest.fixture(params=["local", "s3"])
def store(request, tmp_path: Path) -> Store:
    if request.param == "s3":
        return Store(request.getfixturevalue("s3").config())
    return Store(LocalStoreConfig(root=str(tmp_path / "cache")))


def removed(store: Store, older_than_h: float | None = -1.0) -> set[str]:
    return {entry.path for entry in collect_garbage(store, older_than_h=older_than_h, dry_run=False)}


def test_gc_touches_nothing_without_our_marker(store: Store):
    fill(store)
    contents = write_foreign(store)
    said: list[str] = []
    store.announce = said.append
    assert removed(store) == {REF.path}
    assert {key: read_bytes(store.backend.zarr, key) for key in contents} == contents
    assert sum("kept: it has no marker of dzop, so it is not an entry" in line for line in said) == 5
    with pytest.raises(DzopError, match="not an entry of a store; it is left alone"):
        store.delete(f"overlay2/{DIGEST}")


def test_a_root_that_is_not_a_store_is_refused(store: Store):
    check_is_store(store)  # empty
    write_foreign(store)
    with pytest.raises(DzopError, match="found a folder that is not a store"):
        check_is_store(store)
    fill(store)
    check_is_store(store)


def test_every_cache_command_refuses_a_folder_that_is_not_a_store(tmp_path: Path, capsys):
    (tmp_path / DIGEST).mkdir()
    (tmp_path / DIGEST / "layer.tar").write_bytes(b"x")
    for command in (["ls"], ["du"], ["verify"], ["gc", "--older-than", "0"], ["path", DIGEST[:8]]):
        with pytest.raises(DzopError, match="is not a store"):
            cache_command([*command, "--root", str(tmp_path)])
    assert (tmp_path / DIGEST / "layer.tar").read_bytes() == b"x"


def test_gc_removes_our_entries_whose_metadata_is_damaged(store: Store):
    fill(store)
    store.put_document(DOCUMENT, {"a": 1}, rows=1)
    for ref, content in ((REF, b""), (DOCUMENT, b"{")):
        write_bytes(store.backend.zarr, f"{ref.path}/zarr.json", content)
    assert removed(store, older_than_h=None) == {REF.path, DOCUMENT.path}


@pytest.mark.parametrize("complete", [True, False])
def test_an_entry_of_a_newer_format_is_neither_read_nor_overwritten_nor_removed(store: Store, complete: bool):
    fill(store) if complete else leave_unfinished(store)
    attributes = store.attributes(REF.path)
    assert attributes is not None
    metadata = {"zarr_format": 3, "node_type": "group", "attributes": attributes | {"format": FORMAT + 1}}
    write_bytes(store.backend.zarr, f"{REF.path}/zarr.json", json.dumps(metadata).encode())
    before = {key: read_bytes(store.backend.zarr, key) for key in list_keys(store.backend.zarr, REF.path)}
    for use in (
        lambda: store.is_complete(REF),
        lambda: store.read(REF),
        lambda: store.state(REF),
        lambda: fill(store),
        lambda: store.put_document(REF, {}, rows=1),
        lambda: store.delete(REF.path),
    ):
        with pytest.raises(NewerEntry, match=r"found an entry of format 2, needs format 1: update dzop"):
            use()
    assert removed(store) == set()
    assert verify(store) == {}
    assert [entry.state for entry in list_entries(store)] == ["newer"]
    assert {key: read_bytes(store.backend.zarr, key) for key in list_keys(store.backend.zarr, REF.path)} == before


@pytest.mark.parametrize("at", [REF.path, "features", f"{REF.path}/maps"])
def test_a_file_where_the_store_needs_a_folder_is_one_line(tmp_path: Path, at: str):
    file = tmp_path / "cache" / at
    file.parent.mkdir(parents=True)
    file.write_text("mine")
    store = Store(LocalStoreConfig(root=str(tmp_path / "cache")))
    assert not store.is_complete(REF)
    assert not any(entry.complete for entry in list_entries(store))
    assert removed(store) == set()
    if at == f"{REF.path}/maps":  # below a key of ours: a leftover, which is replaced
        fill(store)
        return
    with pytest.raises(DzopError, match="found a file"):
        fill(store)
    assert file.read_text() == "mine"


# --- leases ----------------------------------------------------------------------------------------------------------


def test_gc_keeps_what_a_running_process_uses(store: Store):
    fill(store)
    fill(store, OTHER)
    said: list[str] = []
    user, collector = Store(store.config), Store(store.config, announce=said.append)
    with user.in_use():
        assert user.is_complete(REF)  # planned, to be read an hour later
        assert removed(collector) == {OTHER.path}
        assert any(f"{REF.path}: kept: process" in line for line in said)
        np.testing.assert_array_equal(user.read(REF).array("maps"), np.full((ROWS, 3), 1.5))
    assert removed(collector) == {REF.path}
    assert not live_leases(store.backend.zarr)


def test_gc_keeps_what_a_running_process_writes(store: Store):
    if store.backend.has_locks:
        pytest.skip("with locks gc waits for the writer")
    collector, writer = Store(store.config), Store(store.config)

    def compute(rows: list[int]) -> dict:
        assert removed(collector) == set()
        return {REF.key: {"maps": np.full((len(rows), 3), 1.5, np.float32)}}

    with writer.in_use():
        writer.fill({REF: LAYOUT}, rows=ROWS, batch=2, compute=compute)
        np.testing.assert_array_equal(writer.read(REF).array("maps"), np.full((ROWS, 3), 1.5))


def test_a_process_that_comes_while_gc_removes_an_entry_keeps_it_or_finds_none(store: Store, monkeypatch):
    """Between the withdrawal of the record and the look for leases."""
    fill(store)
    user, collector = Store(store.config), Store(store.config)
    user.join_lease("")
    calls: list[bool] = []

    def come_late(zarr):
        calls.append(True)
        if len(calls) == 2:
            assert not user.is_complete(REF)  # withdrawn: it would compute the entry
        return live_leases(zarr)

    monkeypatch.setattr(pipeline.store.admin, "live_leases", come_late)
    assert removed(collector) == set()
    assert user.is_complete(REF)
    np.testing.assert_array_equal(user.read(REF).array("maps"), np.full((ROWS, 3), 1.5))


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b'{"at": "noon"}', b'{"at": 1e999}', b'{"at": null}'])
def test_a_damaged_lease_protects_nothing_and_is_no_traceback(tmp_path: Path, content: bytes):
    store = Store(LocalStoreConfig(root=str(tmp_path)))
    fill(store)
    folder = tmp_path / ".leases" / "someone"
    folder.mkdir(parents=True)
    (folder / "alive").write_bytes(content)
    (folder / REF.key).write_bytes(b"")
    assert removed(store) == {REF.path}


def test_a_store_that_cannot_be_written_is_read_without_leases(tmp_path: Path, monkeypatch):
    store = Store(LocalStoreConfig(root=str(tmp_path)))
    fill(store)
    (tmp_path / ".leases").write_text("in the way")
    with store.in_use():
        np.testing.assert_array_equal(store.read(REF).array("maps"), np.full((ROWS, 3), 1.5))


def test_gc_removes_what_other_writers_left_in_a_complete_entry(s3):
    first, second = Store(s3.config()), Store(s3.config())
    leave_unfinished(first)
    fill(second)
    before = set(list_keys(first.backend.zarr, REF.path))
    assert removed(first, older_than_h=None) == set()
    after = set(list_keys(first.backend.zarr, REF.path))
    assert after < before
    assert len([key for key in after if "/c." in key]) == ROWS
    assert not any(verify(first).values())


def test_removing_while_another_process_lists_is_no_traceback(tmp_path: Path):
    store = Store(LocalStoreConfig(root=str(tmp_path)))
    refs = [make_ref("crops", {"kind": "crops"}, {"n": str(n)}) for n in range(30)]
    for ref in refs:
        store.put_document(ref, {}, rows=1)
    code = (
        "import sys; from pipeline.store import LocalStoreConfig, Store; from pipeline.store.admin import verify\n"
        f"s = Store(LocalStoreConfig(root={str(tmp_path)!r})); print('ready', flush=True)\n"
        "for _ in range(40): verify(s)"
    )
    lister = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert lister.stdout is not None
    lister.stdout.readline()
    for _ in range(3):
        removed(store)
        for ref in refs:
            store.put_document(ref, {}, rows=1)
        time.sleep(0.01)
    assert lister.wait(120) == 0, lister.stderr.read() if lister.stderr else ""


def test_damage_found_under_an_old_record_leaves_a_new_one_alone(store: Store):
    fill(store)
    reader = store.read(REF)
    Store(store.config).delete(REF.path)
    other = Store(store.config)
    compute = lambda rows: {REF.key: {"maps": np.full((len(rows), 3), 2.5, np.float32)}}  # noqa: E731
    other.fill({REF: LAYOUT}, rows=ROWS, batch=4, compute=compute)
    with pytest.raises(DamagedEntry):
        reader.array("maps")
    np.testing.assert_array_equal(other.read(REF).array("maps"), np.full((ROWS, 3), 2.5))
