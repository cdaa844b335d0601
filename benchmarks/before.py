"""Compare this checkout with an earlier commit: both run the same commands alternately, under the same load."""

from __future__ import annotations

import subprocess
import tempfile
from collections import defaultdict
from pathlib import Path

import numpy as np

from benchmarks.cli_runs import ROOT, checkout_of, run_dzop
from benchmarks.measure import Measurement

DEMO = ("dataset=demo", "dataset.objects=3", "dataset.images=6", "dataset.per_image=3", "render.count=60")
_ROUNDS = 3
_VIEWS = 40


def compare_with_before(
    *, device: str, repeats: int, revision: str = "HEAD~1", lmo: Path | None = None
) -> list[Measurement]:
    """Milliseconds per pose with onboarded templates and per onboarded view, seconds of a cached run, and memory.

    ``lmo``: estimate poses in 20 photographs of LM-O instead of the demo's. The time of a cached run is subtracted from
    poses and views. Every round has its own ``solve.seed``, so its poses are not cached.
    """
    data = DEMO if lmo is None else ("dataset=lmo", f"dataset.root={lmo}", "select.sample=20")
    title = "the demo" if lmo is None else "20 images of LM-O"
    found = defaultdict[tuple[str, str], list[float]](list)
    with checkout_of(revision) as before, tempfile.TemporaryDirectory() as name:
        checkouts = {"now": ROOT, "before": before}
        for version, checkout in checkouts.items():
            run_dzop(Path(name) / version, *data, "step=estimate", f"runtime.device={device}", checkout=checkout)
        poses = _count_poses(Path(name) / "now")
        for round_ in range(min(repeats, _ROUNDS)):
            for version, checkout in checkouts.items():
                folder = Path(name) / version
                posing = [*data, "step=estimate", f"solve.seed={round_ + 1}", f"runtime.device={device}"]
                views = [*DEMO, "step=onboard", "select.objects=[1]", f"render.count={_VIEWS + round_}"]
                for what, command, count in (("pose", posing, poses), ("view", views, _VIEWS + round_)):
                    place = [] if what == "pose" else [f"dataset.root={folder / 'data'}"]
                    first, again = (run_dzop(folder, *command, *place, checkout=checkout) for _ in range(2))
                    found[what, version].append(1e3 * (first.cpu_s - again.cpu_s) / count)
                found["start", version].append(again.cpu_s)
                found["peak", version].append(first.peak_mb)
    names = {
        "pose": (f"a pose of dzop_x, {title}, templates onboarded", "ms of one core"),
        "view": ("a view of onboarding, demo", "ms of one core"),
        "start": ("a command that finds everything cached", "s of one core"),
        "peak": ("peak memory of onboarding an object", "MB"),
    }
    short = subprocess.run(["git", "rev-parse", "--short", revision], cwd=ROOT, capture_output=True, text=True).stdout
    return [m for what, named in names.items() for m in _rows(*named, found, what, f"commit {short.strip()}")]


def _rows(
    name: str, unit: str, found: dict[tuple[str, str], list[float]], what: str, against: str
) -> list[Measurement]:
    now, before = (float(np.median(found[what, version])) for version in ("now", "before"))
    return [
        Measurement(name, now, unit),
        Measurement(f"  {name.split(',')[0]}: before / now", before / now, "x", against),
    ]


def _count_poses(folder: Path) -> int:
    """Number of estimates in the results of a run."""
    return sum(len(path.read_text().splitlines()) - 1 for path in (folder / "out").rglob("*.csv"))
