"""Scores: which of a dataset's target instances were estimated correctly, by metric and threshold."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int


@dataclass(frozen=True)
class DatasetId:
    """Which targets were evaluated. ``key``: digest of targets and ground truth; results with equal keys compare."""

    name: str
    split: str
    key: str
    targets: int
    images: int
    objects: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Scores:
    """n annotated target instances, and whether the estimate matched to each is correct at each threshold.

    Thresholds are those of metrics/recall.py: ``mssd`` by theta, ``mspd`` by pixels, ``vsd`` by tau and theta. ``vsd``
    is None if it could not be computed, for the reason ``no_vsd``. ``visib_fract`` is NaN where unknown.
    """

    scene_id: Int[np.ndarray, " n"]
    im_id: Int[np.ndarray, " n"]
    obj_id: Int[np.ndarray, " n"]
    gt_id: Int[np.ndarray, " n"]
    visib_fract: Float[np.ndarray, " n"]
    mssd: Bool[np.ndarray, "n 10"]
    mspd: Bool[np.ndarray, "n 10"]
    vsd: Bool[np.ndarray, "n 10 10"] | None
    no_vsd: str = ""

    def __len__(self) -> int:
        return len(self.obj_id)

    def select(self, mask: Bool[np.ndarray, " n"]) -> Scores:
        """The scores of the instances where ``mask`` is True."""
        arrays = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "no_vsd"}
        selected: dict[str, Any] = {name: None if v is None else v[mask] for name, v in arrays.items()}
        return replace(self, **selected)

    def instances(self) -> list[tuple[int, int, int, int]]:
        """(scene_id, im_id, obj_id, gt_id) of each instance."""
        columns = (self.scene_id, self.im_id, self.obj_id, self.gt_id)
        return list(zip(*(column.tolist() for column in columns), strict=True))
