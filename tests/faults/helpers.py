"""A small run to inject faults into: its command in a separate process, and its results as comparable bytes."""

import csv
import json
import multiprocessing
import os
import shutil
import sys
import time
from dataclasses import dataclass
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from pipeline.spec import canonical
from pipeline.store import LocalStoreConfig, Store
from pipeline.store.admin import list_entries

STEPS = ("onboard", "detect", "estimate", "evaluate")
SMALL = (
    "dataset=bop", "dataset.name=toy", "method=dzop", "extract=hog", "match=words", "match.count=1500", "match.dim=16",
    "match.iterations=3", "match.samples=20000", "cluster.count=8", "render.viewpoints=superfibonacci",
    "render.count=16", "render.size=96", "evaluate.vsd=false", "gallery=2", "threads=1", "runtime.progress=false",
    "runtime.device=cpu", "runtime.batch=3",
)  # fmt: skip
CNOS = (
    "detect=cnos", "extract@detect.describe=hog", "detect.describe_layer=8", "detect.proposals.points_per_side=3",
    "detect.proposals.min_iou=0", "detect.proposals.min_stability=0.1",
)  # fmt: skip
KINDS = ("templates", "crops", "features", "fitted", "proposals", "detections", "poses", "runs", "scores")
MEASURED = ("time_s", "times_s")
LOADED = ["pipeline.__main__", "pipeline.run", "pipeline.cli.cache", "transformers.models.sam.modeling_sam"]
LOADED += ["pipeline.stages.detect.proposals.sam"]
LOADED += ["pipeline.stages.render.raycast", "trimesh", "scipy.spatial", "sklearn.cluster", "pipeline.report.gallery"]


@dataclass(frozen=True)
class Ended:
    status: int
    out: str
    err: str


@dataclass(frozen=True)
class Inputs:
    """Folders of the dataset and of the detector's weights, and the command that uses them."""

    scene: Path
    sam: Path

    def start(self, folder: Path, step: str, *more: str, name: str = "run") -> BaseProcess:
        """Start ``dzop step=...`` with store and results below ``folder``; prints to ``folder/name.out`` and ``.err``.

        ``detect`` uses a detector with random weights. Poses are estimated from true masks, so that there are any.
        """
        cnos = (*CNOS, f"detect.proposals.weights={self.sam}") if step == "detect" else ()
        arguments = [*SMALL, *cnos, f"dataset.root={self.scene}", f"step={step}", *more]
        context = multiprocessing.get_context("forkserver")  # imports once, so that processes start quickly
        context.set_forkserver_preload(LOADED)
        process = context.Process(target=_command, args=(str(folder), arguments, name))
        process.start()
        return process

    def run(self, folder: Path, step: str = "evaluate", *more: str, name: str = "run") -> Ended:
        """Start the command and wait for it. A traceback is a bug, whatever fault was injected."""
        return self.end(self.start(folder, step, *more, name=name), folder, name=name)

    def end(self, process: BaseProcess, folder: Path, *, name: str = "run") -> Ended:
        process.join(300)
        assert process.exitcode is not None
        out, err = ((folder / f"{name}.{stream}").read_text() for stream in ("out", "err"))
        assert "Traceback" not in err, err
        return Ended(process.exitcode, out, err)


def _command(folder: str, arguments: list[str], name: str) -> None:
    os.environ["OMP_NUM_THREADS"] = "1"
    os.chdir(folder)
    for number, stream in ((1, "out"), (2, "err")):
        os.dup2(os.open(f"{name}.{stream}", os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
    sys.argv = ["dzop", *arguments]
    from pipeline.__main__ import main

    main()


@dataclass(frozen=True)
class Reference:
    """Results of an undisturbed run: the folder after each step, and the seconds each step took.

    ``single``: the folder of a single ``step=evaluate`` on an empty cache.
    """

    after: dict[str, Path]
    seconds: dict[str, float]
    single: Path

    def before(self, step: str) -> Path | None:
        at = STEPS.index(step)
        return self.after[STEPS[at - 1]] if at else None

    def copy(self, folder: Path, source: Path | None) -> Path:
        """Copy ``source`` to ``folder``; an empty folder for None."""
        if source is None:
            folder.mkdir()
            return folder
        shutil.copytree(source, folder)
        return folder


def run_reference(inputs: Inputs, folder: Path) -> Reference:
    """Run every step on the results of the one before."""
    after: dict[str, Path] = {}
    seconds: dict[str, float] = {}
    (folder / "first").mkdir()
    inputs.run(folder / "first", "onboard", "plan=true")  # warms up imports, which are not part of a step's time
    for step in STEPS:
        run = folder / step
        run.mkdir() if not after else shutil.copytree(list(after.values())[-1], run)
        start = time.monotonic()
        ended = inputs.run(run, step)
        seconds[step] = time.monotonic() - start
        assert ended.status == 0, ended.err
        after[step] = run
    expected = read_entries(after["evaluate"])
    assert {path.split("/")[0] for path in expected} == set(KINDS)
    poses = json.loads(next((after["evaluate"] / "results").glob("*/*/poses.json")).read_text())["answers"]
    assert [answer["status"] for answer in poses] == ["estimate"] * 4
    (folder / "single").mkdir()
    assert inputs.run(folder / "single").status == 0
    assert read_entries(folder / "single").items() <= expected.items()
    return Reference(after, seconds, folder / "single")


def store_of(folder: Path) -> Store:
    return Store(LocalStoreConfig(root=str(folder / "cache")))


def read_entries(folder: Path) -> dict[str, bytes]:
    """Every array and document of the store's complete entries, without measured seconds.

    Raises DamagedEntry for an entry that is recorded as complete but is damaged.
    """
    store, found = store_of(folder), {}
    for info in list_entries(store):
        if info.complete:
            entry = store.read(info.ref)
            found |= {f"{info.path}/{name}": entry.array(name).tobytes() for name in entry.arrays}
            found[info.path] = canonical(remove_times(entry.document)).encode()
    return found


def remove_times(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: remove_times(item) for name, item in value.items() if name not in MEASURED}
    return [remove_times(item) for item in value] if isinstance(value, list) else value


def read_results(folder: Path, out: str = "results") -> dict[str, Any]:
    """The results files without measured seconds; none may be truncated."""
    found: dict[str, Any] = {}
    for path in sorted((folder / out).rglob("*")):
        name = path.relative_to(folder / out).as_posix()
        if path.suffix == ".csv":
            found[name] = [row[:-1] for row in csv.reader(path.read_text().splitlines())]
        elif path.suffix == ".json":
            content = json.loads(path.read_text())
            found[name] = remove_times(content["answers"]) if path.name == "poses.json" else path.name
        elif path.suffix == ".jpg":
            assert path.read_bytes().endswith(b"\xff\xd9"), f"{name} is truncated"
            found[name] = path.read_bytes()
    return found
