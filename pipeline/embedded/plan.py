"""How long and on what the model is trained, and the folder that a training writes to."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from pipeline.embedded.batches import Source


@dataclass(frozen=True)
class TrainingPlan:
    """Steps of each stage and sizes of batches.

    A batch of the autoencoder and the denoiser has ``pictures``, the denoiser adds ``noises`` noise samples to each. A
    batch of the descriptors has ``objects`` with all their clusters of views; in its first ``easy`` steps the pictures
    are easier. Objects come from ``shards`` shards.
    """

    shards: int = 300
    autoencoder: int = 1200
    denoiser: int = 1500
    descriptors: int = 5600
    easy: int = 800
    pictures: int = 64
    noises: int = 4
    objects: int = 8
    seed: int = 0


@dataclass(frozen=True)
class TrainingFolder:
    """Folder of a training: shards, checkpoints, loss curves."""

    folder: Path

    @property
    def shards(self) -> Path:
        """Folder of the shards."""
        return self.folder / "shards"

    def source(self, plan: TrainingPlan, *, validation: bool = False) -> Source:
        """The objects to train on, or those to validate on."""
        if validation:
            return Source(self.shards, 2, seed=1, start=2, validation=True)
        return Source(self.shards, plan.shards, seed=plan.seed)

    def checkpoint(self, stage: str) -> Path:
        """File of a stage's last checkpoint."""
        return self.folder / f"{stage}.pt"

    def curve(self, stage: str) -> Path:
        """File of a stage's losses, one JSON object per line."""
        return self.folder / f"{stage}.jsonl"

    def load_checkpoint(self, stage: str, device: torch.device) -> dict[str, Any]:
        """The last checkpoint of a stage."""
        return dict(torch.load(self.checkpoint(stage), map_location=device, weights_only=True))
