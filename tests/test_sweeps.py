"""Sweeps from a shell continue after a failed job and resume after a kill."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from pipeline.report.run_records import read_run_records
from pipeline.synthetic.scenes import write_dataset

ROOT = Path(__file__).parents[1]
SMALL = ("render.count=12", "render.size=128", "method=dzop", "extract=hog", "overlays=false", "gallery=0",
         "runtime.progress=false", "threads=1")  # fmt: skip

JOBLIB = ("hydra/launcher=joblib", "hydra.launcher.n_jobs=2")
SUBMITIT = ("hydra/launcher=submitit_local", "hydra.launcher.timeout_min=10")


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("synthetic") / "scene"
    write_dataset(root, objects=1, images=2, seed=3, size_hw=(240, 320), per_image=1, progress=False)
    return root


@pytest.fixture
def command(tmp_path, scene, cache):
    def build(*arguments: str) -> list[str]:
        dataset = ("dataset=bop", "dataset.name=toy", f"dataset.root={scene}", f"store.root={cache}")
        flags = [argument for argument in arguments if argument.startswith("-")]  # argparse wants them first
        overrides = [argument for argument in arguments if not argument.startswith("-")]
        return [sys.executable, "-m", "pipeline", *flags, *dataset, *SMALL, f"out={tmp_path}/results", *overrides]

    return build


def ran(command: list[str]) -> subprocess.CompletedProcess:
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300, check=False)


@pytest.mark.slow
@pytest.mark.parametrize("launcher", [(), JOBLIB, SUBMITIT], ids=["basic", "joblib", "submitit"])
def test_a_failed_job_stops_no_other_and_is_named_at_the_end_and_recorded(command, tmp_path, launcher):
    if launcher == SUBMITIT:
        pytest.importorskip("submitit", reason="needs submitit: pip install 'dzop[submitit]'")
    done = ran(command("-m", "cluster.count=4,-1,6", "solve.min_inliers=4", *launcher))
    assert done.returncode == 1
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith("error: 1 of the sweep's jobs failed: ")
    assert "cluster.count=-1 " in last
    assert "cluster.count: found -1, needs greater than or equal to 1" in last
    assert "Traceback" not in done.stderr
    rows = {row.config["cluster"]["count"]: row for row in read_run_records(tmp_path / "results")}
    assert {count: row.status for count, row in rows.items()} == {4: "done", -1: "failed", 6: "done"}
    assert "cluster.count=-1" in rows[-1].overrides
    page = ran([sys.executable, "-m", "pipeline", "step=report", f"out={tmp_path}/results"])
    assert page.returncode == 0, page.stderr
    assert "cluster.count=-1 solve.min_inliers=4 (cluster.count: found -1" in page.stdout
    assert "cluster.count: found -1" in (tmp_path / "results" / "report" / "index.html").read_text()


@pytest.mark.slow
def test_a_nan_fails_only_its_own_job(command, tmp_path):
    done = ran(command("-m", "solve.threshold_px=nan,8"))
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert done.stderr.strip().splitlines()[-1].startswith("error: 1 of the sweep's jobs failed: ")
    rows = {row.status: row.config["solve"]["threshold_px"] for row in read_run_records(tmp_path / "results")}
    assert rows == {"failed": "nan", "done": 8}


@pytest.mark.slow
def test_a_closed_pipe_records_no_failed_job(command, tmp_path):
    jobs = subprocess.Popen(
        command("-m", "cluster.count=3,4"), cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    jobs.stdout.close()
    _, stderr = jobs.communicate(timeout=300)
    assert "jobs failed" not in stderr.decode()
    assert not list(tmp_path.glob("results/rows/*.json"))


@pytest.mark.slow
def test_a_killed_worker_is_reported_in_one_line_and_a_rerun_resumes(command, tmp_path):
    jobs = command("-m", "cluster.count=3,4,5,6,7,8,9,10", *JOBLIB)
    rows = tmp_path / "results" / "rows"
    sweep = subprocess.Popen(jobs, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    limit = time.monotonic() + 120
    while not list(rows.glob("*.json")) and time.monotonic() < limit:
        time.sleep(0.01)
    workers = [p for p in psutil.Process(sweep.pid).children() if any("popen_loky" in word for word in p.cmdline())]
    workers[0].kill()
    _, stderr = sweep.communicate(timeout=300)
    assert sweep.returncode == 1
    assert "Traceback" not in stderr
    # the workers' own watcher may print the last line
    assert any(line.startswith("error: a process of the sweep was killed") for line in stderr.splitlines())
    finished = len(list(rows.glob("*.json")))
    again = ran(jobs)
    assert again.returncode == 0, again.stderr
    assert again.stdout.count("already finished: ") == finished
    assert len(list(rows.glob("*.json"))) == 8


@pytest.mark.slow
def test_a_killed_sweep_resumes_where_it_stopped(command, tmp_path):
    jobs = command("-m", "cluster.count=3,4,5,6,7,8,9,10")
    rows = tmp_path / "results" / "rows"
    sweep = subprocess.Popen(jobs, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    limit = time.monotonic() + 120
    while len(list(rows.glob("*.json"))) < 3 and time.monotonic() < limit:
        time.sleep(0.01)
    sweep.send_signal(signal.SIGKILL)
    sweep.communicate()
    finished = {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in rows.glob("*.json")}
    assert 3 <= len(finished) < 8
    again = ran(jobs)
    assert again.returncode == 0, again.stderr
    assert again.stdout.count("already finished: ") == len(finished)
    assert {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in finished} == finished
    assert len(list(rows.glob("*.json"))) == 8
    assert [row.counts["template features"]["computed"] for row in read_run_records(tmp_path / "results")].count(0) >= 7


@pytest.mark.slow
def test_a_finished_job_is_repeated_when_its_files_are_gone(command, tmp_path, scene):
    job = command("-m", "cluster.count=5")
    assert ran(job).returncode == 0
    (csv,) = (tmp_path / "results").glob("*/*/*.csv")
    os.remove(csv)
    again = ran(job)
    assert "already finished" not in again.stdout
    assert csv.exists()
    assert "already finished" in ran(job).stdout


@pytest.mark.slow
@pytest.mark.parametrize(("sweep", "jobs"), [("correspondence", 4), ("ladder", 4), ("theta", 6)])
def test_a_sweep_yaml_records_every_job(command, tmp_path, sweep, jobs):
    done = ran(command(f"sweep={sweep}"))
    assert done.returncode == 0, done.stderr
    rows = read_run_records(tmp_path / "results")
    assert len(rows) == jobs
    assert {row.sweep for row in rows} == {sweep}
    if sweep == "ladder":
        recall = {row.config["variation"]: row.metrics["AR_MSPD"] for row in rows}
        assert recall["oracle_correspondences"] == 1.0
        assert recall["oracle_mask"] == recall["none"]  # the detections are true masks already
