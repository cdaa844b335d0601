"""true view, template views -> the templates nearest to it: an upper bound for matchers, not a method."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float

from pipeline.errors import BadInput
from pipeline.functional.rigid import rotation_angle_deg, rotation_between
from pipeline.items.matches import TemplateMatch
from pipeline.items.online import Query, TemplateBank
from pipeline.spec import NonNegative, Positive, spec
from pipeline.stages.match import Matcher, rank


@spec
class Oracle(Matcher):
    """The templates with the smallest angle to the true rotation, symmetries considered.

    Templates are rendered with the object on the optical axis, so the true rotation is first turned with the viewing
    ray onto that axis, where the object looks the same. ``layer`` is not used but must exist.
    """

    kind: ClassVar[str] = "match.oracle"
    version: ClassVar[int] = 1
    needs_truth: ClassVar[bool] = True

    layer: NonNegative = 2
    top_k: Positive = 1

    def __call__(self, query: Query, bank: TemplateBank) -> TemplateMatch:
        """The ``top_k`` nearest templates; scores are cosines of half the angle, 1 for the exact view."""
        if query.truth is None:
            raise BadInput("match=oracle", found="features", needed="the true pose, from detections of ground truth")
        return rank(view_score(query.truth.T_cam_obj, query.truth.symmetries, bank.T_cam_obj), top_k=self.top_k)


def view_score(
    T_true: Float[np.ndarray, "4 4"], symmetries: Float[np.ndarray, "s 4 4"], T_cam_obj: Float[np.ndarray, "n 4 4"]
) -> Float[torch.Tensor, " n"]:
    """Cosine of half the angle between each template's rotation and the nearest symmetric copy of the true one."""
    turn = rotation_between(T_true[:3, 3], np.array([0.0, 0.0, 1.0]))
    true = turn @ T_true[:3, :3] @ symmetries[:, :3, :3]
    views = T_cam_obj[:, None, :3, :3]
    shape = (len(views), len(true), 3, 3)
    angle = rotation_angle_deg(np.broadcast_to(views, shape), np.broadcast_to(true[None], shape)).min(axis=1)
    return torch.from_numpy(np.cos(np.deg2rad(angle / 2)))
