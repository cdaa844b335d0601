"""crops, clusters, correspondences, pose -> one picture that shows how a pose came about."""

from __future__ import annotations

import colorsys
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import PIL.Image
import PIL.ImageDraw
import PIL.ImageFont
from jaxtyping import Bool, Int, UInt8

from pipeline.items.features import Clusters
from pipeline.items.matches import Correspondences
from pipeline.items.views import Image
from pipeline.report.overlay import Drawn, draw_overlay

PANEL_PX = 240
TITLE_PX = 20
GAP_PX = 6
LINES_SHOWN = 60
PAPER, INK, QUIET = (255, 255, 255), (30, 34, 40), (120, 126, 134)
INLIER, OUTLIER = (0, 150, 110), (215, 80, 40)  # told apart by colour-blind eyes as well
_MARGIN = 0.6  # of the box's longer side, shown around it in the photograph

Picture = UInt8[np.ndarray, "H W 3"]


@dataclass(frozen=True, eq=False)
class Card:
    """What is known of one detection. ``inliers``: of ``matches``; ``reason``: why there is no pose, "" with one."""

    photo: Image
    bbox_xyxy: tuple[float, float, float, float]
    drawn: Sequence[Drawn]
    query_rgb: Picture
    template_rgb: Picture | None = None
    clusters: Clusters | None = None
    matches: Correspondences | None = None
    inliers: Bool[np.ndarray, " m"] | None = None
    reason: str = ""


def draw_card(card: Card) -> Picture:
    """Four rows of two panels: crops, matched clusters, correspondences (both wide), the pose in the photograph.

    What was not reached is left out; a detection without a pose has the reason in the pose's place.
    """
    rows = [_beside(_titled("query", card.query_rgb), _titled("matched template", card.template_rgb))]
    if card.clusters is not None and card.template_rgb is not None:
        query, template = paint_clusters(card.clusters, card.query_rgb, card.template_rgb)
        pairs = f"{len(card.clusters.pairs)} matched clusters"
        rows.append(_beside(_titled(pairs, query), _titled("the same in the template", template)))
    if card.matches is not None and card.template_rgb is not None:
        rows.append(_titled(*_lines(card.query_rgb, card.template_rgb, card.matches, card.inliers)))
    rows.append(_titled("no pose" if card.reason else "pose (blue: truth)", _in_photo(card)))
    if card.reason:
        rows.append(_written(card.reason))
    gap = np.full((GAP_PX, rows[0].shape[1], 3), PAPER, dtype=np.uint8)
    return np.concatenate([part for row in rows for part in (row, gap)][:-1])


def pick_cases(relative_mssd: Sequence[float | None], *, count: int) -> list[int]:
    """Which answers to show: the best half, then the worst, each in that order; None (no pose, no truth) is worst."""
    order = sorted(range(len(relative_mssd)), key=lambda i: (_as_error(relative_mssd[i]), i))
    if len(order) <= count:
        return order
    best = (count + 1) // 2
    return order[:best] + order[::-1][: count - best]


def _as_error(value: float | None) -> float:
    return np.inf if value is None else value


def paint_clusters(clusters: Clusters, query_rgb: Picture, template_rgb: Picture) -> tuple[Picture, Picture]:
    """Both crops with their cells in the colour of their cluster pair; cells of clusters without a partner are grey.

    Hue turns with the direction from the template's middle to the pair's place in the template, and colours are paler
    near the middle: where both pictures show the same layout of colours, the clusters agree.
    """
    template_label = clusters.template_label.cpu().numpy()
    colours = _pair_colours(template_label, clusters.pairs.cpu().numpy())
    query_label = clusters.query_label.cpu().numpy()
    query_of = {int(q): c for (q, _), c in zip(clusters.pairs.tolist(), colours, strict=True)}
    template_of = {int(t): c for (_, t), c in zip(clusters.pairs.tolist(), colours, strict=True)}
    return _painted(query_rgb, query_label, query_of), _painted(template_rgb, template_label, template_of)


def _pair_colours(label: Int[np.ndarray, "h w"], pairs: Int[np.ndarray, "p 2"]) -> list[tuple[int, int, int]]:
    rows, columns = np.nonzero(label >= 0)
    middle = np.array([rows.mean(), columns.mean()]) if len(rows) else np.zeros(2)
    reach = max(float(np.hypot(rows - middle[0], columns - middle[1]).max()), 1.0) if len(rows) else 1.0
    colours = []
    for _, template in pairs:
        cells = np.argwhere(label == template)
        y, x = (cells.mean(axis=0) - middle) / reach if len(cells) else (0.0, 0.0)
        hue, strength = (np.arctan2(y, x) / (2 * np.pi)) % 1.0, min(float(np.hypot(x, y)), 1.0)
        r, g, b = colorsys.hls_to_rgb(hue, 0.78 - 0.3 * strength, 0.85)
        colours.append((round(255 * r), round(255 * g), round(255 * b)))
    return colours


