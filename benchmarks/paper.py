"""What each reading of the paper changes: method=dzop, its switches one at a time, and method=dzop_paper.

A line per system: the mean of AR_MSSD and AR_MSPD with its 95 % interval over images, and its paired difference to
method=dzop on the same targets. The figures are measurements for docs/paper.md, not a choice between readings.
Finished runs are kept; run the same command again to resume.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from benchmarks.accuracy import folder_name, interval_text, path_override, read_recalls
from benchmarks.run_pool import run_all
from pipeline.errors import DzopError
from pipeline.report.run_records import FOLDER, RunRecord, read_run_records
from pipeline.spec import digest

OURS, PAPER = "method=dzop", "method=dzop_paper"
SWITCHES = (
    "segment=none",
    "crop.padding_ratio=1.0",
    "fuse.normalise=false",
    "fuse.cells=all",
    "cluster.planar=fundamental",
    "cluster.planar=homography",
    "correspond.mutual=false",
    "correspond.subtract_own_shift=false",
    "solve.iterations=100 solve.confidence=0.99",
    "solve.refine=false",
)
"""Each switch of conf/method/dzop_paper.yaml alone, in all columns."""
READINGS = (
    "correspond.kernel=1",
    "fuse.dim_mode=per_layer",
    "render.viewpoints=icosphere",
    *(f"correspond.per_cluster={k}" for k in (1, 5, 30)),
    *(f"{PAPER} correspond.per_cluster={k}" for k in (1, 5, 30)),
)
"""Readings that both methods share, and whether "top 10" matters; first column only."""
DIFFUSION = (
    "extract.noise=shared",
    "extract.noise=independent",
    "extract.hook=post",
    "extract.hook=resnet",
    "extract.input_size=64",
)
"""Readings of a diffusion backbone, where the features are of one; first column only."""
FEATURES = {
    "HOG": ("extract=hog",),
    "embedded, pure": ("extract=embedded", "extract.weights=pure"),
}
QUIET = ("gallery=0", "overlays=false", "threads=1")
RECALLS = (1, 2)  # AR_MSSD and AR_MSPD, in the order of metrics.recall.instance_recalls

Run = tuple[str, str]
"""Title of a column, name of a line."""


def benchmark(
    folder: Path,
    *,
    lmo: Path,
    found: Path | None = None,
    features: Iterable[str] = FEATURES,
    overrides: Sequence[str] = (),
) -> str:
    """Run all systems one after the other; returns a table in Markdown per kind of features.

    ``found``: a detector's results for LM-O, for a second column. ``overrides``: for all runs; their results get a
    folder of their own. Raises DzopError if a run failed.
    """
    tables = []
    results = folder / "results" / digest(list(overrides))[:8]
    for kind in features:
        shared = (*FEATURES[kind], *QUIET, path_override("store.root", folder / "cache"), *overrides)
        overrides_of = _overrides(kind, _columns(lmo, found), shared)
        outs = {run: results.joinpath(*(folder_name(name) for name in (kind, *run))) for run in overrides_of}
        missing = [run for run in overrides_of if not _newest(outs[run])]
        run_all({run: (*overrides_of[run], path_override("out", outs[run])) for run in missing}, jobs=1)
        tables.append(_table(kind, {run: _newest(out) for run, out in outs.items()}))
    return "\n\n".join(tables)


def _columns(lmo: Path, found: Path | None) -> dict[str, tuple[str, ...]]:
    """Title of a column -> the overrides that choose where the objects are."""
    data = ("dataset=lmo", path_override("dataset.root", lmo), "evaluate.vsd=false")
    columns: dict[str, tuple[str, ...]] = {"ground-truth boxes (oracle)": (*data, "detect=gt_bbox")}
    if found is not None:
        columns["a detector's masks"] = (*data, "detect=json", path_override("detect.path", found))
    return columns


def _overrides(
    kind: str, columns: Mapping[str, tuple[str, ...]], shared: tuple[str, ...]
) -> dict[Run, tuple[str, ...]]:
    """The overrides of every run, line by line."""
    first = list(columns)[:1]
    lines = {name: list(columns) for name in (OURS, PAPER, *SWITCHES)} | dict.fromkeys(READINGS, first)
    lines |= {} if kind == "HOG" else dict.fromkeys(DIFFUSION, first)
    return {
        (title, name): (*([] if name.startswith("method=") else [OURS]), *name.split(), *shared, *columns[title])
        for name, titles in lines.items()
        for title in titles
    }


def _newest(out: Path) -> RunRecord | None:
    """The record of the last run that finished, None without one."""
    records = read_run_records(out) if (out / FOLDER).is_dir() else []  # not where a run was interrupted
    done = [record for record in records if record.status == "done"]
    return max(done, key=lambda record: record.at, default=None)


def _table(kind: str, records: Mapping[Run, RunRecord | None]) -> str:
    """A line per system; two cells for each column: the mean recall, and its difference to method=dzop."""
    columns = list(dict.fromkeys(title for title, _ in records))
    heads = [kind, *(head for title in columns for head in (title, "paired difference"))]
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for name in dict.fromkeys(name for _, name in records):
        cells = [cell for title in columns for cell in _cells(records.get((title, name)), records[title, OURS])]
        lines.append(f"| `{name}` | {' | '.join(cells)} |")
    return "\n".join(lines)


def _cells(record: RunRecord | None, ours: RunRecord | None) -> tuple[str, str]:
    if record is None or ours is None:
        return "", ""
    recall, baseline = (read_recalls(r, RECALLS).mean(axis=1) for r in (record, ours))
    difference = "" if record is ours else interval_text(recall - baseline, record)
    return interval_text(recall, record), difference


def main() -> None:
    """Parse the options, run the benchmark, print the tables."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.paper", description=__doc__)
    add, default = parser.add_argument, "(default: %(default)s)"
    add("--lmo", type=Path, required=True, help="folder of LM-O")
    add("--detections", type=Path, help="a detector's results for LM-O (json), for a column with its masks")
    add("--folder", type=Path, default=Path("cache/paper"), help=f"for cache and results {default}")
    add("overrides", nargs="*", help="overrides for all runs, such as select.images=[3,38]")
    add("--features", choices=list(FEATURES), action="append", help="only these (default: all); may be repeated")
    options = parser.parse_intermixed_args()
    try:
        folder, features = options.folder.resolve(), options.features or list(FEATURES)
        chosen = {"features": features, "overrides": options.overrides}
        print(benchmark(folder, lmo=options.lmo, found=options.detections, **chosen))
    except DzopError as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit("interrupted. Finished runs are kept; run the same command again to resume")


if __name__ == "__main__":
    main()
