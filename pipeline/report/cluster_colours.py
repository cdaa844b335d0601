"""Clusters -> both crops with matched clusters in the same colour."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
from jaxtyping import Int

from pipeline.items.features import Clusters
from pipeline.report.panels import PANEL_PX, Picture, resize_to_panel

UNMATCHED = (72, 72, 72)
# colour of a pair by its place in the template: darker downwards, from blue to yellow and red rightwards. Colour-blind
# people see both contrasts, and the green in the middle differs from the grey of unmatched clusters
_PALETTE = np.array(
    [
        [(90, 220, 255), (215, 255, 160), (255, 225, 50)],
        [(50, 120, 245), (40, 200, 100), (245, 140, 30)],
        [(95, 45, 185), (195, 55, 160), (205, 35, 45)],
    ],
    dtype=np.float32,
)

Colour = tuple[int, int, int]


def paint_clusters(clusters: Clusters, query_rgb: Picture, template_rgb: Picture) -> tuple[Picture, Picture]:
    """Both crops as panels, each cell in the colour of its cluster pair; cells of unmatched clusters are grey.

    The colour encodes where in the template the pair is: bright at the top, dark at the bottom, blue on the left,
    yellow to red on the right. Where both pictures show the same layout of colours, the clusters agree. Darker lines
    separate clusters.
    """
    template_label = clusters.template_label.cpu().numpy()
    colours = _pair_colours(template_label, clusters.pairs.cpu().numpy())
    query_label = clusters.query_label.cpu().numpy()
    query_colours = {int(q): c for (q, _), c in zip(clusters.pairs.tolist(), colours, strict=True)}
    template_colours = {int(t): c for (_, t), c in zip(clusters.pairs.tolist(), colours, strict=True)}
    return _paint(query_rgb, query_label, query_colours), _paint(template_rgb, template_label, template_colours)


def _pair_colours(label: Int[np.ndarray, "h w"], pairs: Int[np.ndarray, "p 2"]) -> list[Colour]:
    """Colour of each pair, by the centre of its template cluster within the bounding box of the template's cells."""
    cells = np.argwhere(label >= 0)
    low, extent = (cells.min(axis=0), np.maximum(np.ptp(cells, axis=0), 1)) if len(cells) else (np.zeros(2), np.ones(2))
    colours = []
    for _, template in pairs:
        members = np.argwhere(label == template)
        y, x = 2 * (members.mean(axis=0) - low) / extent if len(members) else (1.0, 1.0)
        column, row = (np.full((1, 1), value, dtype=np.float32) for value in (x, y))
        r, g, b = (round(part) for part in cv2.remap(_PALETTE, column, row, cv2.INTER_LINEAR)[0, 0].tolist())
        colours.append((r, g, b))
    return colours


def _paint(rgb: Picture, label: Int[np.ndarray, "h w"], colour_of: Mapping[int, Colour]) -> Picture:
    colours = np.zeros((*label.shape, 3), dtype=np.uint8)
    for cluster in np.unique(label[label >= 0]):
        colours[label == cluster] = colour_of.get(int(cluster), UNMATCHED)
    cell = np.arange(PANEL_PX) * len(label) // PANEL_PX
    to_px = np.ix_(cell, cell)
    matched = np.where(np.isin(label, list(colour_of)), label, -1)[to_px]
    border = (matched != np.roll(matched, 1, axis=0)) | (matched != np.roll(matched, 1, axis=1))
    crop = resize_to_panel(rgb)
    grey = cv2.cvtColor(cv2.cvtColor(crop, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB)
    blend = 0.9 * colours[to_px] + 0.1 * grey
    blend = np.where(border[..., None], 0.78 * blend, blend).astype(np.uint8)
    return np.where(label[to_px][..., None] >= 0, blend, crop // 3)
