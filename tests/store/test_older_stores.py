"""Stores that three older commits wrote are read right, and what is damaged or unfinished in them is refused.

tests/data/older_stores.tar.xz has a folder for each commit, written with its Store by the script in ``SCRIPT``.
"""

import tarfile
from pathlib import Path

import numpy as np
import pytest
from make_store import SAFELY

from pipeline.store import DamagedEntry, Layout, LocalStoreConfig, Store, make_ref
from pipeline.store.admin import check_is_store, collect_garbage, verify

ARCHIVE = Path(__file__).parents[1] / "data" / "older_stores.tar.xz"
COMMITS = ["4efd95f", "8ac4b5c", "73d0e55"]
FEATURES = make_ref("features/toy/t0/layer2", {"kind": "toy", "version": 1}, {"crops": "a" * 64})
CROPS = make_ref("crops", {"kind": "crops"}, {"templates": "b" * 64})
RUN = make_ref("runs", {"kind": "run"}, {"1/2": "c" * 64})
UNFINISHED = make_ref("features/toy/t0/layer5", {"kind": "toy", "version": 1}, {"crops": "d" * 64})
ROWS, LAYOUT = 6, {"maps": Layout((3, 4), "float16")}
SCRIPT = """
store = Store(LocalStoreConfig(root=commit))
store.fill({FEATURES: LAYOUT}, rows=6, batch=4, compute=lambda rows: {FEATURES.key: {"maps": maps(rows)}})
crops = {"mask": Layout((5, 5), "bool", compress=True)} | LAYOUT
values = lambda rows: {CROPS.key: {"mask": mask(rows), "maps": maps(rows)}}
store.fill({CROPS: crops}, rows=6, batch=6, compute=values, document={"kept": [0, 2]})
store.put_document(RUN, {"answers": [1, 2.5, "ü"]}, rows=1)
store.fill({UNFINISHED: LAYOUT}, rows=6, batch=2, compute=...)  # raised after the first batch
"""


def maps(rows) -> np.ndarray:
    return np.stack([np.full((3, 4), row + 1, np.float16) for row in rows])


def mask(rows) -> np.ndarray:
    return np.stack([np.full((5, 5), row % 2, bool) for row in rows])


@pytest.fixture(params=COMMITS)
def store(request, tmp_path: Path) -> Store:
    with tarfile.open(ARCHIVE) as archive:
        archive.extractall(tmp_path, **SAFELY)
    return Store(LocalStoreConfig(root=str(tmp_path / request.param)))


def test_complete_entries_of_an_older_commit_are_read_right(store: Store):
    check_is_store(store)
    np.testing.assert_array_equal(store.read(FEATURES).array("maps"), maps(range(ROWS)))
    np.testing.assert_array_equal(store.read(CROPS).array("mask", [4, 1]), mask([4, 1]))
    np.testing.assert_array_equal(store.read(CROPS).array("maps"), maps(range(ROWS)))
    assert store.read(CROPS).document == {"kept": [0, 2]}
    assert store.read(RUN).document == {"answers": [1, 2.5, "ü"]}
    problems = verify(store)
    assert [path for path, problem in problems.items() if problem] == [UNFINISHED.path]


def test_complete_entries_of_an_older_commit_are_not_computed_again(store: Store):
    filled = store.fill({FEATURES: LAYOUT}, rows=ROWS, batch=4, compute=lambda rows: pytest.fail("computed"))
    assert filled.reused == ROWS


@pytest.mark.parametrize("damage", ["flip", "cut", "lose"])
@pytest.mark.parametrize("name", ["mask", "maps"])
def test_a_damaged_chunk_of_an_older_commit_is_refused(store: Store, name: str, damage: str):
    entry = store.read(CROPS)
    entry.array(name, [0])
    chunk = Path(store.place) / CROPS.path / name / "c" / "3" / "0" / "0"
    data = chunk.read_bytes()
    chunk.unlink() if damage == "lose" else chunk.write_bytes(
        data[:-1] if damage == "cut" else bytes([data[0] ^ 1]) + data[1:]
    )
    with pytest.raises(DamagedEntry):
        entry.array(name, [3])
    assert not store.is_complete(CROPS)


def test_an_unfinished_entry_of_an_older_commit_is_computed_again(store: Store):
    """It has no journal, so nothing shows that its chunks are in their places."""
    assert store.state(UNFINISHED) == "partial"
    values = {"maps": maps(range(ROWS)) + 7}
    compute = lambda rows: {UNFINISHED.key: {"maps": values["maps"][rows]}}  # noqa: E731
    assert store.fill({UNFINISHED: LAYOUT}, rows=ROWS, batch=2, compute=compute).computed == ROWS
    np.testing.assert_array_equal(store.read(UNFINISHED).array("maps"), values["maps"])


def test_gc_removes_only_the_unfinished_entry_of_an_older_commit(store: Store):
    assert [entry.path for entry in collect_garbage(store, older_than_h=None, dry_run=False)] == [UNFINISHED.path]
    assert len(collect_garbage(store, older_than_h=0.0, dry_run=False)) == 3
