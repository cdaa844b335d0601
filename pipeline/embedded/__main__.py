"""``python -m pipeline.embedded``: the embedded model, from nothing to weights, as far as the time allows."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import torch

from pipeline.embedded.export import export
from pipeline.embedded.training import Autoencoder, Denoiser, Descriptors, Place, Plan, train
from pipeline.embedded.views import make_shard

WEIGHTS = Path(__file__).parent / "weights"


def main() -> None:
    """Parse, then train the stages in turn."""
    parser = argparse.ArgumentParser(prog="python -m pipeline.embedded", description=__doc__)
    parser.add_argument("--folder", type=Path, default=Path("cache/embedded"), help="shards, checkpoints, loss curves")
    parser.add_argument("--minutes", type=float, default=120.0, help="stop after so long; the next call goes on")
    parser.add_argument("--scale", type=float, default=1.0, help="of the number of steps: more on a faster machine")
    parser.add_argument("--threads", type=int, default=0, help="0 = all cores")
    run(parser.parse_args())


def run(options: argparse.Namespace) -> None:
    """Shards first as far as the first steps need them, then each stage; weights are replaced once all have ended."""
    if options.threads:
        torch.set_num_threads(options.threads)
    until, place, plan = time.time() + 60 * options.minutes, Place(options.folder), Plan()
    for index in range(8):
        make_shard(place.folder / "shards", index)
    for kind, steps in ((Autoencoder, plan.autoencoder), (Denoiser, plan.denoiser), (Descriptors, plan.descriptors)):
        if not train(kind(plan, place, round(steps * options.scale)), place, until=until):
            print(f"{kind.name}: time is up; the next call goes on from here, {WEIGHTS} stays as it is")
            return
        print(f"{kind.name}: done")
    print(f"{export(place, WEIGHTS) / 1e6:.1f} MB of weights in {WEIGHTS}")


if __name__ == "__main__":
    main()
