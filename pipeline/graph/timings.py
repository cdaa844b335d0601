"""Seconds per row as earlier runs on this machine took them, beside the store: what a plan foretells time by.

Kept by machine, device and number of threads, and by all that decides the work of a row, so that nothing is foretold
of what was not measured. A place that cannot be written to, or none, costs a plan its times and nothing else.
"""

from __future__ import annotations

import json
import platform
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import torch

from pipeline.io.files import write_json
from pipeline.route import ONLINE_STAGES, Stages
from pipeline.spec import digest

FOLDER = ".rates"


@dataclass(eq=False)
class Rates:
    """Rows and seconds by digest of the work. ``folder`` None: nothing is kept; ``device``: where tensors live."""

    folder: Path | None
    device: str
    noted: dict[str, list[float]] = field(default_factory=dict)

    def note(self, work: str, rows: int, seconds: float) -> None:
        """Count rows that were computed."""
        if rows and seconds > 0:
            before = self.noted.get(work, [0.0, 0.0])
            self.noted[work] = [before[0] + rows, before[1] + seconds]

    def seconds(self, work: str, rows: float) -> float | None:
        """What rows of a work will take; None where nobody measured it here."""
        known = self._kept.get(work)
        return None if known is None else rows * known[1] / known[0]

    def save(self) -> None:
        """Keep what this run measured: of a work its latest run's figures, which know the machine as it is now."""
        if self.folder is None or not self.noted:
            return
        try:
            write_json(self._path, self._read() | self.noted)
        except OSError:
            return

    @property
    def _path(self) -> Path:
        assert self.folder is not None
        cuda = torch.cuda.get_device_name(self.device) if self.device.startswith("cuda") else "cpu"
        machine = [platform.node(), platform.machine(), cuda, torch.get_num_threads()]
        return self.folder / FOLDER / f"{digest(machine)[:16]}.json"

    @cached_property
    def _kept(self) -> dict[str, list[float]]:
        return self._read()

    def _read(self) -> dict[str, list[float]]:
        if self.folder is None:
            return {}
        try:
            kept = json.loads(self._path.read_text())
            return {str(work): [float(rows), float(seconds)] for work, (rows, seconds) in kept.items() if rows > 0}
        except (OSError, ValueError, TypeError, AttributeError):
            return {}


def work_of(step: str, stages: Stages, layers: Sequence[int] = (), rows: int = 0) -> str:
    """Digest of what decides the seconds of a step's row. ``rows``: templates that a pose is searched among."""
    if step == "features":
        # a pass ends at the deepest layer; pseudo-layers, which are negative, want all of it
        deepest = min(layers) if min(layers) < 0 else max(layers)
        return digest([step, stages.extract.recipe(), deepest])
    if step == "fits":
        return digest([step, stages.extract.recipe(), [fit.recipe() for fit in stages.fits], stages.render.recipe()])
    if step == "poses":
        online = [getattr(stages, name).recipe() for name in ONLINE_STAGES]
        return digest([step, stages.extract.recipe(), online, rows, stages.second_look])
    return digest([step, (stages.render if step == "templates" else stages.crop).recipe()])