def _painted(rgb: Picture, label: Int[np.ndarray, "h w"], colour_of: dict[int, tuple[int, int, int]]) -> Picture:
    ink = np.zeros((*label.shape, 3), dtype=np.uint8)
    for cluster in np.unique(label[label >= 0]):
        ink[label == cluster] = colour_of.get(int(cluster), (90, 90, 90))
    ink = cv2.resize(ink, (PANEL_PX, PANEL_PX), interpolation=cv2.INTER_NEAREST)
    cells = cv2.resize((label >= 0).astype(np.uint8), (PANEL_PX, PANEL_PX), interpolation=cv2.INTER_NEAREST) > 0
    under = _panel(rgb)
    return np.where(cells[..., None], (0.75 * ink + 0.25 * under).astype(np.uint8), under // 3)


def _lines(
    query_rgb: Picture, template_rgb: Picture, matches: Correspondences, inliers: Bool[np.ndarray, " m"] | None
) -> tuple[str, Picture]:
    """The two crops side by side with some of the correspondences, inliers over outliers."""
    canvas = _beside(_panel(query_rgb), _panel(template_rgb))
    scale = PANEL_PX / len(query_rgb)
    query = (matches.query_px.cpu().numpy() + 0.5) * scale - 0.5
    template = (matches.template_px.cpu().numpy() + 0.5) * scale - 0.5 + [PANEL_PX + GAP_PX, 0]
    good = np.zeros(len(query), dtype=bool) if inliers is None else inliers
    shown = evenly(len(query), LINES_SHOWN)
    for index in sorted(shown, key=lambda i: bool(good[i])):
        colour = INLIER if good[index] else OUTLIER
        a, b = ((round(16 * float(px[index][0])), round(16 * float(px[index][1]))) for px in (query, template))
        cv2.line(canvas, a, b, colour, 1, cv2.LINE_AA, 4)
        for end in (a, b):
            cv2.circle(canvas, end, 2 * 16, colour, -1, cv2.LINE_AA, 4)
    return f"{int(good.sum())} inliers (green) of {len(query)} correspondences", canvas


def evenly(count: int, most: int) -> list[int]:
    """At most ``most`` indices below ``count``, evenly spread."""
    return sorted({int(i) for i in np.linspace(0, count - 1, min(count, most))}) if count else []


def _in_photo(card: Card) -> Picture:
    """The photograph around the detection, twice as wide as high, with the poses drawn."""
    width, height = 2 * PANEL_PX + GAP_PX, PANEL_PX
    x0, y0, x1, y1 = card.bbox_xyxy
    side = max(x1 - x0, (y1 - y0), 8.0) * (1 + _MARGIN)
    h = int(np.ceil(max(side, (x1 - x0) * (1 + _MARGIN) * height / width)))
    w = int(np.ceil(h * width / height))
    left, top = round((x0 + x1 - w) / 2), round((y0 + y1 - h) / 2)
    window = _window(card.photo.rgb, left, top, w, h)
    shift = np.array([[1.0, 0, -left], [0, 1, -top], [0, 0, 1]])
    shown = Image(card.photo.scene_id, card.photo.im_id, window, shift @ card.photo.K)
    return cv2.resize(draw_overlay(shown, card.drawn, legend=False), (width, height), interpolation=cv2.INTER_AREA)


def _window(rgb: Picture, left: int, top: int, w: int, h: int) -> Picture:
    """A window of a photograph, black beyond its border."""
    out = np.zeros((h, w, 3), dtype=np.uint8)
    rows, columns = slice(max(top, 0), min(top + h, len(rgb))), slice(max(left, 0), min(left + w, rgb.shape[1]))
    if rows.start < rows.stop and columns.start < columns.stop:
        out[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left] = rgb[rows, columns]
    return out


def _panel(rgb: Picture) -> Picture:
    return cv2.resize(rgb, (PANEL_PX, PANEL_PX), interpolation=cv2.INTER_CUBIC)


def _titled(title: str, picture: Picture | None) -> Picture:
    """A panel under its title; an empty one for a picture that is not there."""
    if picture is None:
        picture = np.full((PANEL_PX, PANEL_PX, 3), 240, dtype=np.uint8)
    if picture.shape[0] == picture.shape[1]:
        picture = _panel(picture)
    strip = PIL.Image.new("RGB", (picture.shape[1], TITLE_PX), PAPER)
    PIL.ImageDraw.Draw(strip).text((1, 2), title, fill=QUIET, font=PIL.ImageFont.load_default(13))
    return np.concatenate([np.asarray(strip), picture])


def _beside(left: Picture, right: Picture) -> Picture:
    gap = np.full((len(left), GAP_PX, 3), PAPER, dtype=np.uint8)
    return np.concatenate([left, gap, right], axis=1)


def _written(text: str) -> Picture:
    lines = textwrap.wrap(text, 64)
    strip = PIL.Image.new("RGB", (2 * PANEL_PX + GAP_PX, 18 * len(lines) + 6), PAPER)
    draw = PIL.ImageDraw.Draw(strip)
    for row, line in enumerate(lines):
        draw.text((1, 2 + 18 * row), line, fill=INK, font=PIL.ImageFont.load_default(14))
    return np.asarray(strip)
