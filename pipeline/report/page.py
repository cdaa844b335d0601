"""Run records -> one self-contained HTML page, figures as PNG and PDF, tables as CSV and LaTeX."""

from __future__ import annotations

import os
import re
import shutil
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import chain
from pathlib import Path

import jinja2
from markupsafe import Markup, escape

from pipeline.errors import DzopError
from pipeline.io.files import write_atomic, write_error
from pipeline.report.embedded_pictures import GalleryPicture, PictureEmbedder
from pipeline.report.plotting import Figure
from pipeline.report.published_tables import published_methods_of, published_notes, published_tables
from pipeline.report.reproduction import reproduction_tables
from pipeline.report.run_records import RunRecord, unresolved_failures
from pipeline.report.section import Section, sections_of
from pipeline.report.table import Table

FOLDER = "report"


@dataclass(frozen=True)
class Report:
    """The written page, and a summary for the terminal."""

    page: Path
    summary: str


@dataclass(frozen=True)
class Part:
    """A section with everything drawn for it, as the template reads it."""

    section: Section
    figures: dict[str, list[Figure]]
    tables: dict[str, list[Table]]
    galleries: list[tuple[str, list[GalleryPicture]]]
    published: Table | None


def write_report(runs: Sequence[RunRecord], out: Path) -> Report:
    """Write the page of all runs with its figures and tables to ``out/report``.

    An earlier report is replaced once the new one is complete: a full disk leaves it as it was.
    """
    sections, failed, embedder = sections_of(runs), unresolved_failures(runs), PictureEmbedder(out)
    parts = [_make_part(section, embedder) for section in sections]
    with _replace_contents(out / FOLDER) as folder:
        _write_all(folder, runs, parts, failed, embedder)
    return Report(out / FOLDER / "index.html", _summary(sections, failed, out / FOLDER))


@contextmanager
def _replace_contents(folder: Path) -> Iterator[Path]:
    """A new folder to write to; its files and folders then replace those of the same names in ``folder``.

    Raises DzopError when the disk is full or cannot be written.
    """
    new, old = (folder.with_name(f".{folder.name}.{os.getpid()}.{name}.partial") for name in ("new", "old"))
    try:
        try:
            new.mkdir(parents=True)
            yield new
            folder.mkdir(exist_ok=True)
            old.mkdir()
            for path in sorted(new.iterdir(), key=Path.is_file):  # the page last, when its figures and tables are there
                if (folder / path.name).is_dir():
                    (folder / path.name).rename(old / path.name)
                path.replace(folder / path.name)
        finally:
            _move_back(old, folder)
            shutil.rmtree(new, ignore_errors=True)
            shutil.rmtree(old, ignore_errors=True)
    except OSError as error:
        raise write_error(folder, error) from None
    except DzopError as error:
        raise DzopError(str(error).replace(str(new), str(folder))) from None


def _move_back(old: Path, folder: Path) -> None:
    """Restore what was not replaced because an error came in between."""
    for path in old.iterdir() if old.is_dir() else ():
        if not (folder / path.name).exists():
            path.rename(folder / path.name)


def _write_all(
    folder: Path,
    runs: Sequence[RunRecord],
    parts: Sequence[Part],
    failed: Sequence[RunRecord],
    embedder: PictureEmbedder,
) -> None:
    for part in parts:
        _write_figures(folder / "figures" / part.section.folder, part.figures)
        _write_tables(folder / "tables" / part.section.folder, [*chain.from_iterable(part.tables.values())])
    reproduced = reproduction_tables(runs)
    _write_tables(folder / "tables", [*published_tables(), *reproduced])
    text = _template().render(
        parts=parts,
        failed=failed,
        published=published_tables(),
        reproduced=reproduced,
        published_notes=published_notes(),
        runs=sum(run.status == "done" for run in runs) + len(failed),
        skipped_pictures=embedder.skipped,
        written=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
    )
    write_atomic(folder / "index.html", text)


def _make_part(section: Section, embedder: PictureEmbedder) -> Part:
    galleries = [(section.name(run), embedder.pictures_of(run)) for run in section.galleries()]
    return Part(section, section.figures(), section.tables(), galleries, published_methods_of(section.dataset))


def _template() -> jinja2.Template:
    loader = jinja2.FileSystemLoader(Path(__file__).parent)
    environment = jinja2.Environment(
        loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    environment.filters["breakable"] = _breakable
    environment.filters["two_lines"] = _two_lines
    return environment.get_template("page.html.j2")


def _breakable(text: str) -> Markup:
    """A name that may be broken across lines after dots, underscores and equals signs."""
    return Markup(re.sub(r"([._=])", r"\1<wbr>", str(escape(text))))


def _two_lines(text: str) -> Markup:
    """A number above its interval, so that a table of many columns fits the page."""
    return Markup(str(escape(text)).replace(" (", "<br>("))


def _write_figures(folder: Path, by_part: dict[str, list[Figure]]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    drawn = [*chain.from_iterable(by_part.values())]
    for figure, name in zip(drawn, _unique_names(figure.name for figure in drawn), strict=True):
        figure.save(str(folder / name))


def _write_tables(folder: Path, tables: Sequence[Table]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for table, name in zip(tables, _unique_names(table.name for table in tables), strict=True):
        write_atomic(folder / f"{name}.csv", table.csv())
        write_atomic(folder / f"{name}.tex", table.latex())


def _unique_names(names: Iterable[str]) -> list[str]:
    """The names; from its second use on, a name gets a number."""
    seen: Counter[str] = Counter()
    unique = []
    for name in names:
        seen[name] += 1
        unique.append(name if seen[name] == 1 else f"{name}_{seen[name]}")
    return unique


def _summary(sections: Sequence[Section], failed: Sequence[RunRecord], folder: Path) -> str:
    lines = [
        f"{section.title}: {len(section.jobs)} run{'s' * (len(section.jobs) != 1)}; {section.headline()}"
        for section in sections
    ]
    lines += [f"failed: {' '.join(run.overrides)} ({run.error})" for run in failed]
    lines.append(f"page      {folder / 'index.html'}\nfigures   {folder / 'figures'}\ntables    {folder / 'tables'}")
    return "\n".join(lines)
