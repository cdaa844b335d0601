"""kill -9 at a random moment of every step: no damaged entry is used, and the next run gives the usual results."""

import random
import shutil
import time
from pathlib import Path

import pytest
from helpers import STEPS, Inputs, Reference, read_entries, read_results


@pytest.mark.timeout(3000)
@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("kills", [1, pytest.param(50, marks=pytest.mark.faults)])
def test_a_killed_step_is_completed_by_the_next_run(
    inputs: Inputs, reference: Reference, folder: Path, step, kills, record_property
):
    rng = random.Random(f"{step} {kills}")
    expected, results = read_entries(reference.after[step]), read_results(reference.after[step])
    killed = completed = late = 0
    lasts = reference.seconds[step]
    while killed < kills:
        reference.copy(folder, reference.before(step))
        in_a_row = rng.choice([1, 1, 1, 2, 3])  # some are killed again before they complete
        for _ in range(min(kills - killed, in_a_row)):
            process = inputs.start(folder, step)
            process.join(rng.uniform(0, 0.9 * lasts))
            late += process.exitcode is not None
            killed += process.exitcode is None
            process.kill()
            process.join()
            left = read_entries(folder)
            assert all(expected[name] == value for name, value in left.items())
        start = time.monotonic()
        ended = inputs.run(folder, step)
        lasts = 0.5 * (lasts + time.monotonic() - start)  # follows the current load of the machine
        assert ended.status == 0, ended.err
        assert read_entries(folder) == expected
        assert read_results(folder) == results
        assert not list((folder / "cache").rglob("*.partial"))
        completed += 1
        shutil.rmtree(folder)
    record_property(
        "summary",
        f"{step}: {killed} kills (and {late} that came too late), {completed} runs after them, all as the reference",
    )
