"""One table: the embedded model beside its controls, on objects of a seed that nothing was trained or chosen on."""

from __future__ import annotations

import argparse
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from joblib import cpu_count

from pipeline.errors import DzopError
from pipeline.items.scores import Scores
from pipeline.metrics.bootstrap import Interval, image_index, mean_interval
from pipeline.metrics.recall import instance_recalls
from pipeline.report.run_records import RunRecord, read_run_records
from pipeline.spec import digest

TEST_SEED = 9041  # of synthetic.demo; training and validation objects have builders and seeds of their own
DEMO = ("dataset=demo", f"dataset.seed={TEST_SEED}", "dataset.objects=20", "dataset.images=40", "dataset.per_image=5")
OURS = "embedded, learned and edges"
SYSTEMS = {
    OURS: ("extract=embedded",),
    "embedded, pure": ("extract=embedded", "extract.weights=pure"),
    "random weights": ("extract=random_sd", "extract.noise=none"),
    "pixels": ("extract=pixels",),
    "HOG": ("extract=hog",),
    "embedded, learned alone": ("extract=embedded", "fuse=learned", "fuse.layers=[2,5,8,11]"),
}  # in the order they run in: those that share features do so one after the other
TEMPLATES = {
    "Acc15_geodesic": "Acc15",
    "template_error_geodesic_deg": "template error, deg",
    "correspondence_error_percent": "correspondence error, % of diameter",
}
RECALLS = ("AR_VSD", "AR_MSSD", "AR_MSPD")  # in the order of metrics.recall.instance_recalls
QUIET = ("gallery=0", "overlays=false", "evaluate.correspondences=true")


def benchmark(
    folder: Path,
    *,
    lmo: Path | None = None,
    detections: Path | None = None,
    jobs: int | None = None,
    overrides: Sequence[str] = (),
) -> str:
    """Tables in Markdown; every run is cached, an interrupted benchmark goes on where it stopped.

    ``jobs`` runs at a time share the cores; None: one for each core. ``overrides`` are those of ``python -m pipeline``,
    for every row alike. Raises DzopError for a run that failed.
    """
    parts: dict[str, tuple[str, ...]] = {"objects of the test seed": (*DEMO, _at("dataset.root", folder / "data"))}
    if lmo is not None:
        parts["LM-O, visible masks"] = ("dataset=lmo", _at("dataset.root", lmo), "evaluate.vsd=false")
        if detections is not None:
            found = ("detect=json", _at("detect.path", detections))
            parts["LM-O, detections"] = (*parts["LM-O, visible masks"], *found)
    results = folder / "results" / digest(list(overrides))[:8] if overrides else folder / "results"
    cores = cpu_count()
    jobs = min(jobs or cores, len(parts) * len(SYSTEMS))
    shared = [*QUIET, f"threads={max(1, cores // jobs)}", _at("store.root", folder / "cache")]
    outs = {(title, name): results / _folder(title) / _folder(name) for title in parts for name in SYSTEMS}
    choices = {
        (title, name): ["method=dzop_x", *SYSTEMS[name], *shared, *parts[title], *overrides, _at("out", out)]
        for (title, name), out in outs.items()
    }
    _run_all(choices, jobs=jobs)
    rows = {run: max(read_run_records(out), key=lambda row: row.at) for run, out in outs.items()}
    return "\n\n".join(_table(title, {name: rows[title, name] for name in SYSTEMS}) for title in parts)


