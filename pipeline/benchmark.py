"""One table: the embedded model beside its controls, on objects of a seed that nothing was trained or chosen on."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from pathlib import Path

import numpy as np

from pipeline.items.scores import Scores
from pipeline.metrics.bootstrap import Interval, image_index, mean_interval
from pipeline.metrics.recall import instance_recalls
from pipeline.report.rows import Row, read_rows
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
    for every row alike. Raises CalledProcessError for a run that failed; those under way end first.
    """
    parts: dict[str, tuple[str, ...]] = {"objects of the test seed": (*DEMO, _at("dataset.root", folder / "data"))}
    if lmo is not None:
        parts["LM-O, visible masks"] = ("dataset=lmo", _at("dataset.root", lmo), "evaluate.vsd=false")
        if detections is not None:
            found = ("detect=json", _at("detect.path", detections))
            parts["LM-O, detections"] = (*parts["LM-O, visible masks"], *found)
    results = folder / "results" / digest(list(overrides))[:8] if overrides else folder / "results"
    wanted = [(title, name) for title in parts for name in SYSTEMS]
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    jobs = min(jobs or cores, len(wanted))
    threads = f"threads={max(1, cores // jobs)}"
    with ThreadPoolExecutor(jobs) as pool:
        runs: dict[Future[Row], tuple[str, str]] = {}
        for title, name in wanted:
            choices = ["method=dzop_x", *SYSTEMS[name], *QUIET, threads, *parts[title], *overrides]
            out = results / _folder(title) / _folder(name)
            runs[pool.submit(_run, choices, out, folder / "cache")] = title, name
        try:
            rows = {runs[run]: run.result() for run in as_completed(runs)}
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return "\n\n".join(_table(title, {name: rows[title, name] for name in SYSTEMS}) for title in parts)


def _table(title: str, rows: Mapping[str, Row]) -> str:
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


def _run(choices: Sequence[str], out: Path, cache: Path) -> Row:
    """The row of a run of the pipeline; a line of progress when it has ended."""
    start = time.perf_counter()
    where = [_at("out", out), _at("store.root", cache), "runtime.progress=false"]
    subprocess.run([sys.executable, "-m", "pipeline", *choices, *where], check=True, stdout=subprocess.DEVNULL)
    print(f"{out.parent.name}/{out.name}: {time.perf_counter() - start:.0f} s", file=sys.stderr, flush=True)
    return max(read_rows(out), key=lambda row: row.at)


def _recalls(row: Row, which: Sequence[int]) -> np.ndarray:
    return instance_recalls(_scores(row))[:, which]


def _scores(row: Row) -> Scores:
    assert row.scores is not None
    return row.scores


def _bracketed(values: np.ndarray, row: Row) -> str:
    scores = _scores(row)
    found: Interval = mean_interval(values, image_index(scores.scene_id, scores.im_id))
    return f"{found.mean:.3f} [{found.low:.3f}, {found.high:.3f}]"


def _shown(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}" if value < 1 else f"{value:.1f}"


def main() -> None:
    """Parse, run, print."""
    parser = argparse.ArgumentParser(prog="python -m pipeline.benchmark", description=__doc__)
    parser.add_argument("--folder", type=Path, default=Path("cache/benchmark"), help="data, cache and results")
    parser.add_argument("--lmo", type=Path, help="folder of LM-O, for the same table on photographs")
    parser.add_argument("--detections", type=Path, help="a detector's json for LM-O, for the table once more")
    parser.add_argument(
        "--jobs", type=_positive, help="runs at a time, which share the cores; one a core where not given"
    )
    parser.add_argument("overrides", nargs="*", help="for all runs alike, such as second_look=none")
    options = parser.parse_intermixed_args()
    folder, overrides = options.folder.resolve(), options.overrides
    try:
        text = benchmark(folder, lmo=options.lmo, detections=options.detections, jobs=options.jobs, overrides=overrides)
    except subprocess.CalledProcessError as error:  # which has said on stderr what was wrong
        sys.exit(f"benchmark: no table, a run failed: {' '.join(error.cmd[1:])}")
    print(text)


def _positive(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r}, expected a whole number of at least 1")
    return int(text)


if __name__ == "__main__":
    main()
