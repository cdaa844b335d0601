"""true view, template views -> the templates nearest to it: an upper bound for every matcher, never a result."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pipeline.errors import BadInput
from pipeline.functional.rigid import rotation_angle_deg, rotation_between
from pipeline.items.matches import TemplateMatch
from pipeline.spec import NonNegative, Positive, Spec, spec
from pipeline.stages.match import ranked


@spec
class Oracle(Spec):
    """The templates with the smallest angle to the true rotation, symmetries considered.

    Templates are rendered with the object on the optical axis: the true rotation is first turned with the viewing ray
    onto that axis, so that the object looks the same there. ``layer`` is read by nothing but must exist.
    """

    kind: ClassVar[str] = "match.oracle"
    version: ClassVar[int] = 1
    needs_truth: ClassVar[bool] = True

    layer: NonNegative = 2
    top_k: Positive = 1

    def __call__(
        self,
        query: Float[Tensor, "c h w"],
        query_mask: Bool[Tensor, "S S"],
        bank: Float[Tensor, "n c h w"],
        bank_mask: Bool[Tensor, "n S S"],
    ) -> TemplateMatch:
        """Not without the truth."""
        raise BadInput("match=oracle", found="features", needed="the true pose, from detections of ground truth")

    def by_truth(
        self,
        T_true: Float[np.ndarray, "4 4"],
        symmetries: Float[np.ndarray, "s 4 4"],
        T_cam_obj: Float[np.ndarray, "n 4 4"],
    ) -> TemplateMatch:
        """The ``top_k`` nearest templates; scores are cosines of half the angle, 1 for the very view."""
        turn = rotation_between(T_true[:3, 3], np.array([0.0, 0.0, 1.0]))
        true = turn @ T_true[:3, :3] @ symmetries[:, :3, :3]
        views = T_cam_obj[:, None, :3, :3]
        shape = (len(views), len(true), 3, 3)
        angle = rotation_angle_deg(np.broadcast_to(views, shape), np.broadcast_to(true[None], shape)).min(axis=1)
        return ranked(torch.from_numpy(np.cos(np.deg2rad(angle / 2))), top_k=self.top_k)
