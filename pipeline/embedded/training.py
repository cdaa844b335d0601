"""The training loop: batches, optimiser steps, loss curves, checkpoints. Seeded and resumable."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from typing import Any

import cv2
import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset

from pipeline.embedded.plan import TrainingFolder
from pipeline.embedded.training_stages import TrainingStage

_STEPS_PER_LOG = 25  # on a GPU: reading a loss waits for the device

LossRecord = dict[str, Any]


class _Batches(Dataset[Any]):
    """A stage's batches by step, for the workers of a DataLoader."""

    def __init__(self, stage: TrainingStage) -> None:
        self.stage = stage

    def __getitem__(self, step: int) -> Any:
        return self.stage.batch(step)


def iterate_batches(stage: TrainingStage, first: int, workers: int) -> Iterator[Any]:
    """Batches from step ``first`` on, in order; they do not depend on the number of worker processes."""
    steps: Any = range(first, stage.steps)
    if not workers:
        return map(stage.batch, steps)
    loader = DataLoader(
        _Batches(stage),
        batch_size=None,
        sampler=steps,
        num_workers=workers,
        multiprocessing_context="fork",
        worker_init_fn=lambda _: cv2.setNumThreads(0),
    )
    return iter(loader)


def train(
    stage: TrainingStage, folder: TrainingFolder, *, until: float, save_every_s: float = 90.0, workers: int = 0
) -> bool:
    """Train a stage from its last checkpoint to its end or to the time ``until``. Returns whether it is complete."""
    optimiser = torch.optim.AdamW(stage.model.parameters(), lr=stage.rate, weight_decay=stage.decay, betas=(0.9, 0.98))
    step = _resume(stage, optimiser, folder)
    saved_at = time.monotonic()
    records: list[LossRecord] = []
    for batch in iterate_batches(stage, step, workers):
        if time.time() >= until:
            break
        records.append({"step": step, **_train_step(stage, optimiser, batch, step)})
        step += 1
        if len(records) >= _STEPS_PER_LOG or stage.device.type == "cpu":
            _log_losses(folder, stage, records)
        if time.monotonic() - saved_at > save_every_s:
            _save_checkpoint(stage, optimiser, step, folder)
            saved_at = time.monotonic()
    _log_losses(folder, stage, records)
    _save_checkpoint(stage, optimiser, step, folder)
    return step >= stage.steps


def _train_step(stage: TrainingStage, optimiser: torch.optim.Optimizer, batch: Any, step: int) -> dict[str, Tensor]:
    """One optimiser step; returns loss terms and gradient norm, still on the device."""
    for group in optimiser.param_groups:
        group["lr"] = stage.rate_at(step)
    terms = stage.loss(batch, step)
    optimiser.zero_grad()
    torch.stack(list(terms.values())).sum().backward()
    norm = nn.utils.clip_grad_norm_(stage.model.parameters(), 1.0)
    optimiser.step()
    stage.update_average(step)
    return {**{name: value.detach() for name, value in terms.items()}, "norm": norm}


def _log_losses(folder: TrainingFolder, stage: TrainingStage, records: list[LossRecord]) -> None:
    """Append losses to the curve's file and clear the list."""
    with folder.curve(stage.name).open("a") as curve:
        for record in records:
            step = int(record.pop("step"))
            values = {name: round(float(value), 5) for name, value in record.items()}
            curve.write(json.dumps({"step": step, **values, "at": round(time.time(), 2)}) + "\n")
    records.clear()


def _resume(stage: TrainingStage, optimiser: torch.optim.Optimizer, folder: TrainingFolder) -> int:
    """Load the last checkpoint, if there is one; returns the next step."""
    if not folder.checkpoint(stage.name).exists():
        return 0
    saved = folder.load_checkpoint(stage.name, stage.device)
    stage.model.load_state_dict(saved["model"])
    stage.average.load_state_dict(saved["average"])
    optimiser.load_state_dict(saved["optimiser"])
    return int(saved["step"])


def _save_checkpoint(stage: TrainingStage, optimiser: torch.optim.Optimizer, step: int, folder: TrainingFolder) -> None:
    """Replace the checkpoint atomically."""
    state: dict[str, Any] = {"step": step, "model": stage.model.state_dict(), "average": stage.average.state_dict()}
    state["optimiser"] = optimiser.state_dict()
    partial = folder.checkpoint(stage.name).with_suffix(".partial")
    torch.save(state | stage.checkpoint_extras(), partial)
    partial.rename(folder.checkpoint(stage.name))
