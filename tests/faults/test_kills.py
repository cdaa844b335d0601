"""kill -9 at a random moment of every step: nothing broken counts, and the next run ends as if nothing had been."""

import random
import shutil
import time
from pathlib import Path

import pytest
from helpers import STEPS, Ground, Undisturbed, stored, written


@pytest.mark.timeout(3000)
@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("kills", [1, pytest.param(50, marks=pytest.mark.faults)])
def test_a_killed_step_is_healed_by_the_next_run(
    ground: Ground, quiet: Undisturbed, folder: Path, step, kills, record_property
):
    rng = random.Random(f"{step} {kills}")
    whole, results = stored(quiet.after[step]), written(quiet.after[step])
    killed = healed = late = 0
    lasts = quiet.seconds[step]
    while killed < kills:
        quiet.copy(folder, quiet.before(step))
        in_a_row = rng.choice([1, 1, 1, 2, 3])  # some are killed again before they are healed
        for _ in range(min(kills - killed, in_a_row)):
            process = ground.start(folder, step)
            process.join(rng.uniform(0, 0.9 * lasts))
            late += process.exitcode is not None
            killed += process.exitcode is None
            process.kill()
            process.join()
            left = stored(folder)
            assert all(whole[name] == value for name, value in left.items())
        start = time.monotonic()
        ended = ground.run(folder, step)
        lasts = 0.5 * (lasts + time.monotonic() - start)  # as long as the machine takes now
        assert ended.status == 0, ended.err
        assert stored(folder) == whole
        assert written(folder) == results
        assert not list((folder / "cache").rglob("*.partial"))
        healed += 1
        shutil.rmtree(folder)
    record_property(
        "told", f"{step}: {killed} kills (and {late} that came too late), {healed} runs after them, all as undisturbed"
    )
