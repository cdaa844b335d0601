"""What is run to reproduce the paper: one command line for each of its tables' rows and for each of its ablations."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pipeline.fetch.dataset import DETECTIONS

METHOD = "dzop_paper"
EXTRACT = "stable_diffusion"
VARIED, VARIED_METHOD = "correspondence", "dzop"
"""The sweep that replaces stages whose fields dzop_paper sets, and the method with the same stages that it takes."""
ABLATED = "lmo"  # the dataset of the paper's ablations
BOXES = ("detect=gt_bbox", "segment=none")  # what they are made on
TIMESTEPS = 10  # of the sweep of that name; 50, one of them, is the default
# sweep -> (jobs, of which extract features of their own)
SWEEPS = {
    "correspondence": (4, 0),
    "clusters": (14, 0),
    "pca_dim": (8, 0),
    "per_cluster": (12, 0),
    "timesteps": (TIMESTEPS, TIMESTEPS - 1),
}


@dataclass(frozen=True)
class Request:
    """What to reproduce. ``images``: at most so many of each dataset; ``overrides``: further options of every job.

    ``data``: folder of the datasets; ``detections``: a detector's file in a dataset's folder.
    """

    datasets: tuple[str, ...] = ("lmo", "ycbv", "tless")
    images: int | None = None
    method: str = METHOD
    baselines: tuple[str, ...] = ()
    data: str = "data"
    detections: str = DETECTIONS
    out: str = "results/reproduction"
    overrides: tuple[str, ...] = ()

    def root(self, dataset: str) -> Path:
        """The dataset's folder."""
        return Path(self.data).expanduser() / dataset


@dataclass(frozen=True)
class Job:
    """One command, and what it computes that no earlier one has.

    ``configurations``: how often it estimates all targets; ``template_extractions`` and ``query_extractions``: how
    often all templates, and all query crops, pass the backbone.
    """

    title: str
    dataset: str
    method: str
    arguments: tuple[str, ...]
    configurations: int = 1
    template_extractions: int = 1
    query_extractions: int = 1


def list_jobs(request: Request) -> list[Job]:
    """The jobs in the order in which they run: the table of methods, then the ablations."""
    jobs = []
    for dataset in request.datasets:
        for method in (request.method, *request.baselines):
            jobs.append(_comparison(request, dataset, method))
    if ABLATED in request.datasets:
        jobs += _ablations(request)
    return jobs


def _comparison(request: Request, dataset: str, method: str) -> Job:
    """A row of the table of methods: a detector's masks. Its scores hold all thresholds of the paper's figure."""
    path = request.root(dataset) / request.detections
    arguments = (*_common(request, dataset, method), "detect=json", f"detect.path={path}")
    title = f"{dataset}: {method} on a detector's masks"
    return Job(title, dataset, method, arguments)


def _ablations(request: Request) -> list[Job]:
    """The table of correspondence estimation and the curves, on ground-truth boxes as in the paper."""
    arguments = (*_common(request, ABLATED, request.method), *BOXES)
    jobs = [Job(f"{ABLATED}: {request.method} on ground-truth boxes", ABLATED, request.method, arguments, 1, 0, 1)]
    for name, (count, extractions) in SWEEPS.items():
        title, costs = f"{ABLATED}: ablation {name}", (count - 1, extractions, extractions)  # one is the base run
        words = arguments
        if name == VARIED and request.method == METHOD:
            words = (*_common(request, ABLATED, VARIED_METHOD, extract=EXTRACT), *BOXES)
            title, costs = f"{title}, of {VARIED_METHOD}", (count, 1, 1)  # its crops are others
        jobs.append(Job(title, ABLATED, request.method, (f"sweep={name}", *words), *costs))
    return jobs


def _common(request: Request, dataset: str, method: str, extract: str = "") -> tuple[str, ...]:
    """Options of every job of a dataset and a method."""
    arguments = [f"method={method}", f"dataset={dataset}", f"dataset.root={request.root(dataset)}"]
    if extract or method == request.method:
        arguments.append(f"extract={extract or EXTRACT}")
    if request.images is not None:
        arguments.append(f"select.sample={request.images}")
    return (*arguments, f"out={request.out}", *request.overrides)
