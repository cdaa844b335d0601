"""A run with its store on S3 writes the same bytes as a local run; a lost connection is reported in one line."""

from pathlib import Path

import pytest

from pipeline.store import LocalStoreConfig, Store
from pipeline.synthetic.scenes import write_dataset
from tests.command import run_dzop
from tests.same_bytes import contents, poses

SMALL = ("method=dzop", "extract=pixels", "render.count=6", "render.size=64", "fuse.dim=8", "overlays=false",
         "gallery=0", "threads=1", "runtime.progress=false", "evaluate.vsd=false")  # fmt: skip


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("synthetic") / "scene"
    write_dataset(root, objects=2, images=1, seed=3, size_hw=(240, 320), per_image=2, progress=False)
    return root


@pytest.mark.slow
def test_a_run_on_s3_writes_the_same_bytes_as_a_local_run(scene, s3, tmp_path, capsys, monkeypatch):
    def run(name: str, *overrides: str):
        dataset = ("dataset=bop", "dataset.name=toy", f"dataset.root={scene}", f"out={tmp_path}/{name}")
        return run_dzop(capsys, monkeypatch, *dataset, *SMALL, *overrides)

    on_s3 = ("store=s3", f"store.url={s3.config().url}", f"store.endpoint_url={s3.endpoint_url}")
    assert run("local", f"store.root={tmp_path}/cache").status == 0
    first = run("s3", *on_s3)
    assert (first.status, first.err) == (0, "")
    assert poses(tmp_path / "s3") == poses(tmp_path / "local")
    ours, theirs = contents(Store(s3.config())), contents(Store(LocalStoreConfig(root=str(tmp_path / "cache"))))
    assert set(ours) == set(theirs)
    assert [path for path in ours if ours[path] != theirs[path]] == []
    again = run("s3", *on_s3)
    assert {computed for computed, _ in again.counts()[0].values()} == {0}
    unreachable = run("s3", *on_s3[:2], "store.endpoint_url=http://127.0.0.1:1")
    assert unreachable.status == 1
    assert len(unreachable.err.splitlines()) == 1
    assert "run again when it answers: completed entries are kept" in unreachable.err
