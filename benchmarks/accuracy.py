"""Accuracy of the embedded model compared with baseline features, as tables in Markdown.

The procedural test objects use a seed that was not used for training or for choosing options. With --lmo, the same
table is made on photographs. Runs are cached; run the same command again to resume an interrupted benchmark.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from joblib import cpu_count

from benchmarks.run_pool import run_all
from pipeline.errors import DzopError
from pipeline.metrics.bootstrap import image_index, mean_interval
from pipeline.metrics.recall import instance_recalls
from pipeline.report.run_records import RunRecord, read_run_records
from pipeline.spec import digest

TEST_SEED = 9041  # of synthetic.demo; training and validation objects come from other generators and seeds
DEMO = ("dataset=demo", f"dataset.seed={TEST_SEED}", "dataset.objects=20", "dataset.images=40", "dataset.per_image=5")
OURS = "embedded"
# in the order in which they are run: systems that share features are next to each other
SYSTEMS = {
    OURS: ("extract=embedded",),
    "embedded, pure": ("extract=embedded", "extract.weights=pure"),
    "random weights": ("extract=random_sd", "extract.noise=none"),
    "pixels": ("extract=pixels",),
    "HOG": ("extract=hog",),
    "embedded, no gradient histograms": ("extract=embedded", "fuse=learned", "fuse.layers=[2,5,8,11]"),
}
TEMPLATE_COLUMNS = {
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
    """Run every system on every data set; returns the tables in Markdown.

    ``jobs``: runs at a time, which share the CPU cores; None: one per core. ``overrides``: for ``python -m pipeline``,
    applied to all runs. Raises DzopError if a run failed.
    """
    datasets = _dataset_overrides(folder, lmo, detections)
    results = folder / "results" / digest(list(overrides))[:8] if overrides else folder / "results"
    cores = cpu_count()
    jobs = min(jobs or cores, len(datasets) * len(SYSTEMS))
    shared = [*QUIET, f"threads={max(1, cores // jobs)}", path_override("store.root", folder / "cache")]
    outs = {(title, name): results / folder_name(title) / folder_name(name) for title in datasets for name in SYSTEMS}
    overrides_of = {
        (title, name): [
            "method=dzop_x",
            *SYSTEMS[name],
            *shared,
            *datasets[title],
            *overrides,
            path_override("out", out),
        ]
        for (title, name), out in outs.items()
    }
    run_all(overrides_of, jobs=jobs)
    newest = {run: max(read_run_records(out), key=lambda record: record.at) for run, out in outs.items()}
    return "\n\n".join(_table(title, {name: newest[title, name] for name in SYSTEMS}) for title in datasets)


def _dataset_overrides(folder: Path, lmo: Path | None, detections: Path | None) -> dict[str, tuple[str, ...]]:
    """Title of a table -> overrides that choose its data."""
    chosen: dict[str, tuple[str, ...]] = {
        "objects of the test seed": (*DEMO, path_override("dataset.root", folder / "data"))
    }
    if lmo is not None:
        masks = ("dataset=lmo", path_override("dataset.root", lmo), "evaluate.vsd=false")
        chosen["LM-O, visible masks"] = masks
        if detections is not None:
            chosen["LM-O, detections"] = (*masks, "detect=json", path_override("detect.path", detections))
    return chosen


def _table(title: str, records: Mapping[str, RunRecord]) -> str:
    """One line per system, with 95 % intervals over images in brackets and the paired lead of the first system."""
    recalls = [k for k, name in enumerate(RECALLS) if records[OURS].metrics.get(name) is not None]
    heads = ["features", *TEMPLATE_COLUMNS.values(), *(RECALLS[k] for k in recalls), "mean", f"lead of {OURS}"]
    lines = [f"**{title}**", "", f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    ours = read_recalls(records[OURS], recalls)
    for name, record in records.items():
        values = read_recalls(record, recalls)
        cells = [_number_text(record.metrics.get(column)) for column in TEMPLATE_COLUMNS]
        cells += [interval_text(column, record) for column in (*values.T, values.mean(axis=1))]
        cells.append("" if name == OURS else interval_text((ours - values).mean(axis=1), record))
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def path_override(field: str, path: Path) -> str:
    """An override whose value is a path with any characters."""
    escaped = str(path).replace("\\", "\\\\").replace('"', '\\"')
    return f'{field}="{escaped}"'


def folder_name(title: str) -> str:
    """A title as the name of a folder."""
    return title.replace(",", "").replace(" ", "_")


def read_recalls(record: RunRecord, which: Sequence[int]) -> np.ndarray:
    """Recalls of each instance, (instances, metrics)."""
    return instance_recalls(record.require_scores())[:, which]


def interval_text(values: np.ndarray, record: RunRecord) -> str:
    """Mean of the instances' values and its 95 % interval over images."""
    scores = record.require_scores()
    interval = mean_interval(values, image_index(scores.scene_id, scores.im_id))
    return f"{interval.mean:.3f} [{interval.low:.3f}, {interval.high:.3f}]"


def _number_text(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}" if value < 1 else f"{value:.1f}"


def main() -> None:
    """Parse the options, run the benchmark, print the tables."""
    parser = _parser()
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
        sys.exit("interrupted. Completed entries are cached; run the same command again to resume")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.accuracy", description=__doc__)
    add, default = parser.add_argument, "(default: %(default)s)"
    add("--folder", type=Path, default=Path("cache/benchmark"), help=f"for data, cache and results {default}")
    add("--lmo", type=Path, help="folder of LM-O, to make the table on photographs too")
    add("--detections", type=Path, help="detections for LM-O (json), for a table with them")
    add("--jobs", type=_positive, help="runs at a time, which share the CPU cores (default: one per core)")
    add("overrides", nargs="*", help="overrides for all runs, such as second_look=none")
    return parser


def _positive(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r}, expected a whole number of at least 1")
    return int(text)


if __name__ == "__main__":
    main()
