"""Pictures of a run -> JPEGs inside the page, within a budget of bytes."""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass
from pathlib import Path

import PIL.Image

from pipeline.io.files import IMAGE_FORMATS
from pipeline.report.run_records import Case, RunRecord

MAX_BYTES = 9_000_000
"""Budget of all pictures together, so that the page stays below 15 MB."""
_CARD_PX = 486


@dataclass(frozen=True)
class GalleryPicture:
    """A picture of the gallery: a JPEG as a data URL, and its caption."""

    data: str
    text: str


@dataclass
class PictureEmbedder:
    """Embeds pictures until the budget is spent; ``skipped`` counts those that are missing or do not fit."""

    out: Path
    used_bytes: int = 0
    skipped: int = 0

    def pictures_of(self, run: RunRecord) -> list[GalleryPicture]:
        """The run's pictures, as far as they are there and fit."""
        pictures = []
        for case in run.cases:
            path = self.out / run.folder / case.file
            data = small_jpeg(path) if path.is_file() else b""
            if not data or self.used_bytes + len(data) > MAX_BYTES:
                self.skipped += 1
                continue
            self.used_bytes += len(data)
            pictures.append(GalleryPicture(f"data:image/jpeg;base64,{base64.b64encode(data).decode()}", _caption(case)))
        return pictures


def _caption(case: Case) -> str:
    error = "" if case.relative_mssd is None else f", MSSD {case.relative_mssd:.0%} of the diameter"
    return f"scene {case.scene_id}, image {case.im_id}, object {case.obj_id}: {case.text}{error}"


def small_jpeg(path: Path) -> bytes:
    """The picture at most as wide as a card, compressed; empty for a file that cannot be read."""
    try:
        with PIL.Image.open(path, formats=IMAGE_FORMATS) as opened:
            picture = opened.convert("RGB")
    except (OSError, SyntaxError, ValueError, PIL.Image.DecompressionBombError):
        return b""
    if picture.width > _CARD_PX:
        picture = picture.resize((_CARD_PX, round(picture.height * _CARD_PX / picture.width)))
    stream = io.BytesIO()
    picture.save(stream, "JPEG", quality=80, optimize=True)
    return stream.getvalue()
