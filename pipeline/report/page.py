"""rows of many runs -> one HTML page that needs nothing else, figures as PNG and PDF, tables as CSV and LaTeX."""

from __future__ import annotations

import base64
import io
import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path

import jinja2
import PIL.Image
from markupsafe import Markup, escape

from pipeline.io.files import write_atomic
from pipeline.items.scores import Scores
from pipeline.report import figures, tables
from pipeline.report.families import Family, base_of, families, is_oracle, scored_by
from pipeline.report.figures import Figure, ar_interval, ar_name
from pipeline.report.run_records import RunRecord, unresolved_failures
from pipeline.report.tables import Table, run_name

FOLDER = "report"
PICTURES_BYTES = 9_000_000
"""Pictures are embedded until they take as much; the page stays below 15 MB."""
_CARD_PX = 486
_METHODS_SHOWN = 6
_TIMES_SHOWN = 12


@dataclass(frozen=True)
class Report:
    """Where a report lies, and what it says in short."""

    page: Path
    summary: str


@dataclass(frozen=True)
class Shown:
    """A picture of the gallery: JPEG as a data address, and its caption."""

    data: str
    text: str


@dataclass(eq=False)
class Section:
    """Everything about the runs on one set of targets; nothing is compared across sections."""

    jobs: Sequence[RunRecord]
    title: str

    @cached_property
    def rows(self) -> list[RunRecord]:
        """One of the jobs that gave the same scores, such as those that differ in theta_max alone."""
        kept: dict[tuple[str, str, str], RunRecord] = {}
        for row in sorted(self.jobs, key=lambda row: (not row.cases, bool(row.sweep))):
            kept.setdefault((row.run, row.config.get("variation", "none"), str(scored_by(row))), row)
        return [row for row in self.jobs if row in kept.values()]

    @cached_property
    def base(self) -> RunRecord:
        """The run that the others are held against."""
        return base_of(self.rows)

    @cached_property
    def comparable(self) -> list[RunRecord]:
        """The runs whose recall means the same as the base run's: all with VSD, or all without, on the same meshes."""
        without, how = _scored(self.base).vsd is None, scored_by(self.base)
        return [row for row in self.rows if (_scored(row).vsd is None) == without and scored_by(row) == how]

    @cached_property
    def best(self) -> RunRecord:
        """The run with the highest recall; oracles, which see the truth, are no candidates."""
        honest = [row for row in self.comparable if not is_oracle(row)] or [self.base]
        return max(honest, key=lambda row: ar_interval(_scored(row)).mean)

    @cached_property
    def dataset(self) -> str:
        """The dataset's name."""
        return self.base.dataset.name if self.base.dataset else ""

    @property
    def anchor(self) -> str:
        """Where the page's contents lead to."""
        return f"d-{self.base.dataset.key[:8]}" if self.base.dataset else "d"

    @property
    def metric(self) -> str:
        """What the recall that runs are ordered by is called."""
        return ar_name(_scored(self.base))

    @property
    def no_vsd(self) -> str:
        """Why VSD is not available."""
        return _scored(self.base).no_vsd

    @property
    def notices(self) -> list[str]:
        """What must be known of the features behind the numbers."""
        return list(dict.fromkeys(f"{row.method}: {row.notice}" for row in self.rows if row.notice))

    @cached_property
    def methods(self) -> list[tuple[str, RunRecord]]:
        """One run of each method, the base run's first, of each the one nearest to it."""
        chosen = {self.base.method: self.base}
        for row in sorted(self.comparable, key=lambda row: len(run_name(row, self.base))):
            if not is_oracle(row):
                chosen.setdefault(row.method, row)
        return list(chosen.items())[:_METHODS_SHOWN]

    @cached_property
    def families(self) -> list[Family]:
        """The ablations."""
        return families(self.comparable)

    def name(self, row: RunRecord) -> str:
        """A run by what sets it apart."""
        return run_name(row, self.base)

    def headline(self) -> str:
        """The best run in a sentence."""
        spread = ar_interval(_scored(self.best))
        return (
            f"{self.metric} {spread.mean:.3f} (95 % over images: {spread.low:.3f} to {spread.high:.3f}) "
            f"by {self.name(self.best)}"
        )

    def figures(self) -> dict[str, list[Figure]]:
        """Figures by the part of the page they stand in."""
        shown = dict(self.methods)
        named = {row.id: method for method, row in self.methods}
        if self.best.id not in named:
            shown[f"{self.name(self.best)} (best)"] = self.best
        visible = figures.visibility_figure(self.base)
        timed = {named.get(row.id, self.name(row)): row for row in self.rows if row.times_s and self._timed(row)}
        return {
            "recalls": [
                *figures.objects_figures(shown, self.dataset),
                figures.theta_figure(shown, self.dataset),
                figures.thresholds_figure(self.base),
                *([visible] if visible else []),
            ],
            "ablations": [figures.family_figure(family) for family in self.families],
            "times": [figures.times_figure(dict(list(timed.items())[:_TIMES_SHOWN]))] if timed else [],
        }

    def _timed(self, row: RunRecord) -> bool:
        return row in dict(self.methods).values() or row.config.get("variation", "none").startswith("no_")

    def tables(self) -> dict[str, list[Table]]:
        """Measured tables by the part of the page they stand in."""
        by_part: dict[str, list[Table | None]] = {
            "runs": [tables.runs_table(self.rows, self.base), tables.templates_table(self.methods)],
            "ablations": [*map(tables.family_table, self.families)],
            "parts": [tables.correspondence_table(self.rows), tables.ladder_table(self.rows)],
            "methods": [tables.improvement_table(self.methods)],
            "times": [tables.times_table(self.methods), tables.counts_table(self.jobs, self.base)],
            "failures": [tables.failures_table(self.rows, self.base)],
        }
        return {part: [table for table in made if table is not None] for part, made in by_part.items()}

    def galleries(self) -> list[RunRecord]:
        """Runs whose pictures are shown: the base run's, and the best one's."""
        return [row for row in dict.fromkeys([self.base, self.best, *self.rows]) if row.cases][:2]


