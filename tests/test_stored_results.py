"""What earlier code stored is found again: tests/data/store.tar.xz was written by commit 73d0e55 with make_store.py."""

import json
import tarfile
from pathlib import Path

import numpy as np
import pytest
from command import run_dzop
from make_store import ARCHIVE, METHODS, SAFELY, SMALL

from pipeline.stages.fuse.learned import Learned


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    with tarfile.open(ARCHIVE) as archive:
        archive.extractall(tmp_path, **SAFELY)
    monkeypatch.chdir(tmp_path)
    # the archive's features were made at 32 px, to be small; the head has refused all but 128 px since then
    monkeypatch.setattr(Learned, "check", lambda *_: None)
    return tmp_path


def answers(out: Path) -> list[dict]:
    (path,) = out.rglob("poses.json")
    return json.loads(path.read_text())["answers"]


RECOMPUTED = {"detections", "poses", "scores"}
"""Version 3 of the poses: the solver's threshold follows the size of the crop. Scores: their key has depth_scale.

Version 2 of detect=gt_mask: masks are read by the rules of bop/pixels.py. The crops of equal masks are found again.
"""


@pytest.mark.parametrize("name", METHODS)
def test_a_store_of_an_older_commit_is_reused_where_results_did_not_change(folder, capsys, monkeypatch, name):
    ran = run_dzop(capsys, monkeypatch, *SMALL, *METHODS[name], "out=again")
    assert ran.status == 0, ran.err
    (counts,) = ran.counts()
    recomputed = RECOMPUTED | ({"template encodings"} if name == "embedded" else set())  # newer than the archive
    assert {step for step, (computed, _) in counts.items() if computed} == recomputed
    assert {"templates", "template features", "query features"} <= counts.keys()
    assert all(reused for step, (_, reused) in counts.items() if step not in recomputed)
    if name == "embedded":
        return  # the first look became coarse: other poses, from the same features
    for now, before in zip(answers(folder / "again"), answers(folder / "results" / name), strict=True):
        assert now["template_id"] == before["template_id"]
        # mm; another processor's rounding turns a correspondence or two
        np.testing.assert_allclose(now["T_cam_obj"], before["T_cam_obj"], atol=1.0)


@pytest.mark.parametrize("name", METHODS)
def test_results_are_not_made_again_by_a_sweep(folder, capsys, monkeypatch, name):
    older = {path: path.read_bytes() for path in (folder / "results").rglob("*") if path.is_file()}
    sweep = ("-m", *SMALL, *METHODS[name], f"out=results/{name}")
    assert run_dzop(capsys, monkeypatch, *sweep).status == 0
    again = run_dzop(capsys, monkeypatch, *sweep)
    assert again.status == 0, again.err
    assert again.counts()[-1] == {"detections": (0, 1)}  # it reads which targets there are, and does nothing else
    changed = [path for path in older if path.read_bytes() != older[path]]
    assert all(path.parent.name == "rows" for path in changed), changed
