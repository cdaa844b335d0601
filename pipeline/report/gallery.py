"""crops, clusters, correspondences, pose -> one picture that shows how a pose came about."""

from __future__ import annotations

import textwrap
from collections import Counter
from collections.abc import Mapping, Sequence
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
from pipeline.report.overlay import DrawnPose, Role, draw_overlay

PANEL_PX = 240
TITLE_PX = 24
GAP_PX = 6
LINES_SHOWN = 60
PAPER, INK = (255, 255, 255), (30, 34, 40)
INLIER, OUTLIER, UNTOLD = (80, 220, 190), (255, 90, 30), (200, 205, 210)  # colour-blind eyes tell them apart too
ALONE = (72, 72, 72)  # a cluster without a partner
_ROLE_WORDS: dict[Role, str] = {
    "truth": "truth blue",
    "correct": "estimate green (correct)",
    "wrong": "estimate red (wrong)",
    "unchecked": "estimate amber",
}
_MARGIN = 0.3  # of the box's sides, shown on each side of it in the photograph
# colour of a pair by its place in the template. Downwards darker, rightwards from blue to yellow and red: the two
# contrasts that every eye sees; the green in the middle keeps it apart from the grey of clusters without a partner
_PALETTE = np.array(
    [
        [(90, 220, 255), (215, 255, 160), (255, 225, 50)],
        [(50, 120, 245), (40, 200, 100), (245, 140, 30)],
        [(95, 45, 185), (195, 55, 160), (205, 35, 45)],
    ],
    dtype=np.float32,
)

Picture = UInt8[np.ndarray, "_H _W 3"]
Colour = tuple[int, int, int]


@dataclass(frozen=True, eq=False)
class Card:
    """What is known of one detection. ``inliers``: of ``matches``; ``reason``: why there is no pose, "" with one."""

    photo: Image
    bbox_xyxy: tuple[float, float, float, float]
    drawn: Sequence[DrawnPose]
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
    rows.append(_titled(_outcome(card), _in_photo(card)))
    if card.reason:
        rows.append(_written(card.reason))
    gap = np.full((GAP_PX, rows[0].shape[1], 3), PAPER, dtype=np.uint8)
    return np.concatenate([part for row in rows for part in (row, gap)][:-1])


def pick_cases(relative_mssd: Sequence[float | None], *, count: int, obj_ids: Sequence[int] = ()) -> list[int]:
    """Which answers to show: the best half, then the worst, each in that order; None (no pose, no truth) is worst.

    With ``obj_ids``, the object of each answer, objects take turns within a half: first the best of every object, then
    the second best. Where no answer has an error, the first ones.
    """
    if all(error is None for error in relative_mssd):
        return list(range(min(count, len(relative_mssd))))
    order = sorted(range(len(relative_mssd)), key=lambda i: (_as_error(relative_mssd[i]), i))
    if len(order) <= count:
        return order
    half = (count + 1) // 2
    best = sorted(_in_turn(order, obj_ids)[:half], key=order.index)
    left = [i for i in reversed(order) if i not in best]
    return best + sorted(_in_turn(left, obj_ids)[: count - half], key=left.index)


def _in_turn(order: Sequence[int], obj_ids: Sequence[int]) -> list[int]:
    """The order with the first of every object first, then the second of every object, and so on."""
    if not obj_ids:
        return list(order)
    seen: Counter[int] = Counter()
    turn = {}
    for index in order:
        turn[index] = seen[obj_ids[index]]
        seen[obj_ids[index]] += 1
    return sorted(order, key=lambda i: turn[i])


def _as_error(value: float | None) -> float:
    return np.inf if value is None else value


def paint_clusters(clusters: Clusters, query_rgb: Picture, template_rgb: Picture) -> tuple[Picture, Picture]:
    """Both crops with their cells in the colour of their cluster pair; cells of clusters without a partner are grey.

    A pair's colour says where in the template it lies: light above and dark below, blue on the left and yellow to red
    on the right. Where both pictures show the same layout of colours, the clusters agree. Darker lines part clusters.
    """
    template_label = clusters.template_label.cpu().numpy()
    colours = _pair_colours(template_label, clusters.pairs.cpu().numpy())
    query_label = clusters.query_label.cpu().numpy()
    query_of = {int(q): c for (q, _), c in zip(clusters.pairs.tolist(), colours, strict=True)}
    template_of = {int(t): c for (_, t), c in zip(clusters.pairs.tolist(), colours, strict=True)}
    return _painted(query_rgb, query_label, query_of), _painted(template_rgb, template_label, template_of)


def _pair_colours(label: Int[np.ndarray, "h w"], pairs: Int[np.ndarray, "p 2"]) -> list[Colour]:
    """Of each pair, by where its template cluster's middle lies within the box of all of the template's cells."""
    cells = np.argwhere(label >= 0)
    low, extent = (cells.min(axis=0), np.maximum(np.ptp(cells, axis=0), 1)) if len(cells) else (np.zeros(2), np.ones(2))
    colours = []
    for _, template in pairs:
        mine = np.argwhere(label == template)
        y, x = 2 * (mine.mean(axis=0) - low) / extent if len(mine) else (1.0, 1.0)
        column, row = (np.full((1, 1), value, dtype=np.float32) for value in (x, y))
        r, g, b = (round(part) for part in cv2.remap(_PALETTE, column, row, cv2.INTER_LINEAR)[0, 0].tolist())
        colours.append((r, g, b))
    return colours


