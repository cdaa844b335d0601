"""A run in several processes: the same bytes as in one; lost processes and setup errors take one line."""

import os
import signal
from pathlib import Path

import psutil
import pytest

from pipeline.errors import BadInput
from pipeline.process_workers import LocalRuntime
from pipeline.spec import build
from pipeline.store import LocalStoreConfig, Store
from pipeline.store.admin import list_entries
from tests.command import TOY, run_dzop, toy_arguments
from tests.same_bytes import contents, poses


def arguments(scene: Path, folder: Path, *overrides: str) -> list[str]:
    return toy_arguments(scene, folder, "render.count=30", *overrides)


def test_two_processes_write_the_bytes_of_one_and_end_with_the_run(scene, tmp_path, capsys, monkeypatch):
    found = {}
    for workers in ("1", "2"):
        ran = run_dzop(capsys, monkeypatch, *arguments(scene, tmp_path / workers, f"runtime.workers={workers}"))
        assert ran.status == 0, ran.err
        store = Store(LocalStoreConfig(root=f"{tmp_path}/{workers}/cache"))
        found[workers] = contents(store) | {"csv": poses(tmp_path / workers / "results")}
        assert ran.counts()[0]["poses"] == (4, 0)
    assert sorted(n for n in found["1"].keys() | found["2"].keys() if found["1"].get(n) != found["2"].get(n)) == []
    children = psutil.Process().children(recursive=True)
    left = [child for child in children if any("loky.backend.popen" in word for word in child.cmdline())]
    assert not psutil.wait_procs(left, timeout=20)[1]


def test_a_lost_process_ends_the_run_in_one_line_and_the_next_run_resumes(scene, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("pipeline.process_workers._do", _end_process)
    ran = run_dzop(capsys, monkeypatch, *arguments(scene, tmp_path, "runtime.workers=2"))
    assert ran.status == 1
    assert "a worker process was lost" in ran.err
    assert "run again: completed entries are kept" in ran.err
    assert "Traceback" not in ran.err
    monkeypatch.undo()
    assert run_dzop(capsys, monkeypatch, *arguments(scene, tmp_path, "runtime.workers=1")).status == 0
    assert all(info.complete for info in list_entries(Store(LocalStoreConfig(root=f"{tmp_path}/cache"))))


def _end_process(task: str, item: object) -> None:
    """Stands in for an item during which the kernel kills its process."""
    os.kill(os.getpid(), signal.SIGKILL)


def test_processes_need_a_store_that_they_share(scene, tmp_path, capsys, monkeypatch):
    places = (f"dataset.root={scene}", f"out={tmp_path}/results")
    ran = run_dzop(capsys, monkeypatch, *TOY, *places, "store=memory", "runtime.workers=2")
    assert ran.status == 1
    assert "found memory with runtime.workers=2" in ran.err


@pytest.mark.parametrize("workers", [0, -1, "all", True, 1.5])
def test_other_numbers_of_workers_are_refused_by_name(workers):
    with pytest.raises(BadInput, match=r"runtime\.workers"):
        build(LocalRuntime, {"workers": workers}, where="runtime")
