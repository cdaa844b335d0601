"""A worker process that dies while it sends a result ends the command, where loky would wait for ever."""

import subprocess
import sys
import time

import pytest

from pipeline.cli import termination
from pipeline.cli.termination import WorkerLost, stop_on_lost_workers

HALF_A_RESULT = """
import gc, os, signal, struct, sys, time
from joblib.externals.loky.process_executor import ProcessPoolExecutor
from pipeline.__main__ import main
from pipeline.cli import termination
import pipeline.__main__

def send_half():
    time.sleep(1)  # the watch sees the worker alive first
    for queue in gc.get_objects():
        if type(queue).__name__ == "SimpleQueue" and hasattr(queue, "_writer"):
            os.write(queue._writer.fileno(), struct.pack("!i", 100) + b"half")
    os.kill(os.getpid(), signal.SIGKILL)

if __name__ == "__main__":
    termination._WATCH_S, termination._NOTICED_S = 0.2, 1.0
    pipeline.__main__._run_jobs = lambda: ProcessPoolExecutor(1).submit(send_half).result()
    main()
"""


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(termination, "_WATCH_S", 0.05)
    monkeypatch.setattr(termination, "_NOTICED_S", 0.3)


def start_worker(lifetime_s: float, name: str = "popen_loky_posix") -> subprocess.Popen:
    return subprocess.Popen([sys.executable, "-S", "-c", f"import time; time.sleep({lifetime_s})", name])


def test_half_a_result_of_a_killed_worker_ends_the_command_in_one_line(tmp_path):
    (tmp_path / "half.py").write_text(HALF_A_RESULT)
    ran = subprocess.run([sys.executable, str(tmp_path / "half.py")], capture_output=True, text=True, timeout=120)
    assert ran.returncode == 1
    (line,) = ran.stderr.strip().splitlines()
    assert line.startswith("error: a worker process was killed, usually because memory ran out.")


def test_a_dead_worker_that_nobody_reaps_is_noticed():
    worker = start_worker(0.3)
    with pytest.raises(WorkerLost), stop_on_lost_workers():
        time.sleep(20)
    worker.wait()


@pytest.mark.parametrize("case", ["reaped", "alive", "another program"])
def test_other_processes_are_left_alone(case):
    process = start_worker(0.3, "backup" if case == "another program" else "popen_loky_posix")
    if case == "alive":
        process.terminate()
        process.wait()
        process = start_worker(30)
    with stop_on_lost_workers():
        if case == "reaped":
            process.wait()
        time.sleep(1.2)
    process.kill()
    process.wait()
