"""Agreement of a pose with feature maps: compare template cells with the query cells they project to."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import max_pool2d

from pipeline.functional.masks import foreground
from pipeline.functional.rigid import transform
from pipeline.functional.similarity import l2_normalize


def measure_agreement(
    query: Float[Tensor, "d h w"],
    template: Float[Tensor, "d h w"],
    query_mask: Bool[Tensor, "h w"],
    template_mask: Bool[Tensor, "h w"],
    points_obj: Float[np.ndarray, "m 3"],
    K_cell: Float[np.ndarray, "3 3"],
    T_cam_obj: Float[np.ndarray, "4 4"],
) -> tuple[float, float]:
    """Mean cosine between template cells and the query cells they project to, and the covered share of the query.

    ``points_obj`` (mm): one point per foreground cell of the template, in row-major order, NaN where unknown.
    ``K_cell`` projects the camera frame to query cells. Cells that project outside the query's foreground count for
    neither value; gaps of up to two cells count as covered. (0, 0) if no cell projects into the foreground.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        in_cells = transform(T_cam_obj, points_obj) @ K_cell.T
        xy = np.rint(in_cells[:, :2] / in_cells[:, 2:])
        inside = (in_cells[:, 2] > 0) & (xy >= 0).all(1) & (xy < query_mask.shape[::-1]).all(1)
    column, row = torch.from_numpy(xy[inside].astype(np.int64)).to(query.device).T
    template_cell = foreground(template_mask)[torch.from_numpy(inside).to(query.device)]
    on_object = query_mask[row, column]
    if not on_object.any():
        return 0.0, 0.0
    covered = torch.zeros_like(query_mask)
    covered[row, column] = True
    query_features = l2_normalize(query.movedim(0, -1)[row[on_object], column[on_object]].float())
    template_features = l2_normalize(template.movedim(0, -1).flatten(0, 1)[template_cell[on_object]].float())
    cosine = (query_features * template_features).sum(1)
    return float(cosine.mean()), float((_close(covered) & query_mask).sum() / query_mask.sum())


def _close(mask: Bool[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    """Morphological closing with a 3 x 3 square."""
    dilated = max_pool2d(mask[None, None].float(), 3, stride=1, padding=1)
    return -max_pool2d(-dilated, 3, stride=1, padding=1)[0, 0] > 0.5
