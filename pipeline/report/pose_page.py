"""The poses of one photograph -> one self-contained HTML page of at most 1.5 MB."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import jinja2
import numpy as np
import PIL.Image
from jaxtyping import Float, UInt8

from pipeline.items.poses import Alternative

Picture = UInt8[np.ndarray, "_H _W 3"]

MAX_BYTES = 1_500_000
MAX_ALTERNATIVES = 3  # shown per pose; pose.json has all
_SIZES = ((1280, 85), (1100, 80), (900, 75), (720, 70), (540, 60))
"""Longer side (px) and JPEG quality of photograph and overlay; the first pair that keeps the page small is used."""
_CARD_QUALITY = 75


@dataclass(frozen=True, eq=False)
class ShownPose:
    """One result on the page: its summary, its matrix if there is a pose, and a figure of how it was found (``card``).

    ``alternatives``: best first.
    """

    name: str
    text: str
    T_cam_obj: Float[np.ndarray, "4 4"] | None
    card: Picture | None = None
    alternatives: Sequence[Alternative] = ()


@dataclass(frozen=True, eq=False)
class PosePage:
    """Content of the page. ``scene``: an HTML page with the 3D view, or "". ``note``: as Dataset.image_note."""

    title: str
    photograph: Picture
    overlay: Picture
    poses: Sequence[ShownPose]
    warnings: Sequence[str] = ()
    scene: str = ""
    note: str = field(default="")

    def html(self) -> str:
        """The page, with the largest photograph that keeps it within ``MAX_BYTES``, if any does."""
        cards = [
            {"name": pose.name, "data": _data_url(pose.card, max(pose.card.shape), _CARD_QUALITY)}
            for pose in self.poses
            if pose.card is not None
        ]
        page = ""
        for longer_px, quality in _SIZES:
            pictures = {
                "photograph": _data_url(self.photograph, longer_px, quality),
                "overlay": _data_url(self.overlay, longer_px, quality),
            }
            page = self._render(cards=cards, **pictures)
            if len(page.encode()) <= MAX_BYTES:
                break
        return page

    def _render(self, **pictures: object) -> str:
        environment = jinja2.Environment(autoescape=True, trim_blocks=True, undefined=jinja2.StrictUndefined)
        template = environment.from_string((Path(__file__).parent / "pose_page.html.j2").read_text())
        return template.render(
            title=self.title,
            summaries=[{"text": pose.text, "found": pose.T_cam_obj is not None} for pose in self.poses],
            warnings=self.warnings,
            note=self.note,
            poses=[
                {
                    "name": pose.name,
                    "matrix": _matrix_text(pose.T_cam_obj),
                    "others": [_describe(other) for other in pose.alternatives[:MAX_ALTERNATIVES]],
                }
                for pose in self.poses
                if pose.T_cam_obj is not None
            ],
            scene=self.scene.replace("</script", "<\\/script"),
            **pictures,
        )


def _describe(other: Alternative) -> dict[str, str]:
    weight = "" if other.weight is None else f", probability {other.weight:.2f}"
    how = f"{other.support:.0%} as well explained{weight}"
    return {"how": how, "matrix": _matrix_text(other.T_cam_obj)}


def _matrix_text(T: Float[np.ndarray, "4 4"]) -> str:
    return "\n".join(" ".join(f"{value:9.4f}" for value in row[:3]) + f" {row[3]:10.2f}" for row in T)


def _data_url(picture: Picture, longer_px: int, quality: int) -> str:
    scale = longer_px / max(picture.shape[:2])
    if scale < 1:
        size = round(picture.shape[1] * scale), round(picture.shape[0] * scale)
        picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA))
    stream = io.BytesIO()
    PIL.Image.fromarray(picture).save(stream, "JPEG", quality=quality, optimize=True)
    return f"data:image/jpeg;base64,{base64.b64encode(stream.getvalue()).decode()}"
