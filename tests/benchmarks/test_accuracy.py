"""The accuracy benchmark: every system on every data set, paired leads, failures and Ctrl-C."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command import restore_signals

from benchmarks import accuracy
from pipeline.items.scores import Scores
from pipeline.report.run_records import RunRecord


def record(*, correct: bool) -> RunRecord:
    """A run on twelve instances in four images, all correct or all wrong."""
    n = 12
    hit = np.full((n, 10), correct)
    scores = Scores(np.ones(n, int), np.arange(n) % 4, np.arange(n), np.zeros(n, int), np.ones(n), hit, hit, None, "")
    metrics = {"AR_MSSD": float(correct), "AR_MSPD": float(correct), "AR_VSD": None}
    metrics |= {"Acc15_geodesic": 0.25, "template_error_geodesic_deg": 12.34}
    return RunRecord("0", "done", "2026", "m", {}, {}, metrics=metrics, scores=scores)


def stand_in(monkeypatch, record_of) -> list[list[str]]:
    """Records without runs; returns the lists of overrides that would have been run, in order."""
    asked: list[list[str]] = []
    monkeypatch.setattr(accuracy, "run_all", lambda overrides_of, jobs: asked.extend(overrides_of.values()))
    monkeypatch.setattr(accuracy, "read_run_records", lambda out: [record_of(out)])
    return asked


def out_of(overrides: list[str]) -> str:
    return next(override for override in overrides if override.startswith("out="))


def test_every_system_is_run_on_every_data_set_and_the_lead_is_paired(monkeypatch, tmp_path):
    asked = stand_in(monkeypatch, lambda out: record(correct="HOG" not in str(out)))
    text = accuracy.benchmark(tmp_path, lmo=tmp_path / "lmo", detections=tmp_path / "found.json")
    assert len(asked) == 3 * len(accuracy.SYSTEMS)
    assert len({out_of(overrides) for overrides in asked}) == len(asked)
    wrong, lead = "0.000 [0.000, 0.000]", "1.000 [1.000, 1.000]"
    assert text.count(f"| HOG | 0.250 | 12.3 | - | {wrong} | {wrong} | {wrong} | {lead} |") == 3
    assert text.count("AR_VSD") == 0
    assert f"dataset.seed={accuracy.TEST_SEED}" in asked[0]


def test_overrides_apply_to_all_runs_and_get_their_own_results_folder(monkeypatch, tmp_path):
    asked = stand_in(monkeypatch, lambda out: record(correct=True))
    monkeypatch.setattr("sys.argv", ["benchmark", "--folder", str(tmp_path), "second_look=none", "threads=1"])
    accuracy.main()
    assert len(asked) == len(accuracy.SYSTEMS)
    assert all(overrides[-3:-1] == ["second_look=none", "threads=1"] for overrides in asked)  # and out
    accuracy.benchmark(tmp_path)
    assert len({out_of(overrides) for overrides in asked}) == 2 * len(accuracy.SYSTEMS)


def test_runs_share_the_cores_and_paths_may_have_any_characters(monkeypatch, tmp_path):
    asked = stand_in(monkeypatch, lambda out: record(correct=True))
    monkeypatch.setattr(accuracy, "cpu_count", lambda: 8)
    accuracy.benchmark(tmp_path / 'my "own" folder', jobs=2)
    assert all("threads=4" in overrides for overrides in asked)
    escaped = str(tmp_path / 'my \\"own\\" folder' / "data")
    assert all(f'dataset.root="{escaped}"' in overrides for overrides in asked)
    asked.clear()
    accuracy.benchmark(tmp_path)
    assert all("threads=1" in overrides for overrides in asked)


SMALL = ("dataset.objects=1", "dataset.images=2", "dataset.per_image=1", "render.count=12", "second_look=none")


def started(folder: Path, *more: str) -> subprocess.Popen:
    command = [sys.executable, "-m", "benchmarks.accuracy", "--folder", str(folder), "--jobs", "2", *more]
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, **streams, start_new_session=True, preexec_fn=restore_signals)


def test_a_run_that_fails_gives_no_table_and_no_traceback(tmp_path):
    failed = started(tmp_path, "dataset.objects=two")
    out, said = failed.communicate(timeout=120)
    assert failed.returncode == 1
    assert not out
    assert "dataset.objects: found 'two', needs a valid integer" in said
    assert "error: no table: objects of the test seed" in said
    assert "the run failed, see above" in said
    assert "Traceback" not in said


@pytest.mark.parametrize("how", ["interrupted", "killed child"])
def test_a_killed_or_interrupted_run_stops_all_and_says_so(how, tmp_path):
    running = started(tmp_path, *SMALL)
    children = Path(f"/proc/{running.pid}/task/{running.pid}/children")
    until = time.monotonic() + 60
    while len(pids := children.read_text().split()) < 2 and time.monotonic() < until:
        time.sleep(0.05)
    if how == "interrupted":
        os.killpg(running.pid, signal.SIGINT)
    else:
        os.kill(int(pids[0]), signal.SIGKILL)
    out, said = running.communicate(timeout=60)
    assert running.returncode == 1
    assert not out
    assert "Traceback" not in said
    assert ("interrupted. Completed entries are cached" if how == "interrupted" else "killed by signal 9") in said
    assert not any(Path(f"/proc/{pid}").exists() for pid in pids)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["--lmo", "nowhere"], "--lmo: found no folder nowhere, needs that of the dataset"),
        (["--detections", "found.json"], "--detections are those of LM-O: they need --lmo"),
        (["--lmo", ".", "--detections", "found.json"], "--detections: found no file found.json"),
        (["--jobs", "0"], "expected a whole number of at least 1"),
    ],
)
def test_invalid_options_are_refused_before_anything_runs(given, said, monkeypatch, capsys, tmp_path):
    asked = stand_in(monkeypatch, lambda out: record(correct=True))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["benchmark", *given])
    with pytest.raises(SystemExit):
        accuracy.main()
    assert said in capsys.readouterr().err
    assert not asked


def test_recall_of_vsd_is_a_column_if_it_was_computed(monkeypatch, tmp_path):
    plain = record(correct=True)
    scores = replace(plain.scores, vsd=np.ones((12, 10, 10), bool))
    made = replace(plain, scores=scores, metrics=dict(plain.metrics) | {"AR_VSD": 1.0})
    stand_in(monkeypatch, lambda out: made)
    assert "| AR_VSD | AR_MSSD | AR_MSPD | mean |" in accuracy.benchmark(tmp_path)
