"""Several processes on one cold cache, and one of them lost."""

import random
from pathlib import Path

import pytest
from ground import Ground, Undisturbed, stored, written


@pytest.mark.timeout(3000)
@pytest.mark.parametrize(("count", "lost"), [(2, 0), pytest.param(8, 0, marks=pytest.mark.faults), pytest.param(8, 3, marks=pytest.mark.faults)])
def test_processes_on_one_cold_cache_end_with_the_bytes_of_one(ground: Ground, quiet: Undisturbed, folder: Path, count, lost, record_property):
    folder.mkdir()
    names = [f"process{n}" for n in range(count)]
    processes = [ground.start(folder, "evaluate", f"out=out-{name}", name=name) for name in names]
    rng = random.Random(count)
    for process in processes[:lost]:
        process.join(rng.uniform(0.5, sum(quiet.seconds.values())))
        process.kill()
        process.join()
    for process, name in list(zip(processes, names, strict=True))[lost:]:
        ended = ground.end(process, folder, name=name)
        assert ended.status == 0, ended.err
        assert _as_results(written_of(folder, name)) == _as_results(written(quiet.after["evaluate"]))
    assert stored(folder) == stored(quiet.after["evaluate"])
    record_property("told", f"{count} processes on one cold cache, {lost} of them killed: {count - lost} ended as one undisturbed")


def written_of(folder: Path, name: str) -> dict:
    (folder / "results").unlink(missing_ok=True)
    (folder / "results").symlink_to(folder / f"out-{name}")
    found = {}
    for path, value in written(folder).items():
        found[path] = value
    return found


def _as_results(found: dict) -> dict:
    return {name: value for name, value in found.items() if not name.endswith("detections.json")}
