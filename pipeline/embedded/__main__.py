"""Train the embedded model from procedural objects, and replace the weights that ship once all stages are complete.

The training stops after --minutes; the same command resumes it from the last checkpoint.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import torch
from joblib import Parallel, delayed

from pipeline.embedded.export import export
from pipeline.embedded.plan import TrainingFolder, TrainingPlan
from pipeline.embedded.training import train
from pipeline.embedded.training_stages import Autoencoder, Denoiser, Descriptors
from pipeline.embedded.views import make_shard

WEIGHTS = Path(__file__).parent / "weights"
_FIRST_SHARDS = 8


def main() -> None:
    """Parse the options and train."""
    parser = argparse.ArgumentParser(prog="python -m pipeline.embedded", description=__doc__)
    devices = ("cpu", "cuda") if torch.cuda.is_available() else ("cpu",)
    add, default = parser.add_argument, "(default: %(default)s)"
    add("--folder", type=Path, default=Path("cache/embedded"), help=f"for shards, checkpoints, loss curves {default}")
    add("--minutes", type=_above_zero, default=120.0, help=f"stop after this time {default}")
    add("--scale", type=_above_zero, default=1.0, help=f"factor on the number of steps {default}")
    add("--batch", type=_above_zero, default=1.0, help=f"factor on the batch size; less for slow machines {default}")
    add("--device", choices=devices, default=devices[-1], help=f"where to train {default}")
    add("--workers", type=_count, default=0, help=f"processes that draw batches; 0: no extra processes {default}")
    add("--threads", type=_count, default=0, help=f"CPU threads of torch; 0: all cores {default}")
    run(parser.parse_args())


def run(options: argparse.Namespace) -> None:
    """Make shards, train the stages in turn, and export the weights if all are complete."""
    if options.threads:
        torch.set_num_threads(options.threads)
    until = time.time() + 60 * options.minutes
    folder, plan = TrainingFolder(options.folder), _scale_batches(TrainingPlan(), options.batch)
    _make_shards(folder.shards, plan.shards if options.workers else _FIRST_SHARDS, options.workers)
    for kind, steps in ((Autoencoder, plan.autoencoder), (Denoiser, plan.denoiser), (Descriptors, plan.descriptors)):
        stage = kind(plan, folder, round(steps * options.scale), options.device)
        if not train(stage, folder, until=until, workers=options.workers):
            print(f"{kind.name}: time is up. Run the same command again to resume; {WEIGHTS} is unchanged")
            return
        print(f"{kind.name}: done", flush=True)
    print(f"{export(folder, WEIGHTS) / 1e6:.1f} MB of weights in {WEIGHTS}")


def _make_shards(folder: Path, count: int, workers: int) -> None:
    """Make the first ``count`` shards in parallel.

    Without workers these are only the ones that the first steps read; later ones are made when they are needed.
    """
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


def _scale_batches(plan: TrainingPlan, factor: float) -> TrainingPlan:
    pictures, objects = max(round(factor * plan.pictures), 1), max(round(factor * plan.objects), 1)
    return replace(plan, pictures=pictures, objects=objects)


if __name__ == "__main__":
    main()
