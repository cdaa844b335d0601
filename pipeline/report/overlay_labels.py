"""Labels and legend of an overlay."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
import PIL.Image
import PIL.ImageDraw
import PIL.ImageFont
from jaxtyping import UInt8

Role = Literal["truth", "correct", "wrong", "unchecked"]
Colour = tuple[int, int, int]
Box = tuple[float, float, float, float]
"""left, top, right, bottom, px"""

ROLE_COLOURS: dict[Role, Colour] = {
    "truth": (50, 130, 255),
    "correct": (50, 215, 90),
    "wrong": (245, 60, 50),
    "unchecked": (255, 190, 30),
}
INK = (20, 20, 20)
_LEGEND: dict[Role, str] = {
    "truth": "ground truth",
    "correct": "estimate, correct",
    "wrong": "estimate, wrong",
    "unchecked": "estimate",
}
_LEGEND_INK = (240, 240, 240)
_PADDING_PX = 4

_Font = PIL.ImageFont.ImageFont | PIL.ImageFont.FreeTypeFont


def write_labels(
    canvas: UInt8[np.ndarray, "H W 3"],
    labels: Sequence[tuple[str, tuple[float, float], Role]],
    roles: Sequence[Role],
    note: str = "",
) -> UInt8[np.ndarray, "H W 3"]:
    """The canvas with labels, with a legend of ``roles`` at the lower left, and with a note at the lower right.

    ``labels``: text, the point (px) above which it is written, and role.
    """
    picture = PIL.Image.fromarray(canvas)
    draw = PIL.ImageDraw.Draw(picture)
    size = max(11, round(max(canvas.shape[:2]) / 75))
    font = PIL.ImageFont.load_default(size)
    taken: list[Box] = []
    for text, (x, y), role in labels:
        taken.append(_draw_label(draw, font, text, (x, y - 1.6 * size), role, taken))
    if roles:
        _draw_legend(draw, font, size, roles)
    if note:
        _draw_note(draw, font, size, note)
    return np.asarray(picture).copy()


def _draw_label(
    draw: PIL.ImageDraw.ImageDraw,
    font: _Font,
    text: str,
    position: tuple[float, float],
    role: Role,
    taken: Sequence[Box],
) -> Box:
    """Write a label inside the picture, moved below the labels it would overlap; returns its box."""
    pad = _PADDING_PX
    _, _, w, h = draw.textbbox((0, 0), text, font=font)
    w, h = float(w + 2 * pad), float(h + 2 * pad)
    x = min(max(position[0], 0.0), max(draw.im.size[0] - w, 0.0))
    y = min(max(position[1], 0.0), max(draw.im.size[1] - h, 0.0))
    for left, top, right, bottom in sorted(taken, key=lambda box: box[1]):
        if left < x + w and x < right and top < y + h and y < bottom:
            y = bottom + 1
    draw.rounded_rectangle((x, y, x + w, y + h), radius=4, fill=ROLE_COLOURS[role])
    draw.text((x + pad, y + pad), text, fill=INK, font=font)
    return x, y, x + w, y + h


def _draw_legend(draw: PIL.ImageDraw.ImageDraw, font: _Font, size: int, roles: Sequence[Role]) -> None:
    line, pad = 1.5 * size, 0.6 * size
    width = max(draw.textlength(_LEGEND[role], font=font) for role in roles) + 2.2 * size + 2 * pad
    top = draw.im.size[1] - len(roles) * line - 1.5 * pad
    draw.rectangle((0, top, width, draw.im.size[1]), fill=INK)
    for index, role in enumerate(roles):
        y = top + pad + index * line
        draw.rectangle((pad, y + 0.45 * size, pad + 1.6 * size, y + 0.7 * size), fill=ROLE_COLOURS[role])
        draw.text((pad + 2.2 * size, y), _LEGEND[role], fill=_LEGEND_INK, font=font)


def _draw_note(draw: PIL.ImageDraw.ImageDraw, font: _Font, size: int, note: str) -> None:
    (w, h), pad = draw.im.size, 0.6 * size
    left, top = w - draw.textlength(note, font=font) - 2 * pad, h - 1.5 * size - pad
    draw.rectangle((left, top, w, h), fill=INK)
    draw.text((left + pad, top + pad / 2), note, fill=_LEGEND_INK, font=font)
