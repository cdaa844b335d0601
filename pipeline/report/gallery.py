"""Crops, clusters, correspondences, pose -> a card that shows how a pose was found, and the choice of cases to show."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool

from pipeline.items.features import Clusters
from pipeline.items.matches import Correspondences
from pipeline.items.views import Image
from pipeline.report.cluster_colours import paint_clusters
from pipeline.report.overlay import DrawnPose, Role, draw_overlay
from pipeline.report.panels import (
    CARD_WIDTH_PX,
    GAP_PX,
    PANEL_PX,
    Picture,
    add_title,
    draw_text,
    join_horizontally,
    join_vertically,
    resize_to_panel,
)

MAX_LINES = 60
INLIER, OUTLIER, UNDECIDED = (80, 220, 190), (255, 90, 30), (200, 205, 210)  # distinct for colour-blind people too
_ROLE_WORDS: dict[Role, str] = {
    "truth": "truth blue",
    "correct": "estimate green (correct)",
    "wrong": "estimate red (wrong)",
    "unchecked": "estimate amber",
}
_MARGIN = 0.3  # of the box's sides, shown around it in the photograph
_SUBPIXEL_BITS = 4


@dataclass(frozen=True, eq=False)
class Card:
    """One detection as far as it got: fields of steps that were not reached are None.

    ``inliers``: which of ``matches`` the pose explains. ``reason``: why there is no pose; "" if there is one.
    """

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
    """Crops, matched clusters, correspondences, and the pose in the photograph, from top to bottom.

    Steps that were not reached are left out; without a pose, the reason is written below the photograph.
    """
    rows = [join_horizontally(add_title("query", card.query_rgb), add_title("matched template", card.template_rgb))]
    if card.clusters is not None and card.template_rgb is not None:
        query, template = paint_clusters(card.clusters, card.query_rgb, card.template_rgb)
        title = f"{len(card.clusters.pairs)} matched clusters"
        rows.append(join_horizontally(add_title(title, query), add_title("the same in the template", template)))
    if card.matches is not None and card.template_rgb is not None:
        rows.append(_draw_matches(card.query_rgb, card.template_rgb, card.matches, card.inliers))
    rows.append(add_title(_pose_title(card), _draw_photo(card)))
    if card.reason:
        rows.append(draw_text(card.reason))
    return join_vertically(rows)


def pick_cases(relative_mssd: Sequence[float | None], *, count: int, obj_ids: Sequence[int] = ()) -> list[int]:
    """Indices of the answers to show: the best half, best first, then the worst half, worst first.

    None (no pose, or no ground truth) counts as worst. With ``obj_ids``, the object of each answer, objects take turns
    within a half: the best of every object, then the second best. If no answer has an error, the first ones are shown.
    """
    if all(error is None for error in relative_mssd):
        return list(range(min(count, len(relative_mssd))))
    errors = [np.inf if error is None else error for error in relative_mssd]
    order = sorted(range(len(errors)), key=lambda i: (errors[i], i))
    if len(order) <= count:
        return order
    half = (count + 1) // 2
    best = sorted(_take_turns(order, obj_ids)[:half], key=order.index)
    left = [i for i in reversed(order) if i not in best]
    return best + sorted(_take_turns(left, obj_ids)[: count - half], key=left.index)


def _take_turns(order: Sequence[int], obj_ids: Sequence[int]) -> list[int]:
    """The order with the first answer of every object first, then the second of every object, and so on."""
    if not obj_ids:
        return list(order)
    seen: Counter[int] = Counter()
    turn = {}
    for index in order:
        turn[index] = seen[obj_ids[index]]
        seen[obj_ids[index]] += 1
    return sorted(order, key=lambda i: turn[i])


def _draw_matches(
    query_rgb: Picture, template_rgb: Picture, matches: Correspondences, inliers: Bool[np.ndarray, " m"] | None
) -> Picture:
    """Both crops, dimmed, with lines for some correspondences, inliers on top.

    Inliers end in discs, outliers in rings. Without a pose neither is known, and all lines are light grey.
    """
    canvas = join_horizontally(resize_to_panel(query_rgb) // 2, resize_to_panel(template_rgb) // 2)
    scale = PANEL_PX / len(query_rgb)
    query = (matches.query_px.cpu().numpy() + 0.5) * scale - 0.5
    template = (matches.template_px.cpu().numpy() + 0.5) * scale - 0.5 + [PANEL_PX + GAP_PX, 0]
    is_inlier = np.zeros(len(query), dtype=bool) if inliers is None else inliers
    shown = pick_evenly(len(query), MAX_LINES)
    one_px = 2**_SUBPIXEL_BITS
    for index in sorted(shown, key=lambda i: bool(is_inlier[i])):
        colour = UNDECIDED if inliers is None else INLIER if is_inlier[index] else OUTLIER
        a, b = ((round(one_px * float(px[index][0])), round(one_px * float(px[index][1]))) for px in (query, template))
        cv2.line(canvas, a, b, colour, 1, cv2.LINE_AA, _SUBPIXEL_BITS)
        filled = -1 if inliers is None or is_inlier[index] else 1
        for end in (a, b):
            cv2.circle(canvas, end, 5 * one_px // 2, colour, filled, cv2.LINE_AA, _SUBPIXEL_BITS)
    title = f"{len(query)} correspondences"
    if inliers is not None:
        title = f"{int(is_inlier.sum())} inliers (green) of {title}"
    return add_title(title if len(shown) == len(query) else f"{title}, {len(shown)} shown", canvas)


def pick_evenly(count: int, limit: int) -> list[int]:
    """At most ``limit`` indices below ``count``, evenly spread."""
    return sorted({int(i) for i in np.linspace(0, count - 1, min(count, limit))}) if count else []


def _pose_title(card: Card) -> str:
    """What is drawn into the photograph, in the words of the overlays' legend."""
    drawn = {item.role for item in card.drawn}
    words = [word for role, word in _ROLE_WORDS.items() if role in drawn]
    return ": ".join(["no pose" if card.reason else "pose", *([", ".join(words)] if words else [])])


