"""Several processes on one cold cache, and one of them lost."""

import random
from pathlib import Path

import pytest
from helpers import Ground, Undisturbed, stored, written


@pytest.mark.timeout(3000)
@pytest.mark.parametrize(
    ("count", "lost"),
    [(2, 0), pytest.param(8, 0, marks=pytest.mark.faults), pytest.param(8, 3, marks=pytest.mark.faults)],
)
def test_processes_on_one_cold_cache_end_with_the_bytes_of_one(
    ground: Ground, quiet: Undisturbed, folder: Path, count, lost, record_property
):
    folder.mkdir()
    results = written(quiet.alone)
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
        assert written(folder, f"out-{name}") == results
    assert stored(folder) == stored(quiet.alone)
    record_property(
        "told", f"{count} processes on one cold cache, {lost} of them killed: {count - lost} ended as one undisturbed"
    )
