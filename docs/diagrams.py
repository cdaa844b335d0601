"""SVG diagrams of README.md and docs/: the route, the layers of the package, the frames. No dependency but Python."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from html import escape
from pathlib import Path

ROOT = Path(__file__).parents[1]
STYLE = """
.page { fill: #ffffff; stroke: #d0d7de; }
.stage { fill: #ddeafc; stroke: #4a7fc1; }
.layer { fill: #f3f6fa; stroke: #8c9bab; }
.focus { fill: #e4f4e4; stroke: #3f9142; }
.text { fill: #1f2328; }
.quiet { fill: #57606a; }
.line { stroke: #57606a; fill: none; }
.head { fill: #57606a; }
.x { stroke: #d1242f; fill: #d1242f; }
.y { stroke: #2da44e; fill: #2da44e; }
.z { stroke: #0969da; fill: #0969da; }
text { font-family: system-ui, -apple-system, "Segoe UI", Helvetica, Arial, sans-serif; stroke: none; }
a:hover .stage { stroke-width: 3; }
@media (prefers-color-scheme: dark) {
.page { fill: #151b23; stroke: #3d444d; }
.stage { fill: #1c3557; stroke: #6aa3ee; }
.layer { fill: #232b36; stroke: #6e7b8a; }
.focus { fill: #1d3a22; stroke: #5fbf66; }
.text { fill: #f0f6fc; }
.quiet { fill: #a8b3bf; }
.line { stroke: #a8b3bf; }
.head { fill: #a8b3bf; }
.x { stroke: #ff7b72; fill: #ff7b72; }
.y { stroke: #56d364; fill: #56d364; }
.z { stroke: #79b8ff; fill: #79b8ff; }
}
"""
FONT_PX = 15
STAGES = "../../pipeline/stages/"


@dataclass(frozen=True)
class Row:
    """Part of the route under one heading. Items in brackets are stages, drawn as boxes; the others are data."""

    heading: str
    items: str


ROUTE = (
    Row("once per object", "mesh [render] templates [crop] [extract] features [fit]"),
    Row("once per photograph", "photograph [detect] [crop] [extract] features"),
    Row(
        "per detection: match; then for each matched template",
        "features [match] template [fuse] [cluster] [correspond] matches [lift] [solve] pose",
    ),
    Row(
        "rerender: draw the best poses as new templates and match again from fuse",
        "poses [choose] best_poses [render] [crop] [extract] templates",
    ),
    Row("per detection", "poses [choose] [refine] pose"),
)


def svg(title: str, width: float, height: float, parts: Iterable[str]) -> str:
    """A document on a page of its own, which follows the reader's light or dark mode."""
    size = f'width="{width:g}" height="{height:g}" viewBox="0 0 {width:g} {height:g}"'
    page = f'<rect class="page" x="0.5" y="0.5" width="{width - 1:g}" height="{height - 1:g}" rx="8"/>'
    head = f'<svg xmlns="http://www.w3.org/2000/svg" {size} role="img">\n<title>{escape(title)}</title>'
    return "\n".join([head, f"<style>{STYLE}</style>", page, *parts, "</svg>\n"])


def text(x: float, y: float, content: str, *, kind: str = "text", anchor: str = "middle", size: int = FONT_PX) -> str:
    """A line of text; ``y`` is its baseline."""
    return (
        f'<text class="{kind}" x="{x:g}" y="{y:g}" text-anchor="{anchor}" font-size="{size}">{escape(content)}</text>'
    )


def box(x: float, y: float, w: float, h: float, *, kind: str) -> str:
    """A rounded rectangle."""
    return f'<rect class="{kind}" x="{x:g}" y="{y:g}" width="{w:g}" height="{h:g}" rx="6"/>'


def arrow(x0: float, y0: float, x1: float, y1: float, *, kind: str = "line", head: str = "head") -> str:
    """A straight arrow."""
    length = ((x1 - x0) ** 2 + (y1 - y0) ** 2) ** 0.5
    ux, uy = (x1 - x0) / length, (y1 - y0) / length
    tip = [(x1, y1), *((x1 - 8 * ux + s * 4 * uy, y1 - 8 * uy - s * 4 * ux) for s in (1, -1))]
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in tip)
    line = f'<path class="{kind}" stroke-width="1.8" d="M{x0:.1f} {y0:.1f}L{x1 - 6 * ux:.1f} {y1 - 6 * uy:.1f}"/>'
    return f'{line}<polygon class="{head}" points="{points}"/>'


def text_width(content: str) -> float:
    """An estimate of a line's width at FONT_PX: letters of a sans-serif font are narrow, wide or between."""
    return FONT_PX * sum(0.36 if c in " fijlrt" else 0.95 if c in "mw" else 0.62 for c in content)


def draw_route(*, width: int) -> str:
    """The stages of route.py in the order in which data passes them; each box links to its folder."""
    parts: list[str] = []
    y = 16.0
    for row in ROUTE:
        lines = wrap(row.heading, width - 32)
        for line in lines:
            y += 18
            parts.append(text(16, y, line, kind="quiet", anchor="start", size=14))
        y = _draw_items(parts, row.items.split(), width, y + 10) + 12
    return svg("The route from mesh and photograph to pose", width, y, parts)


def _draw_items(parts: list[str], items: Sequence[str], width: int, top: float) -> float:
    """Append items from left to right, wrapped; returns the bottom."""
    gap, height = 24.0, 34.0
    x, y = 16.0, top
    for index, item in enumerate(items):
        name = item.strip("[]").replace("_", " ")
        is_stage = item.startswith("[")
        w = text_width(name) + (18 if is_stage else 6)
        if index and x + gap + w > width - 12:
            x, y = 16.0, y + height + 10
        if index:
            parts.append(arrow(x + 3, y + height / 2, x + gap - 3, y + height / 2))
            x += gap
        label = text(x + w / 2, y + height / 2 + 5, name)
        parts.append(_link(name, box(x, y, w, height, kind="stage") + label) if is_stage else label)
        x += w
    return y + height


def _link(stage: str, content: str) -> str:
    return f'<a href="{STAGES}{target(stage)}">{content}</a>'


def target(stage: str) -> str:
    """Where a stage's source lies, from the folder of the stages."""
    if stage == "fit":
        return "../fits"
    return f"{stage}.py" if (ROOT / "pipeline" / "stages" / f"{stage}.py").exists() else stage


def wrap(content: str, width: float) -> list[str]:
    """Words in lines of at most ``width`` pixels."""
    lines = [""]
    for word in content.split():
        longer = f"{lines[-1]} {word}".strip()
        if text_width(longer) > width:
            lines.append(word)
        else:
            lines[-1] = longer
    return lines


def draw_layers() -> str:
    """The layers of the package as pyproject.toml states them: each may import from those below."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    layers = next(contract["layers"] for contract in contracts if contract["type"] == "layers")
    width, height, y = 640, 34, 44
    parts = [
        text(16, 28, "every layer imports from those below it, never from those above", kind="quiet", anchor="start")
    ]
    for layer in layers:
        names = [name.strip().removeprefix("pipeline.") for name in layer.split("|")]
        w = (width - 32 - 8 * (len(names) - 1)) / len(names)
        for index, name in enumerate(names):
            x = 16 + index * (w + 8)
            parts.append(box(x, y, w, height, kind="focus" if name == "route" else "layer"))
            parts.append(text(x + w / 2, y + 22, name))
        y += height + 6
    return svg("Layers of the package", width, y + 10, parts)


def draw_frames() -> str:
    """The frames and planes, and the maps between them."""
    parts: list[str] = []
    _draw_axes(parts, 80, 62, "obj")
    parts.append(text(160, 58, "object frame, mm:", kind="quiet", anchor="start", size=14))
    parts.append(text(160, 76, "as in the mesh file", kind="quiet", anchor="start", size=14))
    parts.append(arrow(80, 126, 80, 172))
    parts.append(text(94, 149, "T_cam_obj", anchor="start"))
    _draw_axes(parts, 80, 220, "cam")
    parts.append(text(160, 250, "camera frame, mm:", kind="quiet", anchor="start", size=14))
    parts.append(text(160, 268, "x right, y down,", kind="quiet", anchor="start", size=14))
    parts.append(text(160, 286, "z forward", kind="quiet", anchor="start", size=14))
    parts.append(arrow(150, 220, 322, 220))
    parts.append(text(240, 212, "K"))
    parts += _image(330, 162) + _crop(330, 330)
    parts.append(arrow(422, 256, 422, 326))
    parts.append(text(434, 312, "A_crop_img", anchor="start"))
    parts.append(text(24, 356, "p_cam = T_cam_obj @ p_obj", anchor="start"))
    parts.append(text(24, 384, "K_crop = A_crop_img @ K", anchor="start"))
    parts.append(text(24, 424, "cell (i, j) of a map with stride s", kind="quiet", anchor="start", size=14))
    parts.append(text(24, 442, "is centred at crop pixel", kind="quiet", anchor="start", size=14))
    parts.append(text(24, 460, "((j + 0.5) s - 0.5, (i + 0.5) s - 0.5)", kind="quiet", anchor="start", size=14))
    return svg("Frames and planes", 640, 480, parts)


def _draw_axes(parts: list[str], x: float, y: float, name: str) -> None:
    for dx, dy, kind in ((48, 0, "x"), (0, 40, "y"), (26, -26, "z")):
        parts.append(arrow(x, y, x + dx, y + dy, kind=kind, head=kind))
        parts.append(text(x + dx * 1.22, y + dy * 1.22 + 5, kind, size=14))
    parts.append(text(x - 30, y - 8, name))


def _image(x: float, y: float) -> list[str]:
    """The photograph, with an object and the square around it that is cropped."""
    blob = f'<ellipse class="focus" cx="{x + 92}" cy="{y + 60}" rx="26" ry="20"/>'
    square = f'<rect class="line" x="{x + 58}" y="{y + 26}" width="68" height="68" stroke-dasharray="4 3"/>'
    notes = [
        text(x, y - 28, "img: the photograph, pixels (x, y);", kind="quiet", anchor="start", size=14),
        text(x, y - 10, "pixel centres are integers", kind="quiet", anchor="start", size=14),
    ]
    return [box(x, y, 160, 116, kind="layer"), blob, square, *notes]


def _crop(x: float, y: float) -> list[str]:
    """The crop, with the cells of a feature map over it."""
    blob = f'<ellipse class="focus" cx="{x + 64}" cy="{y + 64}" rx="50" ry="38"/>'
    grid = "".join(f"M{x + s} {y}v128M{x} {y + s}h128" for s in range(16, 128, 16))
    notes = [
        text(x + 140, y + 60, "crop: 128 x 128 px", kind="quiet", anchor="start", size=14),
        text(x + 140, y + 78, "cells of a feature map", kind="quiet", anchor="start", size=14),
    ]
    return [box(x, y, 128, 128, kind="layer"), blob, f'<path class="line" stroke-width="0.7" d="{grid}"/>', *notes]


DIAGRAMS: dict[str, Callable[[], str]] = {
    "route.svg": partial(draw_route, width=900),
    "route_narrow.svg": partial(draw_route, width=400),
    "layers.svg": draw_layers,
    "frames.svg": draw_frames,
}
"""By file name."""
