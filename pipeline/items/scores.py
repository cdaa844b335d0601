"""Scores: which of the instances that a dataset asks for were found, by metric and threshold."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

CORRECT_MSSD = 0.2
"""Tables of poses and overlays call an estimate right when its MSSD is below this part of the diameter."""


@dataclass(frozen=True)
class DatasetId:
    """Which targets were asked for. ``key``: digest of them and their ground truth; equal keys may be compared."""

    name: str
    split: str
    key: str
    targets: int
    images: int
    objects: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Scores:
    """n annotated instances that count as targets, and whether the estimate matched to each is correct.

    ``visib_fract`` is NaN where the dataset does not say. Thresholds are those of metrics/recall.py: ``mssd`` by theta,
    ``mspd`` by pixels, ``vsd`` by tau and theta. ``vsd`` is None when it could not be computed; ``no_vsd`` says why.
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

    def select(self, chosen: Bool[np.ndarray, " n"]) -> Scores:
        """The scores of some instances."""
        arrays = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "no_vsd"}
        kept: dict[str, Any] = {name: None if v is None else v[chosen] for name, v in arrays.items()}
        return replace(self, **kept)

    def instances(self) -> list[tuple[int, int, int, int]]:
        """(scene_id, im_id, obj_id, gt_id) of each."""
        columns = (self.scene_id, self.im_id, self.obj_id, self.gt_id)
        return list(zip(*(column.tolist() for column in columns), strict=True))


@dataclass(frozen=True)
class PoseErrors:
    """Errors of estimate ``row`` against instance ``gt_id`` of its object.

    ``vsd`` by tolerance tau, None where not available; ``mspd_px`` for an image 640 px wide; ``rotation_deg`` as it
    stands, ``symmetric_rotation_deg`` against the symmetry that fits best.
    """

    row: int
    gt_id: int
    diameter_mm: float
    vsd: tuple[float, ...] | None
    mssd_mm: float
    mspd_px: float
    add_mm: float
    adi_mm: float
    rotation_deg: float
    symmetric_rotation_deg: float
    translation_mm: float

    @property
    def relative_mssd(self) -> float:
        """MSSD as a part of the diameter."""
        return self.mssd_mm / self.diameter_mm

    @property
    def looks_right(self) -> bool:
        """Whether tables of poses and overlays call the estimate right: MSSD below CORRECT_MSSD of the diameter."""
        return self.relative_mssd < CORRECT_MSSD


@dataclass(frozen=True)
class TemplateError:
    """How far the matched template's view is from the true one, degrees, in three readings (symmetry-aware).

    ``geodesic``: angle between the rotations. ``direction``: between the directions from the object to the camera.
    ``vectorised``: angle between the rotations written as vectors of nine numbers, the paper's formula as printed.
    """

    geodesic: float
    direction: float
    vectorised: float


def scores_to_record(scores: Scores) -> dict[str, Any]:
    """JSON-able; hits are bits, in hexadecimal."""
    visible = [None if np.isnan(v) else round(float(v), 6) for v in scores.visib_fract]
    return {
        "instances": scores.instances(),
        "visib_fract": visible,
        "mssd": _to_hex(scores.mssd),
        "mspd": _to_hex(scores.mspd),
        "vsd": None if scores.vsd is None else _to_hex(scores.vsd.reshape(len(scores), 100)),
        "no_vsd": scores.no_vsd,
    }


def scores_from_record(record: Mapping[str, Any]) -> Scores:
    """The scores a record holds."""
    scene_id, im_id, obj_id, gt_id = np.array(record["instances"], dtype=np.int64).reshape(-1, 4).T
    visible = np.array([np.nan if v is None else v for v in record["visib_fract"]], dtype=np.float64)
    if not {len(record[name]) for name in ("visib_fract", "mssd", "mspd")} <= {len(scene_id)}:
        raise ValueError("scores of another number of instances")
    mssd, mspd = _from_hex(record["mssd"], 10), _from_hex(record["mspd"], 10)
    vsd = None if record["vsd"] is None else _from_hex(record["vsd"], 100).reshape(len(scene_id), 10, 10)
    return Scores(scene_id, im_id, obj_id, gt_id, visible, mssd, mspd, vsd, record["no_vsd"])


def errors_to_record(errors: PoseErrors) -> dict[str, Any]:
    """JSON-able; what is infinitely far becomes null."""
    values = asdict(errors) | {"vsd": None if errors.vsd is None else list(errors.vsd)}
    return {n: None if isinstance(v, float) and not np.isfinite(v) else v for n, v in values.items()}


def errors_from_record(record: Mapping[str, Any]) -> PoseErrors:
    """The errors a record holds."""
    values: dict[str, Any] = {name: np.inf if value is None else value for name, value in record.items()}
    values["vsd"] = None if record["vsd"] is None else tuple(record["vsd"])
    return PoseErrors(**values)


def _to_hex(bits: Bool[np.ndarray, "n k"]) -> list[str]:
    return [np.packbits(row).tobytes().hex() for row in bits]


def _from_hex(rows: Sequence[str], count: int) -> Bool[np.ndarray, "n k"]:
    packed = np.array([list(bytes.fromhex(row)) for row in rows], dtype=np.uint8).reshape(len(rows), (count + 7) // 8)
    return np.unpackbits(packed, axis=1, count=count).astype(bool)
