"""Onboarding that was killed at random moments and then completed writes the same bytes as an undisturbed run."""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from pipeline.store import LocalStoreConfig, Store
from pipeline.store.admin import list_entries
from pipeline.synthetic.scenes import write_dataset

KILLS = 10


def onboard(cache: Path, scene: Path) -> subprocess.Popen:
    chosen = ("dataset=bop", "dataset.name=toy", f"dataset.root={scene}", f"store.root={cache}", "step=onboard")
    small = (
        "extract=random_sd",
        "extract.channels=[8,8,16,16]",
        "render.count=60",
        "render.size=96",
        "runtime.batch=4",
    )
    return subprocess.Popen(
        [sys.executable, "-m", "pipeline", *chosen, *small], cwd=scene.parent, stdout=subprocess.PIPE, text=True
    )


def arrays(cache: Path) -> dict[str, np.ndarray]:
    store, found = Store(LocalStoreConfig(root=str(cache))), {}
    for info in list_entries(store):
        assert info.complete
        entry = store.read(info.ref)
        found |= {f"{info.path}/{name}": entry.array(name) for name in entry.arrays}
    return found


def chunks(cache: Path) -> int:
    return sum(not path.name.endswith(".partial") for path in cache.rglob("c.*"))


@pytest.mark.faults
@pytest.mark.timeout(3000)
def test_ten_kills_at_random_moments_change_no_byte(tmp_path):
    scene, reference, disturbed = tmp_path / "scene", tmp_path / "reference", tmp_path / "disturbed"
    write_dataset(scene, objects=1, images=1, seed=2, size_hw=(120, 160), per_image=1, progress=False)
    assert onboard(reference, scene).wait(300) == 0
    expected, rng = chunks(reference), random.Random(7)
    moments = sorted(rng.randrange(1, expected) for _ in range(KILLS))
    for moment in moments:
        process = onboard(disturbed, scene)
        while process.poll() is None and chunks(disturbed) < moment:
            time.sleep(0.005)
        time.sleep(rng.uniform(0, 0.1))
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
    last = onboard(disturbed, scene)
    printed, _ = last.communicate(timeout=300)
    assert last.returncode == 0, printed
    ours, theirs = arrays(reference), arrays(disturbed)
    assert len(ours) == 3 + 3 + 4  # templates: rgb, depth, pose; crops: rgb, mask, affine; features: four layers
    assert set(ours) == set(theirs)
    for name, values in ours.items():
        assert values.tobytes() == theirs[name].tobytes(), name
    assert not list(disturbed.rglob("*.partial"))
