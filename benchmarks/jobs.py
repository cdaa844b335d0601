"""Whole runs: time of a cached job, time of onboarding an object, peak memory of step=estimate."""

from __future__ import annotations

import contextlib
import io
import tempfile
import time
from pathlib import Path

import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from benchmarks.cli_runs import run_dzop
from benchmarks.measure import Measurement, time_interleaved
from pipeline.configuration import CONF, build_options, build_stages, build_variant
from pipeline.run import run
from pipeline.store import Store

SMALL = ("dataset=demo", "dataset.objects=15", "dataset.images=8", "dataset.per_image=3", "evaluate.vsd=false")
QUIET = ("overlays=false", "gallery=0", "runtime.progress=false")
FEW, MANY = 4, 16
# glibc returns blocks of at least these bytes at once: peaks are of what is in use, not of how the heap is divided
_LARGE_BLOCK = "131072"


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
    """Milliseconds per view of onboarding one object with the embedded model.

    A job reads its configuration and the model's weights first; the second row is a view without that share.
    """
    chosen = ("dataset=demo", "dataset.objects=1", "dataset.images=1", "dataset.per_image=1", "step=onboard")
    seconds = {}
    with tempfile.TemporaryDirectory() as name:
        for views in (24, 25, 150):  # the first run generates the data and imports the libraries
            start = time.process_time()
            job(Path(name), *chosen, f"render.count={views}", f"runtime.device={device}")
            seconds[views] = time.process_time() - start
    unit, title = "ms of one core per view", "onboarding, embedded model"
    return [
        Measurement(f"{title}: 25 views, start of the job included", 1e3 * seconds[25] / 25, unit),
        Measurement(f"{title}: each further view", 1e3 * (seconds[150] - seconds[25]) / 125, unit, "", 35.0),
    ]


def memory(*, device: str, repeats: int) -> list[Measurement]:
    """Peak memory of step=estimate with few and with many objects, each measured in its own process.

    "features cached": with another setting for correspondences, so that only poses are computed.
    """
    chosen = ("extract=coordinates", "method=dzop", "render.count=16", "step=estimate", f"runtime.device={device}")
    peaks = dict[tuple[str, int], float]()
    for objects in (FEW, MANY):
        size = ("dataset=demo", f"dataset.objects={objects}", f"dataset.images={objects}", "dataset.per_image=1")
        with tempfile.TemporaryDirectory() as name:
            run_dzop(Path(name), *size, "extract=pixels", "render.count=2", "step=detect")  # generates the data set
            for title, per_cluster in (("nothing cached", 10), ("features cached", 9)):
                asked = [*size, *chosen, f"correspond.per_cluster={per_cluster}"]
                usage = run_dzop(Path(name), *asked, MALLOC_MMAP_THRESHOLD_=_LARGE_BLOCK)
                peaks[title, objects] = usage.peak_mb
    measurements = []
    for title in ("nothing cached", "features cached"):
        grown = (peaks[title, MANY] - peaks[title, FEW]) / (MANY - FEW)
        measurements += [
            Measurement(f"peak memory of estimate, {MANY} objects, {title}", peaks[title, MANY], "MB"),
            Measurement(f"memory per additional object, {title}", grown, "MB", f"{FEW} objects", 2.0),
        ]
    return measurements
