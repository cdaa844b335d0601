"""A table of texts with its export to CSV and LaTeX."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from typing import Literal

NOT_AVAILABLE = "n/a"


@dataclass(frozen=True)
class Table:
    """Texts under column headings. ``source`` "both": the headings say which are published. ``name``: of its files."""

    name: str
    caption: str
    source: Literal["measured", "published", "both"]
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    def csv(self) -> str:
        """Comma-separated values, with the source in every row."""
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(["source", *self.head])
        writer.writerows([self.source, *row] for row in self.rows)
        return stream.getvalue()

    def latex(self) -> str:
        """A LaTeX table environment that needs no package."""
        lines = [" & ".join(map(_escape_latex, row)) + r" \\" for row in (self.head, *self.rows)]
        columns = "l" + "r" * (len(self.head) - 1)
        body = "\n".join([lines[0], r"\hline", *lines[1:]])
        caption = _escape_latex(f"{self.caption} ({self.source})")
        return (
            f"\\begin{{table}}\n\\centering\n\\begin{{tabular}}{{{columns}}}\n{body}\n\\end{{tabular}}\n"
            f"\\caption{{{caption}}}\n\\end{{table}}\n"
        )


def _escape_latex(text: str) -> str:
    special = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
    return "".join(special.get(c, f"\\{c}" if c in "&%$#_{}" else c) for c in text)