def write_report(rows: Sequence[RunRecord], out: Path) -> Report:
    """Write the page of all rows, its figures and tables to ``out/report``; a reader sees a whole page or the old."""
    folder = out / FOLDER
    sections = sections_of(rows)
    failed = unresolved_failures(rows)
    pictures = _Pictures(out)
    parts = []
    made = [(section, section.figures(), section.tables()) for section in sections]
    for old in ("figures", "tables"):  # those of runs that are gone must not lie beside this page
        shutil.rmtree(folder / old, ignore_errors=True)
    for section, drawn, told in made:
        _write_files(folder, section, drawn, told)
        galleries = [(section.name(row), pictures.of(row)) for row in section.galleries()]
        theirs = tables.published_column(section.dataset)
        parts.append({"it": section, "figures": drawn, "tables": told, "galleries": galleries, "theirs": theirs})
    published = tables.published_tables()
    for table in published:
        _write_table(folder / "tables", table)
    text = _template().render(
        parts=parts,
        failed=failed,
        published=published,
        runs=sum(row.status == "done" for row in rows) + len(failed),
        left_out=pictures.left_out,
        written=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
    )
    write_atomic(folder / "index.html", text)
    return Report(folder / "index.html", _summary(sections, failed, folder))


def sections_of(rows: Sequence[RunRecord]) -> list[Section]:
    """Rows with scores by the targets they are of, the newest first; sections of one name are told apart."""
    by_key: dict[str, list[RunRecord]] = {}
    for row in rows:
        if row.dataset is not None and row.scores is not None:
            by_key.setdefault(row.dataset.key, []).append(row)
    found = []
    for key, mine in sorted(by_key.items(), key=lambda item: item[1][-1].at, reverse=True):
        data = mine[0].dataset
        assert data is not None
        twice = sum(other.name == data.name for group in by_key.values() if (other := group[0].dataset)) > 1
        title = f"{data.name} {data.split}: {data.targets} targets, {data.images} images, {len(data.objects)} objects"
        found.append(Section(mine, f"{title} ({key[:6]})" if twice else title))
    return found


