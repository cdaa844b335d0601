"""Keys of a bucket: which are listed and deleted, and how many requests this takes."""

from collections import Counter

import pytest
from zarr.core.sync import sync

import pipeline.store.bucket
from pipeline.store import Store, make_ref
from pipeline.store.admin import collect_garbage, list_entries
from pipeline.store.arrays import delete_keys, list_keys, read_bytes, stored_bytes, write_bytes
from pipeline.store.remote import AccessDenied

REF = make_ref("crops", {"kind": "crops"}, {})


def open_store(s3, prefix: str) -> Store:
    return Store(s3.config(url=f"s3://dzop-tests{prefix}"))


@pytest.fixture
def requests(s3, monkeypatch) -> Counter[str]:
    """How often each request was sent to the store at /cache."""
    counts: Counter[str] = Counter()
    fs = open_store(s3, "/cache").backend.zarr._store.fs
    call = fs._call_s3

    async def count(method: str, *args, **kwargs):
        counts[method] += 1
        return await call(method, *args, **kwargs)

    monkeypatch.setattr(fs, "_call_s3", count)
    return counts


@pytest.mark.parametrize("prefix", ["/run*", "/run[12]", "/run?", "/run"])
def test_a_prefix_is_no_pattern_and_no_beginning_of_another(s3, prefix: str):
    stores = [open_store(s3, name) for name in (prefix, "/run1", "/run12")]
    for store in stores:
        store.put_document(REF, {}, rows=1)
    removed = collect_garbage(stores[0], older_than_h=-1.0, dry_run=False)
    assert [entry.path for entry in removed] == [REF.path]
    assert [len(list_entries(store)) for store in stores] == [0, 1, 1]
    write_bytes(stores[0].backend.zarr, "a*", b"x")
    write_bytes(stores[0].backend.zarr, "ab", b"x")
    delete_keys(stores[0].backend.zarr, ["a*"])
    assert "ab" in list_keys(stores[0].backend.zarr, "")


def test_a_store_may_be_a_whole_bucket(s3):
    store = open_store(s3, "")
    store.put_document(REF, {"a": 1}, rows=1)
    assert [entry.path for entry in list_entries(store)] == [REF.path]
    assert collect_garbage(store, older_than_h=-1.0, dry_run=False)
    assert s3.keys() == [".dzop", "crops/zarr.json", "zarr.json"]  # groups above entries stay


def test_more_keys_than_one_request_may_name_are_deleted(s3, monkeypatch, requests):
    monkeypatch.setattr(pipeline.store.bucket, "_DELETED_AT_ONCE", 3)
    store = open_store(s3, "/cache")
    for n in range(7):
        s3.put(f"cache/crops/{n}", b"x")
    s3.put("cache/crops2", b"x")
    assert stored_bytes(store.backend.zarr, "crops") == 7
    sync(store.backend.zarr.delete_dir("crops"))
    assert s3.keys() == ["cache/crops2"]
    assert requests["delete_objects"] == 3


def test_each_operation_is_one_request(s3, requests):
    store = open_store(s3, "/cache").backend.zarr
    write_bytes(store, "crops/a", b"abc")
    requests.clear()
    assert read_bytes(store, "crops/a") == b"abc"
    assert read_bytes(store, "crops/missing") is None
    assert list_keys(store, "crops") == ["crops/a"]
    assert list_keys(store, "nothing") == []
    assert stored_bytes(store, "crops") == 3
    delete_keys(store, ["crops/a"])
    assert requests == {"get_object": 2, "list_objects_v2": 3, "delete_objects": 1}


def test_a_refused_deletion_is_one_line(s3, monkeypatch):
    store = open_store(s3, "/cache")
    store.put_document(REF, {}, rows=1)
    fs = store.backend.zarr._store.fs
    call = fs._call_s3

    async def refuse(method: str, *args, **kwargs):
        if method == "delete_objects":
            return {"Errors": [{"Key": "cache/x", "Code": "AccessDenied", "Message": "Access Denied"}]}
        return await call(method, *args, **kwargs)

    monkeypatch.setattr(fs, "_call_s3", refuse)
    with pytest.raises(AccessDenied, match=r"access denied \(cache/x cannot be deleted: Access Denied\)"):
        collect_garbage(store, older_than_h=-1.0, dry_run=False)
