"""``dzop reproduce``: the paper's tables and ablations with Stable Diffusion, from nothing to one page."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from pipeline.errors import BadInput, DzopError
from pipeline.fetch import DATASETS
from pipeline.fetch.dataset import DETECTIONS
from pipeline.reproduction import Request, cost_table, list_jobs

HELP = """\
usage: dzop reproduce [datasets=[lmo,ycbv,tless]] [images=N] [plan=true] [NAME=VALUE ...]

Fetch the datasets of the paper and a detector's masks, run its table of methods and its ablations with Stable
Diffusion, and write one page with published and measured results. Run again to resume.

  plan=true          print jobs, images through the backbone, bytes and GPU hours; download and compute nothing
  datasets=[lmo]     some of lmo, ycbv, tless; the ablations belong to lmo
  images=20          at most so many images of each dataset, evenly spaced
  method=dzop_paper  the method in the paper's place
  baselines=[zs6d]   further methods on the same masks (zs6d needs 8 MB of cache per image)
  data=data          folder of the datasets; what is there is not fetched
  detections=detections/cnos-fastsam.json   a detector's file, in each dataset's folder
  out=results/reproduction
Everything else goes to every job: weights.stable_diffusion=FOLDER, extract.dtype=float16, runtime=ray, ...
"""


def reproduce_command(arguments: Sequence[str]) -> None:
    """Plan, or fetch, run and report. Raises BadInput for options, and DzopError that names the jobs that failed."""
    if {"-h", "--help"} & set(arguments):
        print(HELP, end="")
        return
    request, plan = _parse(arguments)
    jobs = list_jobs(request)
    print(cost_table(jobs, request), flush=True)
    if plan:
        return
    for dataset in request.datasets:
        for fetch in _fetches(request, dataset):
            if _run(fetch):
                raise DzopError(f"{shlex.join(('dzop', *fetch))}: failed, see above; run again to resume")
    failed = [job for job in jobs if _run(job.arguments, title=job.title)]
    if _run(("step=report", f"out={request.out}")):
        raise DzopError("step=report: failed, see above")
    if failed:
        names = "; ".join(job.title for job in failed)
        raise DzopError(f"{len(failed)} of {len(jobs)} jobs failed: {names}; run again to resume")


def _fetches(request: Request, dataset: str) -> list[tuple[str, ...]]:
    """What has to be fetched first: nothing, or the dataset with its masks."""
    root = request.root(dataset)
    if root.is_dir() and (root / request.detections).is_file():
        return []
    if request.detections != DETECTIONS:
        where = root / request.detections
        raise BadInput(where, found="no such file", needed="a detector's file, or detections= left out: it is fetched")
    return [("fetch", dataset, "--masks", "--to", request.data)]


def _run(arguments: Sequence[str], *, title: str = "") -> int:
    """Run one command in a process of its own; its exit status."""
    print(f"\n== {title or arguments[0]}\ndzop {shlex.join(arguments)}", flush=True)
    return subprocess.run([sys.executable, "-m", "pipeline", *arguments], check=False).returncode


# --- options ----------------------------------------------------------------------------------------------------------


def _parse(arguments: Sequence[str]) -> tuple[Request, bool]:
    """The request, and whether only to plan. Raises BadInput."""
    values: dict[str, Any] = {}
    overrides: list[str] = []
    plan = False
    readers: dict[str, Callable[[str, str], Any]] = {"datasets": _names, "baselines": _names, "images": _count}
    own = {field.name for field in fields(Request)} - {"overrides"}
    for argument in arguments:
        name, separator, value = argument.partition("=")
        if not separator or not name or name.startswith("-"):
            raise BadInput("dzop reproduce", found=argument, needed="NAME=VALUE; dzop reproduce --help lists the names")
        if name == "plan":
            plan = _flag(name, value)
        elif name in own:
            values[name] = readers.get(name, _text)(name, value)
        else:
            overrides.append(argument)
    return Request(**values, overrides=tuple(overrides)), plan


def _names(name: str, value: str) -> tuple[str, ...]:
    names = tuple(part for part in re.split(r"[,\s]+", value.strip("[]() ")) if part)
    known = sorted(DATASETS) if name == "datasets" else None
    if (name == "datasets" and not names) or (known is not None and not set(names) <= set(known)):
        raise BadInput(name, found=value, needed=f"some of {', '.join(known or ())}, such as [lmo]")
    return tuple(dict.fromkeys(names))


def _count(name: str, value: str) -> int:
    if not value.isdigit() or int(value) < 1:
        raise BadInput(name, found=value, needed="a number of images, at least 1")
    return int(value)


def _flag(name: str, value: str) -> bool:
    if value.lower() not in ("true", "false"):
        raise BadInput(name, found=value, needed="true or false")
    return value.lower() == "true"


def _text(name: str, value: str) -> str:
    if not value.strip():
        raise BadInput(name, found="nothing", needed="a value")
    return str(Path(value).expanduser()) if name in ("data", "out") else value