class _Pictures:
    """Pictures of runs, small enough to travel in the page, as long as there is room."""

    def __init__(self, out: Path) -> None:
        self.out, self.used, self.left_out = out, 0, 0

    def of(self, row: RunRecord) -> list[Shown]:
        shown = []
        for case in row.cases:
            path = self.out / row.folder / case.file
            data = self._jpeg(path) if path.is_file() else b""
            if not data or self.used + len(data) > PICTURES_BYTES:
                self.left_out += 1
                continue
            self.used += len(data)
            part = "" if case.relative_mssd is None else f", MSSD {case.relative_mssd:.0%} of the diameter"
            text = f"scene {case.scene_id}, image {case.im_id}, object {case.obj_id}: {case.text}{part}"
            shown.append(Shown("data:image/jpeg;base64," + base64.b64encode(data).decode(), text))
        return shown

    @staticmethod
    def _jpeg(path: Path) -> bytes:
        try:
            with PIL.Image.open(path) as opened:
                picture = opened.convert("RGB")
        except (OSError, SyntaxError, ValueError):
            return b""
        if picture.width > _CARD_PX:
            picture = picture.resize((_CARD_PX, round(picture.height * _CARD_PX / picture.width)))
        stream = io.BytesIO()
        picture.save(stream, "JPEG", quality=80, optimize=True)
        return stream.getvalue()


def _template() -> jinja2.Template:
    loader = jinja2.FileSystemLoader(Path(__file__).parent)
    environment = jinja2.Environment(
        loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    environment.filters["breakable"] = _breakable
    environment.filters["two_lines"] = _two_lines
    return environment.get_template("page.html.j2")


def _breakable(text: str) -> Markup:
    """A name that may go on in the next line after its dots, underscores and equals signs."""
    return Markup(re.sub(r"([._=])", r"\1<wbr>", str(escape(text))))


def _two_lines(text: str) -> Markup:
    """A figure above its interval: a table of many columns is then no wider than a page."""
    return Markup(str(escape(text)).replace(" (", "<br>("))


def _write_files(folder: Path, section: Section, drawn: dict[str, list[Figure]], told: dict[str, list[Table]]) -> None:
    """Figures and tables as files, in folders named by dataset and targets."""
    own = f"{section.dataset}_{section.anchor.removeprefix('d-')}"
    (folder / "figures" / own).mkdir(parents=True, exist_ok=True)
    names: dict[str, int] = {}
    for figure in (figure for part in drawn.values() for figure in part):
        figure.save(str(folder / "figures" / own / _once(figure.name, names)))
    names = {}
    for table in (table for part in told.values() for table in part):
        _write_table(folder / "tables" / own, table, _once(table.name, names))


def _once(name: str, names: dict[str, int]) -> str:
    names[name] = names.get(name, 0) + 1
    return name if names[name] == 1 else f"{name}_{names[name]}"


def _write_table(folder: Path, table: Table, name: str | None = None) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    write_atomic(folder / f"{name or table.name}.csv", table.csv())
    write_atomic(folder / f"{name or table.name}.tex", table.latex())


def _summary(sections: Sequence[Section], failed: Sequence[RunRecord], folder: Path) -> str:
    lines = [f"{section.title}: {len(section.jobs)} runs; {section.headline()}" for section in sections]
    lines += [f"failed: {' '.join(row.overrides)} ({row.error})" for row in failed]
    lines.append(f"page      {folder / 'index.html'}\nfigures   {folder / 'figures'}\ntables    {folder / 'tables'}")
    return "\n".join(lines)


def _scored(row: RunRecord) -> Scores:
    assert row.scores is not None
    return row.scores
