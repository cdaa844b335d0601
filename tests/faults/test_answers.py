"""A store at the other end of a network that fails, times out or refuses in the middle of whatever it is asked."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from zarr.storage import LocalStore, WrapperStore

from pipeline.errors import DzopError
from pipeline.store import Layout, LocalStoreConfig, Store, make_ref
from pipeline.store.admin import entries, verify
from pipeline.store.remote import Answering, StoreUnreachable

REF = make_ref("features/toy", {"kind": "toy", "version": 1}, {})
DOCUMENT = make_ref("runs", {"kind": "toy run", "version": 1}, {})
LAYOUT = {"maps": Layout((2, 3), "float16")}
VALUES = np.arange(5 * 6, dtype=np.float16).reshape(5, 2, 3)


class ConnectTimeoutError(Exception):
    """As botocore's: neither an OSError nor a RuntimeError."""


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
    """A store whose n-th request fails; with ``lasting`` all that follow do too."""

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
    store.backend = replace(store.backend, zarr=Answering(failing, "s3://bucket/prefix"))
    return store


def work(store: Store) -> tuple[bytes, object]:
    """A step in small: what is missing is made, then everything is read."""
    made = lambda rows: {REF.key: {"maps": VALUES[rows]}}  # noqa: E731
    store.fill({REF: LAYOUT}, rows=5, batch=2, compute=made)
    if not store.is_complete(DOCUMENT):
        store.put_document(DOCUMENT, {"answers": [1, 2.5]}, rows=2)
    return store.read(REF).array("maps").tobytes(), store.read(DOCUMENT).document


WHOLE = VALUES.tobytes(), {"answers": [1, 2.5]}


@pytest.mark.parametrize(
    ("name", "every"), [("botocore", 5), *(pytest.param(name, 1, marks=pytest.mark.faults) for name in FAULTS)]
)
@pytest.mark.parametrize("lasting", [False, True])
def test_whatever_request_fails_it_is_told_and_the_next_run_heals_it(
    tmp_path: Path, name, every, lasting, record_property
):
    counting = Failing(LocalStore(tmp_path / "counting"))
    assert work(opened(tmp_path / "counting", counting)) == WHOLE
    requests = counting.asked
    assert requests > 20
    for at in range(1, requests + 1, every):
        root = tmp_path / f"{at}"
        store = opened(root, Failing(LocalStore(root), FAULTS[name], at, lasting=lasting))
        with pytest.raises(
            StoreUnreachable,
            match=r"s3://bucket/prefix: (the store does not answer|access denied) .*: what is complete is kept",
        ):
            work(store)
        healthy = Store(LocalStoreConfig(root=str(root)))
        for row in entries(healthy):
            assert row.state == "incomplete" or row.rows in (2, 5)
        assert work(healthy) == WHOLE
        assert all(not verdict for _, verdict in verify(healthy))
    told = f"{len(range(1, requests + 1, every))} requests, each failed once"
    record_property("told", f"{name}, {'lasting' if lasting else 'passing'}: {told}, told and healed")


def told_silent(store: Store) -> bool:
    """Whether the work ended with the store's silence; otherwise its results are whole."""
    try:
        assert work(store) == WHOLE
    except DzopError as error:
        return "does not answer" in str(error)
    return False


def test_silence_in_the_middle_of_reading_deletes_nothing(tmp_path: Path):
    """An entry that cannot be reached is neither missing nor damaged."""
    assert work(Store(LocalStoreConfig(root=str(tmp_path)))) == WHOLE
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    at = 0
    while True:
        at += 1
        failing = Failing(LocalStore(tmp_path), FAULTS["timeout"], at, lasting=True)
        if not told_silent(opened(tmp_path, failing)):
            break
        assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
    assert at > 5
