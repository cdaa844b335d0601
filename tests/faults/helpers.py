"""The small run that faults are injected into: its command in a process of its own, and its results as bytes."""

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
from pipeline.store import LocalStoreConfig, Store, make_ref
from pipeline.store.admin import entries

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
LOADED = ["pipeline.__main__", "pipeline.stages.detect.proposals.sam", "transformers.models.sam.modeling_sam"]
LOADED += ["pipeline.stages.render.raycast", "trimesh", "scipy.spatial", "sklearn.cluster", "pipeline.report.gallery"]


@dataclass(frozen=True)
class Ended:
    status: int
    out: str
    err: str


@dataclass(frozen=True)
class Ground:
    """Where the dataset and the detector's weights lie."""

    scene: Path
    sam: Path

    def start(self, folder: Path, step: str, *more: str, name: str = "run") -> BaseProcess:
        """``dzop step=...`` with its store and results below ``folder``; prints to ``folder/name.out`` and ``.err``.

        ``detect`` is by a detector with random weights; poses are of true masks, so that there are some.
        """
        cnos = (*CNOS, f"detect.proposals.weights={self.sam}") if step == "detect" else ()
        arguments = [*SMALL, *cnos, f"dataset.root={self.scene}", f"step={step}", *more]
        context = multiprocessing.get_context("forkserver")  # imports are done once; a process is there in no time
        context.set_forkserver_preload(LOADED)
        process = context.Process(target=_command, args=(str(folder), arguments, name))
        process.start()
        return process

    def run(self, folder: Path, step: str = "evaluate", *more: str, name: str = "run") -> Ended:
        """The same to its end. A traceback is a fault of ours whatever was injected."""
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
class Undisturbed:
    """What the steps leave when nothing goes wrong: the folder after each of them, and how long they took.

    ``alone``: the folder of a single ``step=evaluate``.
    """

    after: dict[str, Path]
    seconds: dict[str, float]
    alone: Path

    def before(self, step: str) -> Path | None:
        at = STEPS.index(step)
        return self.after[STEPS[at - 1]] if at else None

    def copy(self, folder: Path, source: Path | None) -> Path:
        """A folder of its own with what ``source`` has."""
        if source is None:
            folder.mkdir()
            return folder
        shutil.copytree(source, folder)
        return folder


def undisturbed(ground: Ground, folder: Path) -> Undisturbed:
    """Every step after the one before."""
    after: dict[str, Path] = {}
    seconds: dict[str, float] = {}
    (folder / "first").mkdir()
    ground.run(folder / "first", "onboard", "plan=true")  # imports are no part of a step's time
    for step in STEPS:
        run = folder / step
        run.mkdir() if not after else shutil.copytree(list(after.values())[-1], run)
        start = time.monotonic()
        ended = ground.run(run, step)
        seconds[step] = time.monotonic() - start
        assert ended.status == 0, ended.err
        after[step] = run
    whole = stored(after["evaluate"])
    assert {path.split("/")[0] for path in whole} == set(KINDS)
    poses = json.loads(next((after["evaluate"] / "results").glob("*/*/poses.json")).read_text())["answers"]
    assert [answer["status"] for answer in poses] == ["estimate"] * 4
    (folder / "alone").mkdir()
    assert ground.run(folder / "alone").status == 0
    assert stored(folder / "alone").items() <= whole.items()
    return Undisturbed(after, seconds, folder / "alone")


def store_of(folder: Path) -> Store:
    return Store(LocalStoreConfig(root=str(folder / "cache")))


def stored(folder: Path) -> dict[str, bytes]:
    """Every array and document of the store's complete entries; seconds that were measured are left out.

    Raises DamagedEntry for an entry that counts as complete and is not.
    """
    store, found = store_of(folder), {}
    for row in entries(store):
        if row.state == "complete":
            entry = store.read(make_ref(row.path.rsplit("/", 1)[0], row.made_from["recipe"], row.made_from["inputs"]))
            found |= {f"{row.path}/{name}": entry.array(name).tobytes() for name in entry.record["arrays"]}
            found[row.path] = canonical(without_seconds(entry.document)).encode()
    return found


def without_seconds(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: without_seconds(item) for name, item in value.items() if name not in MEASURED}
    return [without_seconds(item) for item in value] if isinstance(value, list) else value


def written(folder: Path, out: str = "results") -> dict[str, Any]:
    """The files of the results, times left out; each must be whole."""
    found: dict[str, Any] = {}
    for path in sorted((folder / out).rglob("*")):
        name = path.relative_to(folder / out).as_posix()
        if path.suffix == ".csv":
            found[name] = [row[:-1] for row in csv.reader(path.read_text().splitlines())]
        elif path.suffix == ".json":
            content = json.loads(path.read_text())
            found[name] = without_seconds(content["answers"]) if path.name == "poses.json" else path.name
        elif path.suffix == ".jpg":
            assert path.read_bytes().endswith(b"\xff\xd9"), f"{name} is cut"
            found[name] = path.read_bytes()
    return found
