"""Several processes on one cold cache, some of them killed."""

import random
from pathlib import Path

import pytest
from helpers import Inputs, Reference, read_entries, read_results


@pytest.mark.timeout(3000)
@pytest.mark.parametrize(
    ("count", "killed"),
    [(2, 0), pytest.param(8, 0, marks=pytest.mark.faults), pytest.param(8, 3, marks=pytest.mark.faults)],
)
def test_processes_on_one_cold_cache_write_the_same_bytes_as_one(
    inputs: Inputs, reference: Reference, folder: Path, count, killed, record_property
):
    folder.mkdir()
    results = read_results(reference.single)
    names = [f"process{n}" for n in range(count)]
    processes = [inputs.start(folder, "evaluate", f"out=out-{name}", name=name) for name in names]
    rng = random.Random(count)
    for process in processes[:killed]:
        process.join(rng.uniform(0.5, sum(reference.seconds.values())))
        process.kill()
        process.join()
    for process, name in list(zip(processes, names, strict=True))[killed:]:
        ended = inputs.end(process, folder, name=name)
        assert ended.status == 0, ended.err
        assert read_results(folder, f"out-{name}") == results
    assert read_entries(folder) == read_entries(reference.single)
    record_property(
        "summary",
        f"{count} processes on one cold cache, {killed} of them killed: {count - killed} ended as the reference",
    )