def _run_all(choices: Mapping[tuple[str, str], Sequence[str]], *, jobs: int) -> None:
    """Runs of the pipeline, ``jobs`` at a time, with a line for each that has ended.

    The first that fails ends the others, as Ctrl-C does; what is complete in the cache is kept. Raises DzopError.
    """
    waiting, running = list(choices), dict[tuple[str, str], tuple[subprocess.Popen[bytes], float]]()
    interrupts: list[int] = []  # heeded below, not wherever they come: a run just started would be known to nobody
    before = signal.getsignal(signal.SIGINT)
    if before is signal.default_int_handler:
        signal.signal(signal.SIGINT, lambda number, _: interrupts.append(number))
    try:
        while waiting or running:
            while waiting and len(running) < jobs:
                command = [sys.executable, "-m", "pipeline", *choices[waiting[0]], "runtime.progress=false"]
                started = subprocess.Popen(command, stdout=subprocess.DEVNULL, process_group=0)
                running[waiting.pop(0)] = started, time.perf_counter()
            time.sleep(0.1)
            if interrupts:
                raise KeyboardInterrupt
            for run in [run for run, (process, _) in running.items() if process.poll() is not None]:
                process, start = running.pop(run)
                if process.returncode:
                    killed = f"was killed by signal {-process.returncode}, often for want of memory"
                    why = killed if process.returncode < 0 else "failed, see above"
                    raise DzopError(f"no table: {', '.join(run)}: the run {why}; the same command goes on from here")
                print(f"{', '.join(run)}: {time.perf_counter() - start:.0f} s", file=sys.stderr, flush=True)
    finally:
        for process, _ in running.values():
            process.terminate()
        for process, _ in running.values():
            process.wait()
        signal.signal(signal.SIGINT, before)


def _table(title: str, rows: Mapping[str, RunRecord]) -> str:
    """A row for each system: 95 % intervals over images in brackets, and by how much the first one leads."""
    recalls = [k for k, name in enumerate(RECALLS) if rows[OURS].metrics.get(name) is not None]
    heads = ["features", *TEMPLATES.values(), *(RECALLS[k] for k in recalls), "mean", f"lead of {OURS}"]
    lines = [f"**{title}**", "", f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for name, row in rows.items():
        values = _recalls(row, recalls)
        shown = [_shown(row.metrics.get(column)) for column in TEMPLATES]
        shown += [_bracketed(v, row) for v in (*values.T, values.mean(axis=1))]
        lead = "" if name == OURS else _bracketed((_recalls(rows[OURS], recalls) - values).mean(axis=1), row)
        lines.append(f"| {name} | {' | '.join([*shown, lead])} |")
    return "\n".join(lines)


def _at(field: str, path: Path) -> str:
    """An override that holds whatever signs a path has."""
    escaped = str(path).replace("\\", "\\\\").replace('"', '\\"')
    return f'{field}="{escaped}"'


def _folder(name: str) -> str:
    return name.replace(",", "").replace(" ", "_")


def _recalls(row: RunRecord, which: Sequence[int]) -> np.ndarray:
    return instance_recalls(_scores(row))[:, which]


def _scores(row: RunRecord) -> Scores:
    assert row.scores is not None
    return row.scores


def _bracketed(values: np.ndarray, row: RunRecord) -> str:
    scores = _scores(row)
    found: Interval = mean_interval(values, image_index(scores.scene_id, scores.im_id))
    return f"{found.mean:.3f} [{found.low:.3f}, {found.high:.3f}]"


def _shown(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}" if value < 1 else f"{value:.1f}"


def main() -> None:
    """Parse, run, print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.accuracy", description=__doc__)
    parser.add_argument("--folder", type=Path, default=Path("cache/benchmark"), help="data, cache and results")
    parser.add_argument("--lmo", type=Path, help="folder of LM-O, for the same table on photographs")
    parser.add_argument("--detections", type=Path, help="a detector's json for LM-O, for the table once more")
    parser.add_argument(
        "--jobs", type=_positive, help="runs at a time, which share the cores; one a core where not given"
    )
    parser.add_argument("overrides", nargs="*", help="for all runs alike, such as second_look=none")
    options = parser.parse_intermixed_args()
    folder, lmo, detections = options.folder.resolve(), options.lmo, options.detections
    if detections is not None and lmo is None:
        parser.error("--detections are those of LM-O: they need --lmo")
    if lmo is not None and not lmo.is_dir():
        parser.error(f"--lmo: found no folder {lmo}, needs that of the dataset")
    if detections is not None and not detections.is_file():
        parser.error(f"--detections: found no file {detections}, needs a detector's json")
    try:
        print(benchmark(folder, lmo=lmo, detections=detections, jobs=options.jobs, overrides=options.overrides))
    except DzopError as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit("interrupted: what was complete is kept, and the same command goes on from there")


def _positive(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r}, expected a whole number of at least 1")
    return int(text)


if __name__ == "__main__":
    main()
