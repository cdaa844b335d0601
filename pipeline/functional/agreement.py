"""A pose judged by feature maps: do the template's cells look like the query's cells that the pose puts them in?"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import max_pool2d

from pipeline.functional.masks import foreground
from pipeline.functional.rigid import transform
from pipeline.functional.similarity import l2_normalize


def agreement(
    query: Float[Tensor, "d h w"],
    template: Float[Tensor, "d h w"],
    query_mask: Bool[Tensor, "h w"],
    template_mask: Bool[Tensor, "h w"],
    points_obj: Float[np.ndarray, "m 3"],
    K_cell: Float[np.ndarray, "3 3"],
    T_cam_obj: Float[np.ndarray, "4 4"],
) -> tuple[float, float]:
    """Mean cosine of the template's cells with the query's foreground cells they land in, and the share of these.

    ``points_obj`` (mm): those of the template's foreground cells in reading order, NaN where there is none. ``K_cell``
    takes the camera frame to the query's cells. Cells that land off the foreground count for neither; gaps of up to two
    cells between landed ones count as reached. (0, 0) where none lands.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        in_cells = transform(T_cam_obj, points_obj) @ K_cell.T
        xy = np.rint(in_cells[:, :2] / in_cells[:, 2:])
        inside = (in_cells[:, 2] > 0) & (xy >= 0).all(1) & (xy < query_mask.shape[::-1]).all(1)
    column, row = torch.from_numpy(xy[inside].astype(np.int64)).to(query.device).T
    cell = foreground(template_mask)[torch.from_numpy(inside).to(query.device)]
    landed = query_mask[row, column]
    if not landed.any():
        return 0.0, 0.0
    reached = torch.zeros_like(query_mask)
    reached[row, column] = True
    seen = l2_normalize(query[:, row[landed], column[landed]].float().T)
    cosine = (seen * l2_normalize(template.flatten(1)[:, cell[landed]].float().T)).sum(1)
    return float(cosine.mean()), float((_closed(reached) & query_mask).sum() / query_mask.sum())


def _closed(mask: Bool[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    """Dilated, then eroded, by one cell."""
    grown = max_pool2d(mask[None, None].float(), 3, stride=1, padding=1)
    return -max_pool2d(-grown, 3, stride=1, padding=1)[0, 0] > 0.5
