"""``python -m benchmarks``: figures as JSON, and a table of targets with pass or what is missing."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path

import cv2
import torch
from threadpoolctl import threadpool_limits

from benchmarks.extraction import extraction, extraction_sd
from benchmarks.jobs import memory, onboarding, warm
from benchmarks.measure import Figure, machine, table
from benchmarks.online import online
from benchmarks.rendering import rendering
from benchmarks.storing import storing
from pipeline.io.files import write_json

PARTS: dict[str, Callable[..., list[Figure]]] = {
    "online": online,
    "store": storing,
    "render": rendering,
    "extract": extraction,
    "jobs": warm,
    "onboard": onboarding,
    "memory": memory,
    "extract-sd": extraction_sd,
}
ASKED = ("extract-sd",)  # for by name alone


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("parts", nargs="*", help=f"of {', '.join(PARTS)}; all but {ASKED[0]} where none is named")
    parser.add_argument("--json", type=Path, default=Path("results/bench.json"), help="where the figures go")
    parser.add_argument("--device", default="cpu", help="cpu, cuda, cuda:N")
    parser.add_argument("--repeats", type=int, default=7, help="turns of which medians are taken")
    parser.add_argument("--threads", type=int, default=1, help="of torch and OpenCV; 1 on a machine that others use")
    args = parser.parse_args()
    if unknown := sorted(set(args.parts) - set(PARTS)):
        parser.error(f"no part {', '.join(unknown)}; there are {', '.join(PARTS)}")
    threadpool_limits(args.threads)  # BLAS beneath numpy, SciPy and scikit-learn
    torch.set_num_threads(args.threads)
    cv2.setNumThreads(args.threads)
    facts = machine(args.device)
    print(json.dumps(facts), flush=True)
    figures: list[Figure] = []
    for name in args.parts or [part for part in PARTS if part not in ASKED]:
        found = PARTS[name](device=args.device, repeats=args.repeats)
        print(f"\n{name}\n{table(found)}", flush=True)
        figures += found
    aimed = [figure for figure in figures if figure.target is not None]
    print(f"\ntargets: {sum(f.verdict == 'pass' for f in aimed)} of {len(aimed)} met\n{table(aimed)}")
    write_json(args.json, {"machine": facts, "figures": [figure.record() for figure in figures]})
    print(f"written   {args.json}")


if __name__ == "__main__":
    main()
