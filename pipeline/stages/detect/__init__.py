"""images -> detections."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

from pipeline.bop.dataset import Dataset
from pipeline.items.views import Detection, Target
from pipeline.spec import Variant


class Detector(Variant, Protocol):
    """What a detect variant is."""

    def sources(self, dataset: Dataset, targets: Sequence[Target]) -> list[Path]:
        """The files whose bytes decide the answer (they enter the key)."""
        ...

    def __call__(self, dataset: Dataset, targets: Sequence[Target]) -> list[Detection]:
        """Detections of the targets' objects in the targets' images, best score first within image and object."""
        ...