def _draw_photo(card: Card) -> Picture:
    """The photograph around the detection, as wide as a card and one panel high, with the poses drawn."""
    width, height = CARD_WIDTH_PX, PANEL_PX
    x0, y0, x1, y1 = card.bbox_xyxy
    h = int(np.ceil(max(y1 - y0, (x1 - x0) * height / width, 8.0) * (1 + 2 * _MARGIN)))
    w = int(np.ceil(h * width / height))
    rows, columns = card.photo.rgb.shape[:2]
    left, top = _shift_inside((x0 + x1 - w) / 2, w, columns), _shift_inside((y0 + y1 - h) / 2, h, rows)
    window = _cut_window(card.photo.rgb, left, top, w, h)
    shift = np.array([[1.0, 0, -left], [0, 1, -top], [0, 0, 1]])
    shown = Image(card.photo.scene_id, card.photo.im_id, window, shift @ card.photo.K)
    return cv2.resize(draw_overlay(shown, card.drawn, legend=False), (width, height), interpolation=cv2.INTER_AREA)


def _shift_inside(start: float, length: int, total: int) -> int:
    """Start of an interval moved inside 0 .. ``total``; an interval longer than that is centred."""
    return (total - length) // 2 if length > total else min(max(round(start), 0), total - length)


def _cut_window(rgb: Picture, left: int, top: int, w: int, h: int) -> Picture:
    """A window of a photograph, black beyond its border."""
    out = np.zeros((h, w, 3), dtype=np.uint8)
    rows, columns = slice(max(top, 0), min(top + h, len(rgb))), slice(max(left, 0), min(left + w, rgb.shape[1]))
    if rows.start < rows.stop and columns.start < columns.stop:
        out[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left] = rgb[rows, columns]
    return out
