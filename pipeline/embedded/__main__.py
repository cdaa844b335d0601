"""``python -m pipeline.embedded``: the embedded model, from nothing to weights, as far as the time allows."""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import torch
from joblib import Parallel, delayed

from pipeline.embedded.export import export
from pipeline.embedded.training import Autoencoder, Denoiser, Descriptors, Place, Plan, train
from pipeline.embedded.views import make_shard

WEIGHTS = Path(__file__).parent / "weights"


def main() -> None:
    """Parse, then train the stages in turn."""
    parser = argparse.ArgumentParser(prog="python -m pipeline.embedded", description=__doc__)
    parser.add_argument("--folder", type=Path, default=Path("cache/embedded"), help="shards, checkpoints, loss curves")
    parser.add_argument("--minutes", type=_above_zero, default=120.0, help="stop after so long; the next call goes on")
    parser.add_argument("--scale", type=_above_zero, default=1.0, help="of the number of steps")
    parser.add_argument(
        "--batch", type=_above_zero, default=1.0, help="of the size of batches: less on a slower machine"
    )
    devices = ("cpu", "cuda") if torch.cuda.is_available() else ("cpu",)
    parser.add_argument("--device", choices=devices, default=devices[-1], help="cuda where there is one")
    parser.add_argument("--workers", type=_count, default=0, help="processes that draw batches; 0 = this one alone")
    parser.add_argument("--threads", type=_count, default=0, help="0 = all cores")
    run(parser.parse_args())


def run(options: argparse.Namespace) -> None:
    """Shards first as far as the first steps need them, then each stage; weights are replaced once all have ended."""
    if options.threads:
        torch.set_num_threads(options.threads)
    until, place, plan = time.time() + 60 * options.minutes, Place(options.folder), _sized(Plan(), options.batch)
    _make_shards(place.folder / "shards", plan.shards if options.workers else 8, options.workers)
    for kind, steps in ((Autoencoder, plan.autoencoder), (Denoiser, plan.denoiser), (Descriptors, plan.descriptors)):
        stage = kind(plan, place, round(steps * options.scale), options.device)
        if not train(stage, place, until=until, workers=options.workers):
            print(f"{kind.name}: time is up; the next call goes on from here, {WEIGHTS} stays as it is")
            return
        print(f"{kind.name}: done", flush=True)
    print(f"{export(place, WEIGHTS) / 1e6:.1f} MB of weights in {WEIGHTS}")


def _make_shards(folder: Path, count: int, workers: int) -> None:
    """The first shards, or with workers all of them before any is read."""
    Parallel(n_jobs=max(workers, 1))(delayed(make_shard)(folder, index) for index in range(count))


def _above_zero(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < 1e6:
        raise argparse.ArgumentTypeError(f"found {text}, needs a number above 0")
    return value


def _count(text: str) -> int:
    if not text.isdecimal() or int(text) > 1024:
        raise argparse.ArgumentTypeError(f"found {text}, needs a whole number from 0 to 1024")
    return int(text)


def _sized(plan: Plan, batch: float) -> Plan:
    pictures, objects = max(round(batch * plan.pictures), 1), max(round(batch * plan.objects), 1)
    return replace(plan, pictures=pictures, objects=objects)


if __name__ == "__main__":
    main()
