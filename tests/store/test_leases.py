"""When leases begin and end: of processes that are killed, sleep, cannot write, or do not reach the store."""

import errno
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

import pipeline.store.leases
from pipeline.store import LocalStoreConfig, Store, make_ref
from pipeline.store.admin import collect_garbage
from pipeline.store.arrays import list_keys, write_bytes
from pipeline.store.leases import FOLDER, LIFETIME_S, Lease, live_leases, remove_expired_leases
from pipeline.store.remote import StoreUnreachable

REFS = [make_ref("crops", {"kind": "crops"}, {"n": str(n)}) for n in range(3)]
KEYS = {ref.key for ref in REFS}


@pytest.fixture
def store(tmp_path: Path) -> Store:
    store = Store(LocalStoreConfig(root=str(tmp_path / "cache")))
    for ref in REFS:
        store.put_document(ref, {}, rows=1)
    return store


def lease_all(store: Store) -> Lease:
    store.join_lease("")
    for ref in REFS:
        assert store.is_complete(ref)
    assert store.lease is not None
    return store.lease


def removed(store: Store) -> set[str]:
    return {entry.key for entry in collect_garbage(Store(store.config), older_than_h=0.0, dry_run=False)}


def alive_record(store: Store, lease: Lease) -> Path:
    return Path(store.place) / FOLDER / lease.name / "alive"


@pytest.mark.parametrize("end", ["os.kill(os.getpid(), 9)", "os._exit(1)", "os.abort()"])
def test_leases_of_a_process_that_was_killed_end_at_once_on_its_machine(store: Store, end: str):
    code = f"""
import os
from pipeline.store import LocalStoreConfig, Store
from tests.store.test_leases import lease_all
lease_all(Store(LocalStoreConfig(root={store.place!r})))
{end}"""
    subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parents[2], check=False, stderr=subprocess.DEVNULL)
    assert len(list_keys(store.backend.zarr, FOLDER)) == 1 + len(REFS)
    assert removed(store) == KEYS
    assert not list_keys(store.backend.zarr, FOLDER)


def test_leases_of_a_zombie_have_ended(store: Store):
    lease = lease_all(store)
    child = os.fork()
    if child == 0:
        os._exit(0)
    time.sleep(0.1)  # it has ended, and nobody has waited for it
    change_process(store, lease, pid=child)
    assert removed(store) == KEYS
    os.waitpid(child, 0)


def change_process(store: Store, lease: Lease, **fields) -> None:
    record = json.loads(alive_record(store, lease).read_text())
    record["process"] |= fields
    alive_record(store, lease).write_text(json.dumps(record))


@pytest.mark.parametrize(
    ("fields", "ended"),
    [
        ({}, False),
        ({"started": 1}, True),  # its process id was given to another one
        ({"boot": "another machine", "pid": 2**31 - 1}, False),
        ({"namespace": "pid:[1]", "pid": 2**31 - 1}, False),  # another container
        ({"pid": 2**31 - 1}, True),
        ({"pid": "1"}, False),
        ({"pid": 10**30}, False),
    ],
)
def test_a_process_has_ended_only_if_it_is_known_to_have_run_here(store: Store, fields: dict, ended: bool):
    change_process(store, lease_all(store), **fields)
    assert removed(store) == (KEYS if ended else set())


def test_leases_without_a_process_expire_after_an_hour(store: Store, monkeypatch):
    lease = lease_all(store)
    alive_record(store, lease).write_text(json.dumps({"at": time.time()}))  # as an older version wrote it
    assert removed(store) == set()
    monkeypatch.setattr(pipeline.store.leases, "LIFETIME_S", -1.0)
    assert removed(store) == KEYS


@pytest.mark.parametrize("error", [errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO])
def test_leases_taken_before_the_disk_was_full_are_released(store: Store, monkeypatch, error: int):
    lease = lease_all(store)
    write = pipeline.store.leases.write_bytes

    def fail(*args):
        raise OSError(error, os.strerror(error))

    monkeypatch.setattr(pipeline.store.leases, "write_bytes", fail)
    lease.take("a" * 64)
    monkeypatch.setattr(pipeline.store.leases, "write_bytes", write)
    lease.take("a" * 64)
    assert ("a" * 64 in live_leases(store.backend.zarr)) == (error in (errno.ENOSPC, errno.EDQUOT))
    lease.release()
    assert not list_keys(store.backend.zarr, FOLDER)


def test_a_thread_that_reads_on_after_the_run_takes_no_lease(store: Store):
    with store.in_use():
        entry, lease = store.read(REFS[0]), store.lease
    assert lease is not None
    lease.take(REFS[1].key)
    assert entry.document == {}
    assert not list_keys(store.backend.zarr, FOLDER)


def test_a_worker_does_not_renew_leases_that_were_released(store: Store):
    lease = lease_all(store)
    worker = Lease(store.backend.zarr, lease.name)
    worker.take("a" * 64)
    assert live_leases(store.backend.zarr).keys() == KEYS | {"a" * 64}
    assert json.loads(alive_record(store, lease).read_text())["process"]["pid"] == os.getpid()
    lease.release()
    late = Lease(store.backend.zarr, lease.name)
    for each in (worker, late):
        each.take("b" * 64)
    assert not live_leases(store.backend.zarr)
    assert removed(store) == KEYS
    assert not list_keys(store.backend.zarr, FOLDER)


def test_a_computer_that_slept_leases_its_entries_again(store: Store, monkeypatch):
    lease, now = lease_all(store), time.time()
    monkeypatch.setattr(pipeline.store.leases.time, "time", lambda: now + LIFETIME_S + 1)
    remove_expired_leases(store.backend.zarr)
    assert not list_keys(store.backend.zarr, FOLDER)
    lease.refresh()
    assert live_leases(store.backend.zarr).keys() == KEYS


def test_a_store_that_does_not_answer_at_the_end_is_no_error(store: Store, monkeypatch):
    async def fail(prefix: str) -> None:
        raise StoreUnreachable("s3://bucket: the store does not answer")

    with store.in_use():
        assert store.is_complete(REFS[0])
        monkeypatch.setattr(store.backend.zarr, "delete_dir", fail)


@pytest.mark.parametrize("content", [b"[" * 100_000, b'{"at": 1e12}', b'{"at": 1, "process": []}', b"\xff"])
def test_a_damaged_record_of_a_process_protects_nothing(store: Store, content: bytes):
    lease = lease_all(store)
    write_bytes(store.backend.zarr, f"{FOLDER}/{lease.name}/alive", content)
    assert removed(store) == KEYS
