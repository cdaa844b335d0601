"""Style, canvases and SVG export shared by the report's figures."""

from __future__ import annotations

import io
import logging
import re
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure as Canvas

from pipeline.metrics.bootstrap import Interval

logging.getLogger("fontTools").setLevel(logging.WARNING)  # it logs every glyph of a PDF

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#999933")
GREY = "#8a8f98"
METRIC_COLOURS = {"vsd": COLOURS[0], "mssd": COLOURS[1], "mspd": COLOURS[2]}
SIZE = (4.6, 3.1)  # inches
STYLE: Any = {
    "font.size": 9,
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "svg.fonttype": "none",
    "svg.hashsalt": "dzop",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#c3c7cd",
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#eceef1",
    "axes.labelcolor": "#40464f",
    "xtick.color": "#40464f",
    "ytick.color": "#40464f",
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "legend.frameon": False,
    "legend.fontsize": 8,
    "lines.linewidth": 1.6,
    "lines.markersize": 4.5,
    "pdf.fonttype": 42,
}


@dataclass(frozen=True, eq=False)
class Figure:
    """A drawn figure. ``name`` is used for files; ``caption`` is also the text for screen readers."""

    name: str
    caption: str
    canvas: Canvas

    def svg(self) -> str:
        """An SVG element that fills the width it is given. Equal figures give equal text."""
        stream = io.StringIO()
        with mpl.rc_context(STYLE):
            self.canvas.savefig(stream, format="svg", metadata={"Date": None, "Creator": None})
        text = stream.getvalue()
        text = re.sub(r'\s(width|height)="[\d.]+pt"', "", text[text.index("<svg") :], count=2)
        text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
        # group ids count from 1 in every figure and would clash on one page; nothing refers to them
        text = re.sub(r' id="[a-z_]+\d*_\d+"', "", text)
        return re.sub(r"\n\s*", "\n", text)

    def save(self, stem: str) -> None:
        """Write ``<stem>.png`` and ``<stem>.pdf``."""
        with mpl.rc_context(STYLE):
            self.canvas.savefig(f"{stem}.png", dpi=160)
            self.canvas.savefig(f"{stem}.pdf", metadata={"CreationDate": None})


def one_panel(*, height: float = SIZE[1]) -> tuple[Canvas, Axes]:
    """A canvas with one pair of axes."""
    canvas = Canvas(figsize=(SIZE[0], height), layout="constrained")
    FigureCanvasAgg(canvas)
    return canvas, canvas.subplots()


def two_panels() -> tuple[Canvas, tuple[Axes, Axes]]:
    """A canvas with measured results above published ones, sharing the x axis."""
    canvas = Canvas(figsize=(SIZE[0], SIZE[1] + 1.2), layout="constrained")
    FigureCanvasAgg(canvas)
    above, below = canvas.subplots(2, 1, sharex=True, height_ratios=(1.6, 1))
    return canvas, (above, below)


def add_legend(axes: Axes) -> None:
    """A legend, if anything has a label."""
    if axes.get_legend_handles_labels()[0]:
        axes.legend()


def wrap_name(name: str) -> str:
    """A run's name in at most three short lines, so that it fits beside the axes; tables show it in full."""
    lines = textwrap.wrap(name, 26)
    return "\n".join(lines if len(lines) <= 3 else [*lines[:2], f"{lines[2]} ..."])


def error_bars(intervals: Sequence[Interval]) -> np.ndarray:
    """Lengths of error bars below and above each mean, (2, n)."""
    return np.array([[max(i.mean - i.low, 0), max(i.high - i.mean, 0)] for i in intervals]).T
