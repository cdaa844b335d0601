"""Whole runs: time of a cached job, time of onboarding an object, peak memory of step=estimate."""

from __future__ import annotations

import contextlib
import io
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from benchmarks.measure import Measurement, peak_bytes, time_interleaved
from pipeline.configuration import CONF, build_options, build_stages, build_variant
from pipeline.run import run
from pipeline.store import Store

SMALL = ("dataset=demo", "dataset.objects=15", "dataset.images=8", "dataset.per_image=3", "evaluate.vsd=false")
QUIET = ("overlays=false", "gallery=0", "runtime.progress=false")
FEW, MANY = 2, 6


def job(folder: Path, *overrides: str) -> None:
    """One run as from the command line, without its output."""
    places = (f"dataset.root={folder / 'data'}", f"store.root={folder / 'cache'}", f"out={folder / 'out'}")
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("config", [*places, *QUIET, f"threads={torch.get_num_threads()}", *overrides])
    values = OmegaConf.to_container(config, resolve=True)
    assert isinstance(values, dict)
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        run(
            stages=build_stages(values),  # type: ignore[arg-type]
            dataset=build_variant(values["dataset"], "dataset"),
            store=Store(build_variant(values["store"], "store")),
            runtime=build_variant(values["runtime"], "runtime"),
            options=build_options(values),  # type: ignore[arg-type]
        )


def warm(*, device: str, repeats: int) -> list[Measurement]:
    """Seconds of a job for which everything is cached."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        chosen = (*SMALL, "extract=pixels", "render.count=12", f"runtime.device={device}")
        job(folder, *chosen)
        times = time_interleaved(
            {"job": lambda: job(folder, *chosen), "estimate": lambda: job(folder, *chosen, "step=estimate")},
            repeats=repeats,
        )
    sized = "15 objects, 8 images, 24 targets"
    return [
        Measurement(f"warm job, step=all, {sized}", times["job"].cpu_s, "s of one core", "", 0.3),
        Measurement(f"warm job, step=estimate, {sized}", times["estimate"].cpu_s, "s of one core", "", 0.3),
    ]


def onboarding(*, device: str, repeats: int) -> list[Measurement]:
    """Milliseconds per view of onboarding one object with the embedded model."""
    chosen = ("dataset=demo", "dataset.objects=1", "dataset.images=1", "dataset.per_image=1", "step=onboard")
    views, seconds = 24, []
    with tempfile.TemporaryDirectory() as name:
        for run_number in range(2):  # the first run generates the data and loads the model
            start = time.process_time()
            job(Path(name), *chosen, f"render.count={views + run_number}", f"runtime.device={device}")
            seconds.append(time.process_time() - start)
    return [
        Measurement(
            "onboarding, one object, embedded model", 1e3 * seconds[-1] / (views + 1), "ms of one core per view"
        )
    ]


def memory(*, device: str, repeats: int) -> list[Measurement]:
    """Peak memory of step=estimate with few and with many objects, each measured in its own process.

    "features cached": with another setting for correspondences, so that only poses are computed.
    """
    with tempfile.TemporaryDirectory() as name:
        peaks = {objects: _peak_mb(Path(name) / str(objects), objects, device, 10) for objects in (FEW, MANY)}
        again = {objects: _peak_mb(Path(name) / str(objects), objects, device, 9) for objects in (FEW, MANY)}
    measurements = []
    for title, peak_of in (("nothing cached", peaks), ("features cached", again)):
        grown = (peak_of[MANY] - peak_of[FEW]) / (MANY - FEW)
        measurements += [
            Measurement(f"peak memory of estimate, {MANY} objects, {title}", peak_of[MANY], "MB"),
            Measurement(f"memory per additional object, {title}", grown, "MB", f"{FEW} objects", 2.0),
        ]
    return measurements


def _peak_mb(folder: Path, objects: int, device: str, per_cluster: int) -> float:
    command = [sys.executable, "-m", "benchmarks.jobs", str(folder), str(objects), device, str(per_cluster)]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "MALLOC_ARENA_MAX": "1"}
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    return float(json.loads(done.stdout.splitlines()[-1])["peak_mb"])


def _estimate(folder: str, objects: str, device: str, per_cluster: str) -> None:
    """Run step=estimate in this process, and print its peak memory as JSON."""
    torch.set_num_threads(1)
    size = ("dataset=demo", f"dataset.objects={objects}", f"dataset.images={objects}", "dataset.per_image=1")
    chosen = ("extract=coordinates", "method=dzop", "render.count=16", "step=estimate", f"runtime.device={device}")
    if not (Path(folder) / "done").exists():
        Path(folder).mkdir(parents=True)
        job(Path(folder), *size, "extract=pixels", "render.count=2", "step=detect")  # generates the data set
    job(Path(folder), *size, *chosen, f"correspond.per_cluster={per_cluster}")
    (Path(folder) / "done").touch()
    print(json.dumps({"peak_mb": peak_bytes() / 2**20}))


if __name__ == "__main__":
    _estimate(*sys.argv[1:])