def _painted(rgb: Picture, label: Int[np.ndarray, "h w"], colour_of: Mapping[int, Colour]) -> Picture:
    ink = np.zeros((*label.shape, 3), dtype=np.uint8)
    for cluster in np.unique(label[label >= 0]):
        ink[label == cluster] = colour_of.get(int(cluster), ALONE)
    of_px = np.arange(PANEL_PX) * len(label) // PANEL_PX
    paired = np.where(np.isin(label, list(colour_of)), label, -1)[np.ix_(of_px, of_px)]
    border = (paired != np.roll(paired, 1, axis=0)) | (paired != np.roll(paired, 1, axis=1))
    under = _panel(rgb)
    shade = cv2.cvtColor(cv2.cvtColor(under, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB)
    blend = 0.9 * ink[np.ix_(of_px, of_px)] + 0.1 * shade
    blend = np.where(border[..., None], 0.78 * blend, blend).astype(np.uint8)
    return np.where(label[np.ix_(of_px, of_px)][..., None] >= 0, blend, under // 3)


def _lines(
    query_rgb: Picture, template_rgb: Picture, matches: Correspondences, inliers: Bool[np.ndarray, " m"] | None
) -> tuple[str, Picture]:
    """A title, and the two crops, dimmed, with some of the correspondences: inliers over outliers.

    Ends of inliers are discs, of outliers rings; without a pose nothing is known of either, and all are light grey.
    """
    canvas = _beside(_panel(query_rgb) // 2, _panel(template_rgb) // 2)
    scale = PANEL_PX / len(query_rgb)
    query = (matches.query_px.cpu().numpy() + 0.5) * scale - 0.5
    template = (matches.template_px.cpu().numpy() + 0.5) * scale - 0.5 + [PANEL_PX + GAP_PX, 0]
    good = np.zeros(len(query), dtype=bool) if inliers is None else inliers
    shown = evenly(len(query), LINES_SHOWN)
    for index in sorted(shown, key=lambda i: bool(good[i])):
        colour = UNTOLD if inliers is None else INLIER if good[index] else OUTLIER
        a, b = ((round(16 * float(px[index][0])), round(16 * float(px[index][1]))) for px in (query, template))
        cv2.line(canvas, a, b, colour, 1, cv2.LINE_AA, 4)
        filled = -1 if inliers is None or good[index] else 1  # outliers end in rings
        for end in (a, b):
            cv2.circle(canvas, end, 2 * 16 + 8, colour, filled, cv2.LINE_AA, 4)
    told = "" if len(shown) == len(query) else f", {len(shown)} shown"
    if inliers is None:
        return f"{len(query)} correspondences{told}", canvas
    return f"{int(good.sum())} inliers (green) of {len(query)} correspondences{told}", canvas


def evenly(count: int, most: int) -> list[int]:
    """At most ``most`` indices below ``count``, evenly spread."""
    return sorted({int(i) for i in np.linspace(0, count - 1, min(count, most))}) if count else []


def _outcome(card: Card) -> str:
    """The photograph's title: what is drawn, in the words of the overlays' legend."""
    drawn = {item.role for item in card.drawn}
    words = [word for role, word in _ROLE_WORDS.items() if role in drawn]
    return ": ".join(["no pose" if card.reason else "pose", *([", ".join(words)] if words else [])])


def _in_photo(card: Card) -> Picture:
    """The photograph around the detection, twice as wide as high, with the poses drawn."""
    width, height = 2 * PANEL_PX + GAP_PX, PANEL_PX
    x0, y0, x1, y1 = card.bbox_xyxy
    h = int(np.ceil(max(y1 - y0, (x1 - x0) * height / width, 8.0) * (1 + 2 * _MARGIN)))
    w = int(np.ceil(h * width / height))
    rows, columns = card.photo.rgb.shape[:2]
    left, top = _inside((x0 + x1 - w) / 2, w, columns), _inside((y0 + y1 - h) / 2, h, rows)
    window = _window(card.photo.rgb, left, top, w, h)
    shift = np.array([[1.0, 0, -left], [0, 1, -top], [0, 0, 1]])
    shown = Image(card.photo.scene_id, card.photo.im_id, window, shift @ card.photo.K)
    return cv2.resize(draw_overlay(shown, card.drawn, legend=False), (width, height), interpolation=cv2.INTER_AREA)


def _inside(start: float, length: int, whole: int) -> int:
    """Where a stretch starts that is moved inside 0 .. ``whole``; one that does not fit is centred."""
    return (whole - length) // 2 if length > whole else min(max(round(start), 0), whole - length)


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
    PIL.ImageDraw.Draw(strip).text((1, 2), title, fill=INK, font=PIL.ImageFont.load_default(16))
    return np.concatenate([np.asarray(strip), picture])


def _beside(left: Picture, right: Picture) -> Picture:
    gap = np.full((len(left), GAP_PX, 3), PAPER, dtype=np.uint8)
    return np.concatenate([left, gap, right], axis=1)


def _written(text: str) -> Picture:
    lines = textwrap.wrap(text, 58)
    strip = PIL.Image.new("RGB", (2 * PANEL_PX + GAP_PX, 20 * len(lines) + 6), PAPER)
    draw = PIL.ImageDraw.Draw(strip)
    for row, line in enumerate(lines):
        draw.text((1, 2 + 20 * row), line, fill=INK, font=PIL.ImageFont.load_default(16))
    return np.asarray(strip)
