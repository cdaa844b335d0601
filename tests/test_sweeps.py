"""Sweeps from a shell continue after a failed job and resume after a kill."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest
from command import CommandResult, restore_signals, run_dzop

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
    """Arguments of ``dzop`` on the scene."""

    def build(*arguments: str) -> list[str]:
        dataset = ("dataset=bop", "dataset.name=toy", f"dataset.root={scene}", f"store.root={cache}")
        flags = [argument for argument in arguments if argument.startswith("-")]  # argparse wants them first
        overrides = [argument for argument in arguments if not argument.startswith("-")]
        return [*flags, *dataset, *SMALL, f"out={tmp_path}/results", *overrides]

    return build


@pytest.fixture
def dzop(capsys, monkeypatch, command):
    """Run ``dzop`` in this process."""
    return lambda *arguments: run_dzop(capsys, monkeypatch, *command(*arguments))


@pytest.fixture
def start(tmp_path):
    """Start ``dzop`` as a process whose working directory goes with the test."""

    def popen(arguments: list[str]) -> subprocess.Popen:
        command, env = [sys.executable, "-m", "pipeline", *arguments], os.environ | {"PYTHONPATH": str(ROOT)}
        streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        return subprocess.Popen(command, cwd=tmp_path, env=env, preexec_fn=restore_signals, **streams)

    return popen


def check_failed_job(status: int | str | None, err: str, results: Path, page: CommandResult) -> None:
    """One job of several had cluster.count=-1: the end of the output, the rows and the page name it."""
    assert status == 1
    last = err.strip().splitlines()[-1]
    assert last.startswith("error: 1 of the sweep's jobs failed: ")
    assert "cluster.count=-1 " in last
    assert "cluster.count: found -1, needs greater than or equal to 1" in last
    assert "Traceback" not in err
    records = {record.config["cluster"]["count"]: record for record in read_run_records(results)}
    assert {record.status for count, record in records.items() if count > 0} == {"done"}
    assert records[-1].status == "failed"
    assert "cluster.count=-1" in records[-1].overrides
    assert page.status == 0, page.err
    assert "cluster.count=-1 solve.min_inliers=4 (cluster.count: found -1" in page.out
    assert "cluster.count: found -1" in (results / "report" / "index.html").read_text()


def test_a_failed_job_stops_no_other_and_is_named_at_the_end_and_recorded(dzop, tmp_path):
    done = dzop("-m", "cluster.count=4,-1,6", "solve.min_inliers=4")
    check_failed_job(done.status, done.err, tmp_path / "results", dzop("step=report"))
    assert len(read_run_records(tmp_path / "results")) == 3


@pytest.mark.slow
@pytest.mark.parametrize("launcher", [JOBLIB, SUBMITIT], ids=["joblib", "submitit"])
def test_a_failed_job_of_another_launcher_stops_no_other_and_is_recorded(
    command, dzop, start, tmp_path, cache, launcher
):
    if launcher == SUBMITIT:
        pytest.importorskip("submitit", reason="needs submitit: pip install --editable '.[submitit]'")
    done = start(command("-m", "cluster.count=-1,6", "solve.min_inliers=4", *launcher))
    _, err = done.communicate(timeout=300)
    check_failed_job(done.returncode, err, tmp_path / "results", dzop("step=report"))
    assert len(read_run_records(tmp_path / "results")) == 2
    assert not list((cache / ".leases").glob("*"))


def test_a_nan_fails_only_its_own_job(dzop, tmp_path):
    done = dzop("-m", "solve.threshold_px=nan,8")
    assert done.status == 1
    assert "Traceback" not in done.err
    assert done.err.strip().splitlines()[-1].startswith("error: 1 of the sweep's jobs failed: ")
    rows = {row.status: row.config["solve"]["threshold_px"] for row in read_run_records(tmp_path / "results")}
    assert rows == {"failed": "nan", "done": 8}


@pytest.mark.slow
def test_a_closed_pipe_records_no_failed_job(command, start, tmp_path):
    jobs = start(command("-m", "cluster.count=3,4"))
    jobs.stdout.close()
    assert "jobs failed" not in jobs.stderr.read()
    assert jobs.wait(timeout=300) is not None
    assert not list(tmp_path.glob("results/rows/*.json"))


@pytest.mark.slow
def test_a_killed_worker_is_reported_in_one_line_and_a_rerun_resumes(command, start, tmp_path):
    jobs = command("-m", "cluster.count=3,4,5,6,7,8", *JOBLIB)
    rows = tmp_path / "results" / "rows"
    sweep = start(jobs)
    wait_for(rows, 1)
    workers = [p for p in psutil.Process(sweep.pid).children() if any("popen_loky" in word for word in p.cmdline())]
    time.sleep(0.3)  # into the next job: loky waits for ever for a worker that dies while it sends a result
    workers[0].kill()
    _, err = sweep.communicate(timeout=300)
    assert sweep.returncode == 1
    assert "Traceback" not in err
    # the workers' own watcher may print the last line
    assert any(line.startswith("error: a worker process was killed") for line in err.splitlines())
    finished = len(list(rows.glob("*.json")))
    again = start(jobs)
    out, err = again.communicate(timeout=300)
    assert again.returncode == 0, err
    assert out.count("already finished: ") == finished
    assert len(list(rows.glob("*.json"))) == 6


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGINT])
def test_a_sweep_that_is_told_to_end_ends_its_workers(command, start, tmp_path, number):
    sweep = start(command("-m", "cluster.count=3,4,5,6,7,8,9,10", *JOBLIB))
    limit = time.monotonic() + 120
    while not list((tmp_path / "results" / "rows").glob("*.json")) and time.monotonic() < limit:
        time.sleep(0.01)
    children = psutil.Process(sweep.pid).children(recursive=True)
    assert any("popen_loky" in " ".join(child.cmdline()) for child in children)
    sweep.send_signal(number)
    _, stderr = sweep.communicate(timeout=60)
    assert sweep.returncode == 1
    assert stderr.strip().splitlines()[-1].endswith("ed. Completed entries are cached; rerun to resume."), stderr
    assert "Traceback" not in stderr
    assert not psutil.wait_procs(children, timeout=10)[1]


@pytest.mark.slow
def test_a_killed_sweep_resumes_where_it_stopped(command, dzop, start, tmp_path):
    jobs = "-m", "cluster.count=3,4,5,6,7,8,9,10"
    rows = tmp_path / "results" / "rows"
    sweep = start(command(*jobs))
    wait_for(rows, 3)
    sweep.send_signal(signal.SIGKILL)
    sweep.communicate()
    finished = {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in rows.glob("*.json")}
    assert 3 <= len(finished) < 8
    again = dzop(*jobs)
    assert again.status == 0, again.err
    assert again.out.count("already finished: ") == len(finished)
    assert {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in finished} == finished
    assert len(list(rows.glob("*.json"))) == 8
    assert [row.counts["template features"]["computed"] for row in read_run_records(tmp_path / "results")].count(0) >= 7


def wait_for(rows: Path, count: int) -> None:
    limit = time.monotonic() + 120
    while len(list(rows.glob("*.json"))) < count and time.monotonic() < limit:
        time.sleep(0.01)


def test_a_finished_job_is_repeated_when_its_files_are_gone(dzop, tmp_path):
    job = "-m", "cluster.count=5"
    assert dzop(*job).status == 0
    (csv,) = (tmp_path / "results").glob("*/*/*.csv")
    os.remove(csv)
    again = dzop(*job)
    assert "already finished" not in again.out
    assert csv.exists()
    assert "already finished" in dzop(*job).out


def test_a_ladder_of_oracles_climbs(dzop, tmp_path):
    assert dzop("sweep=ladder").status == 0
    rows = read_run_records(tmp_path / "results")
    recall = {row.config["variation"]: row.metrics["AR_MSPD"] for row in rows}
    assert len(recall) == 5
    assert recall["oracle_correspondences"] == 1.0
    assert recall["oracle_mask"] == recall["none"]  # the detections are true masks already
