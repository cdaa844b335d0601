"""Onboarding killed at random moments, then run to its end, leaves the bytes of a run that nobody disturbed."""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from pipeline.store import LocalStoreConfig, Store, make_ref
from pipeline.store.admin import entries
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
    for row in entries(store):
        assert row.state == "complete"
        entry = store.read(make_ref(row.path.rsplit("/", 1)[0], row.made_from["recipe"], row.made_from["inputs"]))
        found |= {f"{row.path}/{name}": entry.array(name) for name in entry.record["arrays"]}
    return found


def chunks(cache: Path) -> int:
    return sum("c" in path.parts[-6:] for path in cache.rglob("*") if path.is_file())


@pytest.mark.faults
def test_ten_kills_at_random_moments_change_no_byte(tmp_path):
    scene, quiet, disturbed = tmp_path / "scene", tmp_path / "quiet", tmp_path / "disturbed"
    write_dataset(scene, objects=1, images=1, seed=2, size_hw=(120, 160), per_image=1, progress=False)
    start = time.monotonic()
    assert onboard(quiet, scene).wait(300) == 0
    whole, rng = chunks(quiet), random.Random(7)
    moments = sorted(rng.randrange(1, whole) for _ in range(KILLS))
    for moment in moments:
        process = onboard(disturbed, scene)
        while process.poll() is None and chunks(disturbed) < moment:
            time.sleep(0.005)
        time.sleep(rng.uniform(0, 0.1))
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        assert time.monotonic() - start < 500
    last = onboard(disturbed, scene)
    printed, _ = last.communicate(timeout=300)
    assert last.returncode == 0, printed
    ours, theirs = arrays(quiet), arrays(disturbed)
    assert len(ours) == 3 + 3 + 4  # templates: rgb, depth, pose; crops: rgb, mask, affine; features: four layers
    assert set(ours) == set(theirs)
    for name, values in ours.items():
        assert values.tobytes() == theirs[name].tobytes(), name
    assert not list(disturbed.rglob("*.partial"))
