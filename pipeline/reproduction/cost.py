"""Jobs -> images through the backbone, bytes of features and GPU time, before anything is downloaded or computed.

Counts are those of the BOP test sets. Rates are those of one H200 (docs/results_gpu.md): a card of a third of its
speed takes three times as long. What a run needs on this machine, ``plan=true`` of its own command says.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from pipeline.fetch.catalog import DATASETS
from pipeline.progress import format_bytes
from pipeline.reproduction.jobs import Job, Request

VIEWS = {"lmo": 301, "ycbv": 301, "tless": 300}  # templates of an object
SD_IMAGES_PER_S = {"float32": 300 / 20.4, "float16": 300 / 6.8, "bfloat16": 300 / 6.7}
VIEWS_PER_S = 300 / 8.2  # rendered and cropped
S_PER_POSE = 0.077
# bytes of an image's features in float16 at the methods' default layers and input sizes
FEATURE_BYTES = {"stable_diffusion": 4_751_360, "zs6d": 43_358_336}


@dataclass(frozen=True)
class Cost:
    """``passes``: images through the backbone; ``seconds``: None if its rate was not measured."""

    poses: int
    passes: int
    feature_bytes: int
    seconds: float | None


def job_cost(job: Job, request: Request, *, first_views: bool) -> Cost:
    """What a job adds. ``first_views``: whether it renders the templates, which all later jobs of the dataset share."""
    dataset = DATASETS[job.dataset]
    share = 1.0 if request.images is None else min(request.images / dataset.images, 1.0)
    instances, views = round(dataset.instances * share), dataset.objects * VIEWS[job.dataset]
    passes = job.template_extractions * views + job.query_extractions * instances
    poses = job.configurations * instances
    ours = job.method == request.method
    if not ours and job.method not in FEATURE_BYTES:
        return Cost(poses, passes, 0, None)
    feature_bytes = passes * FEATURE_BYTES["stable_diffusion" if ours else job.method]
    if not ours:
        return Cost(poses, passes, feature_bytes, None)
    seconds = passes / SD_IMAGES_PER_S[_dtype(request)] + poses * S_PER_POSE
    return Cost(poses, passes, feature_bytes, seconds + (views / VIEWS_PER_S if first_views else 0.0))


def cost_table(jobs: Sequence[Job], request: Request) -> str:
    """A line per job and the sums, as text."""
    lines = [f"{'poses':>8}{'passes':>9}{'features':>11}{'GPU time':>13}  job"]
    costs, seen = [], set[str]()
    for job in jobs:
        cost = job_cost(job, request, first_views=job.dataset not in seen)
        seen.add(job.dataset)
        costs.append(cost)
        lines.append(_line(cost, job.title))
    known = [cost.seconds for cost in costs if cost.seconds is not None]
    total = Cost(
        sum(cost.poses for cost in costs),
        sum(cost.passes for cost in costs),
        sum(cost.feature_bytes for cost in costs),
        sum(known),
    )
    unknown = len(costs) - len(known)
    lines.append(_line(total, "in all" + (f", without the time of {unknown} jobs" if unknown else "")))
    lines.append(
        f"GPU hours: {sum(known) / 3600:.1f} on one H200 at extract.dtype={_dtype(request)}; see docs/results_gpu.md"
    )
    lines.append("without downloads, scoring (VSD runs on the processor), pictures and the page")
    lines.append(_download_text(request))
    return "\n".join(lines)


def _line(cost: Cost, title: str) -> str:
    time = "not measured" if cost.seconds is None else f"{cost.seconds / 60:.1f} min"
    return f"{cost.poses:>8}{cost.passes:>9}{format_bytes(cost.feature_bytes):>11}{time:>13}  {title}"


def _download_text(request: Request) -> str:
    """What has to be downloaded first, besides the weights."""
    missing = [DATASETS[name] for name in request.datasets if not request.root(name).is_dir()]
    nbytes = sum(file.nbytes or 0 for dataset in missing for file in dataset.archives)
    names = ", ".join(dataset.title for dataset in missing)
    return f"download: {format_bytes(nbytes)} ({names}), detections and weights" if missing else "download: weights"


def _dtype(request: Request) -> str:
    """The precision that the overrides choose."""
    chosen = [text.partition("=")[2] for text in request.overrides if text.startswith("extract.dtype=")]
    return chosen[-1] if chosen and chosen[-1] in SD_IMAGES_PER_S else "float32"
