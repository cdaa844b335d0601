"""gc beside whole runs: it keeps what they use, and when they have ended, however they did, it removes everything."""

import os
import signal
import time
from multiprocessing.process import BaseProcess
from pathlib import Path

import pytest
from helpers import Inputs, store_of

from pipeline.store.admin import collect_garbage, list_entries


@pytest.mark.faults
@pytest.mark.timeout(600)
@pytest.mark.parametrize("ending", ["completed", "killed", "terminated", "failed"])
def test_gc_keeps_what_a_run_uses_and_then_removes_everything(inputs: Inputs, folder: Path, ending, record_property):
    folder.mkdir()
    process, store, calls = inputs.start(folder, "evaluate"), store_of(folder), 0
    while process.is_alive():
        removed = collect_garbage(store, older_than_h=0.0, dry_run=False)
        assert not removed or not process.is_alive()
        calls += 1
        time.sleep(0.02)
        if ending != "completed" and (folder / "cache" / "poses").is_dir():
            end_early(process, folder, ending)
    process.join()
    statuses = {"completed": 0, "killed": -signal.SIGKILL, "terminated": 1, "failed": 1}
    assert process.exitcode == statuses[ending]
    left = len(list_entries(store))
    collect_garbage(store, older_than_h=0.0, dry_run=False)
    assert list_entries(store) == []
    assert not list((folder / "cache" / ".leases").rglob("*"))
    record_property("summary", f"{calls} gc beside a run that {ending}, which kept all; then it removed {left} entries")


def end_early(process: BaseProcess, folder: Path, ending: str) -> None:
    assert process.pid is not None
    if ending == "failed":  # a folder that the run writes its results to
        (folder / "results").rename(folder / "moved")
        (folder / "results").write_text("")
    else:
        os.kill(process.pid, signal.SIGKILL if ending == "killed" else signal.SIGTERM)
    process.join(60)
