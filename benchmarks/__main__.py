"""Measure the speed and memory of the pipeline's parts, compared with references and with targets.

Prints a table per part, then all targets with pass or the factor that is missing; writes all measurements as JSON.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import torch
from threadpoolctl import threadpool_limits

from benchmarks.before import compare_with_before
from benchmarks.default_pose import default_pose
from benchmarks.extraction import extraction, extraction_sd
from benchmarks.growth import growth
from benchmarks.imports import imports
from benchmarks.jobs import memory, onboarding, warm
from benchmarks.measure import Measurement, describe_machine, table
from benchmarks.meshes import meshes
from benchmarks.online import online
from benchmarks.rendering import rendering
from benchmarks.startup import startup
from benchmarks.storing import storing
from benchmarks.video import video
from benchmarks.workers import two_workers
from pipeline.errors import DzopError
from pipeline.io.files import write_json
from pipeline.parallel import use_threads

PARTS: dict[str, Callable[..., list[Measurement]]] = {
    "online": online,
    "pose": default_pose,
    "store": storing,
    "render": rendering,
    "extract": extraction,
    "jobs": warm,
    "startup": startup,
    "video": video,
    "onboard": onboarding,
    "memory": memory,
    "imports": imports,
    "before": compare_with_before,
    "workers": two_workers,
    "growth": growth,
    "extract-sd": extraction_sd,
    "meshes": meshes,
}
ON_REQUEST = ("extract-sd", "meshes")  # measured only if named


def main() -> None:
    """Parse the options, measure, print and write the results."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    add, default = parser.add_argument, "(default: %(default)s)"
    others = ", ".join(ON_REQUEST)
    add("parts", nargs="*", help=f"parts to measure: {', '.join(PARTS)} (default: all except {others})")
    add("--json", type=Path, default=Path("results/bench.json"), help=f"file for the measurements {default}")
    add("--device", default="cpu", help=f"cpu, cuda or cuda:N {default}")
    add("--repeats", type=int, default=7, help=f"repetitions; medians are reported {default}")
    add("--before", default="HEAD~1", help=f"commit that the part before compares this checkout with {default}")
    add("--lmo", type=Path, help="folder of LM-O, whose poses before and pose measure (default: the demo's)")
    add("--threads", type=int, default=1, help=f"CPU threads; use 1 on a shared machine {default}")
    args = parser.parse_args()
    if unknown := sorted(set(args.parts) - set(PARTS)):
        parser.error(f"parts: found {', '.join(unknown)}, needs some of {', '.join(PARTS)}")
    lmo = args.lmo and args.lmo.resolve()
    options = {"before": {"revision": args.before, "lmo": lmo}, "pose": {"lmo": lmo}}
    use_threads(args.threads)
    threadpool_limits(args.threads)  # of BLAS in what is measured besides: numpy, SciPy and scikit-learn
    torch.set_num_threads(args.threads)
    cv2.setNumThreads(args.threads)
    description = describe_machine(args.device)
    print(json.dumps(description), flush=True)
    measurements, failed = list[Measurement](), list[str]()
    for name in args.parts or [part for part in PARTS if part not in ON_REQUEST]:
        try:
            found = PARTS[name](device=args.device, repeats=args.repeats, **options.get(name, {}))
        except DzopError as error:
            failed.append(f"{name}: {error}")
            continue
        print(f"\n{name}\n{table(found)}", flush=True)
        measurements += found
    with_target = [m for m in measurements if m.target is not None]
    print(f"\ntargets: {sum(m.verdict == 'pass' for m in with_target)} of {len(with_target)} met\n{table(with_target)}")
    write_json(args.json, {"machine": description, "figures": [m.to_record() for m in measurements]})
    print(f"written   {args.json}")
    if failed:
        sys.exit("\n".join(f"error: not measured: {reason}" for reason in failed))


if __name__ == "__main__":
    main()
