"""A remote store that fails, times out or refuses access at any request."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from zarr.storage import LocalStore, WrapperStore

from pipeline.errors import DzopError
from pipeline.store import Layout, LocalStoreConfig, Store, make_ref
from pipeline.store.admin import list_entries, verify
from pipeline.store.remote import RemoteStore, StoreUnreachable

REF = make_ref("features/toy", {"kind": "toy", "version": 1}, {})
DOCUMENT = make_ref("runs", {"kind": "toy run", "version": 1}, {})
LAYOUT = {"maps": Layout((2, 3), "float16")}
VALUES = np.arange(5 * 6, dtype=np.float16).reshape(5, 2, 3)


class ConnectTimeoutError(Exception):
    """Like botocore's: neither an OSError nor a RuntimeError."""


FAULTS = {
    "timeout": TimeoutError("no answer within 60 s"),
    "asyncio": TimeoutError(),
    "connection": ConnectionResetError(104, "Connection reset by peer"),
    "botocore": ConnectTimeoutError("Connect timeout on endpoint URL"),
    "refused": PermissionError("Access Denied"),
    "server": OSError(5, "An error occurred (500) when calling the GetObject operation"),
    "runtime": RuntimeError("Event loop is closed"),
}


class Failing(WrapperStore):
    """A store whose n-th request fails; if ``lasting``, so do all later ones."""

    def __init__(self, store, fault: Exception | None = None, at: int = -1, *, lasting: bool = False) -> None:
        super().__init__(store)
        self.fault, self.at, self.lasting, self.asked = fault, at, lasting, 0

    def _with_store(self, store):
        return type(self)(store)

    def _ask(self) -> None:
        self.asked += 1
        if self.fault is not None and (self.asked == self.at or (self.lasting and self.asked > self.at)):
            raise self.fault

    async def get(self, key, prototype, byte_range=None):
        self._ask()
        return await super().get(key, prototype, byte_range)

    async def set(self, key, value):
        self._ask()
        return await super().set(key, value)

    async def delete_dir(self, prefix):
        self._ask()
        return await super().delete_dir(prefix)

    async def list_prefix(self, prefix):
        self._ask()
        async for key in self._store.list_prefix(prefix):
            yield key


def opened(root: Path, failing: Failing) -> Store:
    store = Store(LocalStoreConfig(root=str(root)))
    store.backend = replace(store.backend, zarr=RemoteStore(failing, "s3://bucket/prefix"), folder=None)
    return store


def work(store: Store) -> tuple[bytes, object]:
    """A miniature step: fill what is missing, then read everything."""
    store.fill({REF: LAYOUT}, rows=5, batch=2, compute=lambda rows: {REF.key: {"maps": VALUES[rows]}})
    if not store.is_complete(DOCUMENT):
        store.put_document(DOCUMENT, {"answers": [1, 2.5]}, rows=2)
    return store.read(REF).array("maps").tobytes(), store.read(DOCUMENT).document


EXPECTED = VALUES.tobytes(), {"answers": [1, 2.5]}


@pytest.mark.parametrize(
    ("name", "every"), [("botocore", 5), *(pytest.param(name, 1, marks=pytest.mark.faults) for name in FAULTS)]
)
@pytest.mark.parametrize("lasting", [False, True])
def test_a_failure_of_any_request_is_reported_and_the_next_run_recovers(
    tmp_path: Path, name, every, lasting, record_property
):
    counting = Failing(LocalStore(tmp_path / "counting"))
    assert work(opened(tmp_path / "counting", counting)) == EXPECTED
    requests = counting.asked
    assert requests > 20
    for at in range(1, requests + 1, every):
        root = tmp_path / f"{at}"
        store = opened(root, Failing(LocalStore(root), FAULTS[name], at, lasting=lasting))
        with pytest.raises(
            StoreUnreachable,
            match=r"s3://bucket/prefix: (the store does not answer|access denied) .*: completed entries are kept",
        ):
            work(store)
        healthy = Store(LocalStoreConfig(root=str(root)))
        for entry in list_entries(healthy):
            assert not entry.complete or entry.rows in (2, 5)
        assert work(healthy) == EXPECTED
        assert not any(verify(healthy).values())
    failed = f"{len(range(1, requests + 1, every))} requests, each failed once"
    record_property("summary", f"{name}, {'lasting' if lasting else 'transient'}: {failed}, reported and recovered")


def times_out(store: Store) -> bool:
    """Whether the work ended with a timeout of the store; otherwise its results are as expected."""
    try:
        assert work(store) == EXPECTED
    except DzopError as error:
        return "does not answer" in str(error)
    return False


def test_a_timeout_while_reading_deletes_nothing(tmp_path: Path):
    """An unreachable entry is neither missing nor damaged."""
    assert work(Store(LocalStoreConfig(root=str(tmp_path)))) == EXPECTED
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    at = 0
    while True:
        at += 1
        failing = Failing(LocalStore(tmp_path), FAULTS["timeout"], at, lasting=True)
        if not times_out(opened(tmp_path, failing)):
            break
        assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
    assert at > 5
