"""The benchmark's table: every system on every data set, the test seed among no other seeds in use."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from pipeline import benchmark
from pipeline.items.scores import Scores
from pipeline.report.rows import Row


def row(*, correct: bool) -> Row:
    """Twelve instances in four images, all right or all wrong."""
    n = 12
    hit = np.full((n, 10), correct)
    scores = Scores(np.ones(n, int), np.arange(n) % 4, np.arange(n), np.zeros(n, int), np.ones(n), hit, hit, None, "")
    metrics = {"AR_MSSD": float(correct), "AR_MSPD": float(correct), "AR_VSD": None}
    metrics |= {"Acc15_geodesic": 0.25, "template_error_geodesic_deg": 12.34}
    return Row("0", "done", "2026", "m", {}, {}, metrics=metrics, scores=scores)


def test_every_system_has_a_row_on_every_data_set_and_the_lead_is_paired(monkeypatch, tmp_path):
    asked = []

    def run(choices, out: Path, cache: Path):
        asked.append((tuple(choices), out))
        return row(correct="HOG" not in str(out))

    monkeypatch.setattr(benchmark, "_run", run)
    text = benchmark.benchmark(tmp_path, lmo=tmp_path / "lmo", detections=tmp_path / "found.json")
    assert len(asked) == 3 * len(benchmark.SYSTEMS)
    assert len({out for _, out in asked}) == len(asked)
    wrong, lead = "0.000 [0.000, 0.000]", "1.000 [1.000, 1.000]"
    assert text.count(f"| HOG | 0.250 | 12.3 | - | {wrong} | {wrong} | {wrong} | {lead} |") == 3
    assert text.count("AR_VSD") == 0
    assert f"dataset.seed={benchmark.TEST_SEED}" in asked[0][0]


def test_overrides_are_of_every_row_and_have_results_of_their_own(monkeypatch, tmp_path):
    asked = {}

    def run(choices, out: Path, cache: Path):
        asked[out] = choices
        return row(correct=True)

    monkeypatch.setattr(benchmark, "_run", run)
    monkeypatch.setattr("sys.argv", ["benchmark", "--folder", str(tmp_path), "second_look=none", "threads=1"])
    benchmark.main()
    assert len(asked) == len(benchmark.SYSTEMS)
    assert all(choices[-2:] == ["second_look=none", "threads=1"] for choices in asked.values())
    plain = set(asked)
    benchmark.benchmark(tmp_path)
    assert plain.isdisjoint(set(asked) - plain)
    assert len(asked) == 2 * len(benchmark.SYSTEMS)


def test_runs_share_the_cores_and_paths_may_hold_any_sign(monkeypatch, tmp_path):
    asked = []

    def run(choices, out: Path, cache: Path):
        asked.append(choices)
        return row(correct=True)

    monkeypatch.setattr(benchmark, "_run", run)
    monkeypatch.setattr("os.sched_getaffinity", lambda _: set(range(8)))
    benchmark.benchmark(tmp_path / 'my "own" folder', jobs=2)
    assert all("threads=4" in choices for choices in asked)
    escaped = str(tmp_path / 'my \\"own\\" folder' / "data")
    assert all(f'dataset.root="{escaped}"' in choices for choices in asked)
    asked.clear()
    benchmark.benchmark(tmp_path)
    assert all("threads=1" in choices for choices in asked)


def test_a_run_that_fails_gives_no_table_and_no_traceback(tmp_path):
    command = [sys.executable, "-m", "pipeline.benchmark", "--folder", str(tmp_path), "--jobs", "2"]
    failed = subprocess.run([*command, "dataset.objects=two"], capture_output=True, text=True, check=False)
    assert failed.returncode == 1
    assert not failed.stdout
    assert "dataset.objects: found 'two', needs a valid integer" in failed.stderr
    assert "benchmark: no table, a run failed" in failed.stderr
    assert "Traceback" not in failed.stderr


def test_recalls_of_vsd_are_a_column_where_they_are_known(monkeypatch, tmp_path):
    def run(*_):
        plain = row(correct=True)
        scores = replace(plain.scores, vsd=np.ones((12, 10, 10), bool))
        return replace(plain, scores=scores, metrics=dict(plain.metrics) | {"AR_VSD": 1.0})

    monkeypatch.setattr(benchmark, "_run", run)
    assert "| AR_VSD | AR_MSSD | AR_MSPD | mean |" in benchmark.benchmark(tmp_path)
