"""README and docs as data: pages, links, code blocks, commands."""

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
README = ROOT / "README.md"
DOCS = sorted((ROOT / "docs").glob("*.md"))
PAGES = [README, *DOCS, ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", ROOT / "pipeline" / "embedded" / "README.md"]
_FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_LINKS = re.compile(r"\]\(([^)\s]+)\)|(?:src|srcset|href)=\"([^\"]+)\"")
PROGRAMS = ("dzop", "make", "pip", "python")


@dataclass(frozen=True)
class Command:
    """A command that a page shows, and its words as a shell splits them."""

    page: Path
    words: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.page.name}: {' '.join(self.words)}"


def name_of(page: Path) -> str:
    return str(page.relative_to(ROOT))


def blocks(page: Path) -> list[tuple[str, str]]:
    """(language, text) of every fenced code block."""
    return _FENCE.findall(page.read_text())


def prose(page: Path) -> str:
    return _FENCE.sub("", page.read_text())


def links(page: Path) -> list[str]:
    return [a or b for a, b in _LINKS.findall(prose(page)) if not (a or b).startswith(("http://", "https://"))]


def anchors(page: Path) -> set[str]:
    """Anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.+)$", prose(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def commands(page: Path) -> list[Command]:
    """Commands of code blocks without a language, and of text in backticks that starts with a program's name."""
    lines = [line for language, text in blocks(page) if not language for line in text.replace("\\\n", " ").splitlines()]
    spans = [" ".join(span.split()) for span in re.findall(r"`([^`]+)`", prose(page))]
    lines += [span for span in spans if " " in span and "..." not in span]
    found = []
    for line in lines:
        for part in line.split(" && "):
            words = _from_program(part)
            if words and not line.startswith("#"):
                found.append(Command(page, words))
    return found


def _from_program(line: str) -> tuple[str, ...]:
    """The words from the program's name on: what stands before it, such as srun or time, is not ours."""
    if not re.search(rf"(^|\s)({'|'.join(PROGRAMS)})\s", line):
        return ()
    words = shlex.split(line, comments=True)
    start = next((index for index, word in enumerate(words) if word in PROGRAMS), None)
    is_first = start == 0 or words[:1] in (["srun"], ["/usr/bin/time"])
    return tuple(words[start:]) if start is not None and is_first else ()
