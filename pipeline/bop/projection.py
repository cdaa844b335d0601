"""Check that projected poses land on their annotated boxes: they do not if K belongs to another image size."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from pipeline.bop.models import ModelInfo
from pipeline.bop.scene import GroundTruth
from pipeline.errors import BadInput
from pipeline.functional.camera import project
from pipeline.functional.rigid import transform

# Box diagonals. The largest offset over the targets of LM-O and YCB-V in the tests is 0.13; a K for an image of half
# the size gives 0.9 or more.
_MAX_OFFSET = 0.5


def check_projections(
    instances: Sequence[GroundTruth],
    infos: Mapping[int, ModelInfo],
    K: Float[np.ndarray, "3 3"],
    size_hw: tuple[int, int],
    where: str,
) -> None:
    """Raise BadInput if K projects most of an image's annotated objects away from their boxes."""
    found = [_projection_offset(gt, infos.get(gt.obj_id), K, size_hw) for gt in instances]
    offsets = [offset for offset in found if offset is not None]
    wrong = sum(offset > _MAX_OFFSET for offset in offsets)
    if wrong > len(offsets) / 2:
        raise BadInput(
            where,
            found=f"a K that projects {wrong} of {len(offsets)} annotated objects away from their boxes",
            needed=f"the K of this image of {size_hw[1]} x {size_hw[0]} (width x height)",
        )


def _projection_offset(
    gt: GroundTruth, info: ModelInfo | None, K: Float[np.ndarray, "3 3"], size_hw: tuple[int, int]
) -> float | None:
    """Distance between an instance's projected centre and the centre of its annotated box, in box diagonals.

    A large value reveals a K of another image size, which K alone does not. None if the box is not fully inside the
    image or models_info.json has no centre.
    """
    h, w = size_hw
    if info is None or info.centre is None or gt.bbox_obj_xyxy is None:
        return None
    low, high = np.reshape(gt.bbox_obj_xyxy, (2, 2))
    centre_cam = transform(gt.T_cam_obj, info.centre)
    if low.min() < 0.5 or high[0] > w - 1.5 or high[1] > h - 1.5 or centre_cam[2] <= 0:
        return None
    return float(np.linalg.norm(project(K, centre_cam) - (low + high) / 2) / np.linalg.norm(high - low))
