"""The benchmark's table: every system on every data set, the test seed among no other seeds in use."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command import heeds_ctrl_c

from benchmarks import accuracy as benchmark
from pipeline.items.scores import Scores
from pipeline.report.run_records import RunRecord


def row(*, correct: bool) -> RunRecord:
    """Twelve instances in four images, all right or all wrong."""
    n = 12
    hit = np.full((n, 10), correct)
    scores = Scores(np.ones(n, int), np.arange(n) % 4, np.arange(n), np.zeros(n, int), np.ones(n), hit, hit, None, "")
    metrics = {"AR_MSSD": float(correct), "AR_MSPD": float(correct), "AR_VSD": None}
    metrics |= {"Acc15_geodesic": 0.25, "template_error_geodesic_deg": 12.34}
    return RunRecord("0", "done", "2026", "m", {}, {}, metrics=metrics, scores=scores)


def stand_in(monkeypatch, row_of) -> list[list[str]]:
    """Rows without runs; the choices that would have been run, in their order."""
    asked: list[list[str]] = []
    monkeypatch.setattr(benchmark, "_run_all", lambda choices, jobs: asked.extend(choices.values()))
    monkeypatch.setattr(benchmark, "read_run_records", lambda out: [row_of(out)])
    return asked


def out_of(choices: list[str]) -> str:
    return next(choice for choice in choices if choice.startswith("out="))


def test_every_system_has_a_row_on_every_data_set_and_the_lead_is_paired(monkeypatch, tmp_path):
    asked = stand_in(monkeypatch, lambda out: row(correct="HOG" not in str(out)))
    text = benchmark.benchmark(tmp_path, lmo=tmp_path / "lmo", detections=tmp_path / "found.json")
    assert len(asked) == 3 * len(benchmark.SYSTEMS)
    assert len({out_of(choices) for choices in asked}) == len(asked)
    wrong, lead = "0.000 [0.000, 0.000]", "1.000 [1.000, 1.000]"
    assert text.count(f"| HOG | 0.250 | 12.3 | - | {wrong} | {wrong} | {wrong} | {lead} |") == 3
    assert text.count("AR_VSD") == 0
    assert f"dataset.seed={benchmark.TEST_SEED}" in asked[0]


def test_overrides_are_of_every_row_and_have_results_of_their_own(monkeypatch, tmp_path):
    asked = stand_in(monkeypatch, lambda out: row(correct=True))
    monkeypatch.setattr("sys.argv", ["benchmark", "--folder", str(tmp_path), "second_look=none", "threads=1"])
    benchmark.main()
    assert len(asked) == len(benchmark.SYSTEMS)
    assert all(choices[-3:-1] == ["second_look=none", "threads=1"] for choices in asked)  # and out
    benchmark.benchmark(tmp_path)
    assert len({out_of(choices) for choices in asked}) == 2 * len(benchmark.SYSTEMS)


def test_runs_share_the_cores_and_paths_may_hold_any_sign(monkeypatch, tmp_path):
    asked = stand_in(monkeypatch, lambda out: row(correct=True))
    monkeypatch.setattr(benchmark, "cpu_count", lambda: 8)
    benchmark.benchmark(tmp_path / 'my "own" folder', jobs=2)
    assert all("threads=4" in choices for choices in asked)
    escaped = str(tmp_path / 'my \\"own\\" folder' / "data")
    assert all(f'dataset.root="{escaped}"' in choices for choices in asked)
    asked.clear()
    benchmark.benchmark(tmp_path)
    assert all("threads=1" in choices for choices in asked)


SMALL = ("dataset.objects=1", "dataset.images=2", "dataset.per_image=1", "render.count=12", "second_look=none")


def started(folder: Path, *more: str) -> subprocess.Popen:
    command = [sys.executable, "-m", "benchmarks.accuracy", "--folder", str(folder), "--jobs", "2", *more]
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, **streams, start_new_session=True, preexec_fn=heeds_ctrl_c)


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
def test_what_stops_one_run_stops_all_and_says_so(how, tmp_path):
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
    assert ("interrupted: what was complete is kept" if how == "interrupted" else "killed by signal 9") in said
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
def test_what_cannot_be_is_refused_before_anything_runs(given, said, monkeypatch, capsys, tmp_path):
    asked = stand_in(monkeypatch, lambda out: row(correct=True))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["benchmark", *given])
    with pytest.raises(SystemExit):
        benchmark.main()
    assert said in capsys.readouterr().err
    assert not asked


def test_recalls_of_vsd_are_a_column_where_they_are_known(monkeypatch, tmp_path):
    plain = row(correct=True)
    scores = replace(plain.scores, vsd=np.ones((12, 10, 10), bool))
    made = replace(plain, scores=scores, metrics=dict(plain.metrics) | {"AR_VSD": 1.0})
    stand_in(monkeypatch, lambda out: made)
    assert "| AR_VSD | AR_MSSD | AR_MSPD | mean |" in benchmark.benchmark(tmp_path)
