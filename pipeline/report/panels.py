"""Panels, titles and text strips that the gallery's cards are put together from."""

from __future__ import annotations

import textwrap

import cv2
import numpy as np
import PIL.Image
import PIL.ImageDraw
import PIL.ImageFont
from jaxtyping import UInt8

PANEL_PX = 240
TITLE_PX = 24
GAP_PX = 6
CARD_WIDTH_PX = 2 * PANEL_PX + GAP_PX
BACKGROUND, TEXT = (255, 255, 255), (30, 34, 40)
_FONT_PX, _LINE_PX, _LINE_CHARACTERS = 16, 20, 58

Picture = UInt8[np.ndarray, "_H _W 3"]


def resize_to_panel(rgb: Picture) -> Picture:
    """The picture at the size of a panel."""
    return cv2.resize(rgb, (PANEL_PX, PANEL_PX), interpolation=cv2.INTER_CUBIC)


def add_title(title: str, picture: Picture | None) -> Picture:
    """A picture below its title; square ones are resized to a panel, a missing one is an empty panel."""
    if picture is None:
        picture = np.full((PANEL_PX, PANEL_PX, 3), 240, dtype=np.uint8)
    if picture.shape[0] == picture.shape[1]:
        picture = resize_to_panel(picture)
    strip = PIL.Image.new("RGB", (picture.shape[1], TITLE_PX), BACKGROUND)
    PIL.ImageDraw.Draw(strip).text((1, 2), title, fill=TEXT, font=PIL.ImageFont.load_default(_FONT_PX))
    return np.concatenate([np.asarray(strip), picture])


def join_horizontally(left: Picture, right: Picture) -> Picture:
    """Two pictures of one height with a gap between them."""
    gap = np.full((len(left), GAP_PX, 3), BACKGROUND, dtype=np.uint8)
    return np.concatenate([left, gap, right], axis=1)


def join_vertically(rows: list[Picture]) -> Picture:
    """Pictures of one width below one another, with gaps between them."""
    gap = np.full((GAP_PX, rows[0].shape[1], 3), BACKGROUND, dtype=np.uint8)
    return np.concatenate([part for row in rows for part in (row, gap)][:-1])


def draw_text(text: str) -> Picture:
    """Wrapped text as wide as a card."""
    lines = textwrap.wrap(text, _LINE_CHARACTERS)
    strip = PIL.Image.new("RGB", (CARD_WIDTH_PX, _LINE_PX * len(lines) + 6), BACKGROUND)
    draw = PIL.ImageDraw.Draw(strip)
    for index, line in enumerate(lines):
        draw.text((1, 2 + _LINE_PX * index), line, fill=TEXT, font=PIL.ImageFont.load_default(_FONT_PX))
    return np.asarray(strip)
