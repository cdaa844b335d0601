"""What earlier code stored is found again: tests/data/store.tar.xz was written by commit 73d0e55 with make_store.py."""

import json
import tarfile
from pathlib import Path

import pytest
from command import run_dzop
from make_store import ARCHIVE, METHODS, SMALL


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    with tarfile.open(ARCHIVE) as archive:
        archive.extractall(tmp_path, filter="data")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def answers(out: Path) -> list[dict]:
    (path,) = out.rglob("poses.json")
    return json.loads(path.read_text())["answers"]


@pytest.mark.parametrize("name", METHODS)
def test_a_store_of_an_older_commit_is_reused_whole(folder, capsys, monkeypatch, name):
    ran = run_dzop(capsys, monkeypatch, *SMALL, *METHODS[name], "out=again")
    assert ran.status == 0, ran.err
    (counts,) = ran.counts()
    assert {step: computed for step, (computed, _) in counts.items()} == dict.fromkeys(counts, 0)
    assert {"templates", "template features", "query features", "poses", "scores"} <= counts.keys()
    assert all(reused for _, reused in counts.values())
    assert answers(folder / "again") == answers(folder / "results" / name)


@pytest.mark.parametrize("name", METHODS)
def test_results_of_an_older_commit_are_not_made_again_by_a_sweep(folder, capsys, monkeypatch, name):
    before = {path: path.read_bytes() for path in (folder / "results").rglob("*") if path.is_file()}
    ran = run_dzop(capsys, monkeypatch, "-m", *SMALL, *METHODS[name], f"out=results/{name}")
    assert ran.status == 0, ran.err
    assert ran.counts() == [{"detections": (0, 1)}]  # it reads which targets there are, and does nothing else
    assert {path: path.read_bytes() for path in before} == before
