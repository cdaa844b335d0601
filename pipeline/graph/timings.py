"""Seconds per row measured by earlier runs on this machine, from which a plan estimates its time.

There is one file per machine, device and number of threads, next to the store. Timings are looked up by a digest of
everything that the cost of a row depends on (``timing_key``), so a plan never extrapolates to work that was not
measured. If the file cannot be read or written, plans lack their times; nothing else changes.
"""

from __future__ import annotations

import json
import platform
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from math import inf
from pathlib import Path

import torch

from pipeline.errors import DzopError
from pipeline.io.files import write_json
from pipeline.method import ONLINE_STAGES, Stages
from pipeline.spec import digest

FOLDER = ".rates"


@dataclass(eq=False)
class Timings:
    """Total rows and seconds by timing key. ``folder`` None disables saving; ``device`` is the torch device."""

    folder: Path | None
    device: str
    measured: dict[str, list[float]] = field(default_factory=dict)

    def add(self, key: str, rows: int, seconds: float) -> None:
        """Add rows that this run computed."""
        if rows and seconds > 0:
            before = self.measured.get(key, [0.0, 0.0])
            self.measured[key] = [before[0] + rows, before[1] + seconds]

    def seconds(self, key: str, rows: float) -> float | None:
        """Estimated seconds for a number of rows; None if this work was never measured on this machine."""
        totals = self._saved.get(key)
        return None if totals is None else rows * totals[1] / totals[0]

    def save(self) -> None:
        """Write this run's measurements, replacing older ones of the same key because the machine may have changed."""
        if self.folder is None or not self.measured:
            return
        with suppress(DzopError):  # a read-only or full disk, or a file in place of the folder
            write_json(self._path, self._read() | self.measured)

    @property
    def _path(self) -> Path:
        assert self.folder is not None
        processor = torch.cuda.get_device_name(self.device) if self.device.startswith("cuda") else "cpu"
        machine = [platform.node(), platform.machine(), processor, torch.get_num_threads()]
        return self.folder / FOLDER / f"{digest(machine)[:16]}.json"

    @cached_property
    def _saved(self) -> dict[str, list[float]]:
        return self._read()

    def _read(self) -> dict[str, list[float]]:
        if self.folder is None:
            return {}
        try:
            saved = json.loads(self._path.read_text())
            return {
                key: [float(rows), float(seconds)]
                for key, (rows, seconds) in saved.items()
                if _is_usable(rows, seconds)
            }
        except (OSError, ValueError, TypeError, AttributeError, OverflowError, RecursionError):
            return {}


def _is_usable(rows: float, seconds: float) -> bool:
    return 0 < rows < inf and 0 < seconds < inf


def timing_key(step: str, stages: Stages, layers: Sequence[int] = (), rows: int = 0) -> str:
    """Digest of everything that the seconds per row depend on. ``rows``: number of templates matched per query."""
    if step == "features":
        # A pass ends at the deepest layer. Pseudo-layers are negative and need the full pass.
        deepest = min(layers) if min(layers) < 0 else max(layers)
        return digest([step, stages.extract.recipe(), deepest])
    if step == "fits":
        return digest([step, stages.extract.recipe(), [fit.recipe() for fit in stages.fits], stages.render.recipe()])
    if step == "template encodings":
        return digest([step, stages.fuse.recipe(), stages.encoding_shape])
    if step == "poses":
        online = [getattr(stages, name).recipe() for name in ONLINE_STAGES]
        return digest([step, stages.extract.recipe(), online, rows, stages.second_look.recipe()])
    return digest([step, (stages.render if step == "templates" else stages.crop).recipe()])
