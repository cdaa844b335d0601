"""Progress of a run: rows computed and reused per step, seconds per step, progress bars, and lines in log files."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field

from tqdm import tqdm

LINE_EVERY_S = 30.0  # where stderr is no terminal, which would show a bar

STEPS = (
    "templates",
    "template crops",
    "template features",
    "fits",
    "template encodings",
    "proposals",
    "proposal features",
    "searches",
    "detections",
    "query crops",
    "query features",
    "poses",
    "scores",
    "overlays",
    "gallery",
)


@dataclass
class StepCount:
    """Rows of one step: computed by this run, reused from the store; and the seconds spent."""

    computed: int = 0
    reused: int = 0
    time_s: float = 0.0


@dataclass
class Progress:
    """Counts per step, and progress bars. ``show_bars=False`` hides the bars; counting goes on.

    Where stderr is no terminal, a line every 30 s at most takes the place of all bars.
    """

    show_bars: bool = True
    counts: dict[str, StepCount] = field(default_factory=dict)
    _last_line: float = field(default_factory=time.monotonic, repr=False)

    def step(self, name: str) -> StepCount:
        """The counts of a step so far; zeros for a new one."""
        return self.counts.setdefault(name, StepCount())

    def add(self, step: str, *, computed: int = 0, reused: int = 0, time_s: float = 0.0) -> None:
        """Add rows and seconds to a step."""
        count = self.step(step)
        count.computed += computed
        count.reused += reused
        count.time_s += time_s

    def merge(self, counts: Mapping[str, StepCount]) -> None:
        """Add the counts of another process."""
        for step, count in counts.items():
            self.add(step, computed=count.computed, reused=count.reused, time_s=count.time_s)

    @contextmanager
    def bar(self, total: int, title: str, unit: str) -> Iterator[Callable[[int], None]]:
        """Show a progress bar after three seconds; yields the function that advances it. Nothing without a title."""
        shown = self.show_bars and bool(title)
        lines = shown and not sys.stderr.isatty()
        done, start = 0, time.monotonic()
        with tqdm(total=total, desc=title, unit=unit, delay=3, disable=lines or not shown, dynamic_ncols=True) as bar:

            def advance(rows: int) -> None:
                nonlocal done
                done += rows
                bar.update(rows)
                if lines and time.monotonic() - self._last_line >= LINE_EVERY_S:
                    self._last_line = time.monotonic()
                    print(progress_line(title, unit, done, total, self._last_line - start), file=sys.stderr, flush=True)

            yield advance

    def table(self) -> str:
        """Text table of step, computed, reused and seconds, in the order of ``STEPS``."""
        lines = [f"{'step':<20}{'computed':>10}{'reused':>10}{'seconds':>10}"]
        for step in sorted(self.counts, key=STEPS.index):
            count = self.counts[step]
            lines.append(f"{step:<20}{count.computed:>10}{count.reused:>10}{count.time_s:>10.1f}")
        return "\n".join(lines)

    def as_record(self) -> dict[str, dict[str, float]]:
        """The counts as JSON-able values."""
        return {step: {**vars(count), "time_s": round(count.time_s, 3)} for step, count in self.counts.items()}


def progress_line(title: str, unit: str, done: int, total: int, elapsed_s: float) -> str:
    """State of a bar as one line: rows done, their rate, and the time that the others take at this rate."""
    left = format_duration((total - done) * elapsed_s / done) if done else "?"
    return f"{title}: {done} of {total} {unit}s, {done / max(elapsed_s, 1e-9):.2g} per second, {left} left"


def format_duration(seconds: float) -> str:
    """Seconds as text in seconds, minutes or hours: ``1.5 min``."""
    if seconds < 120:
        return f"{seconds:.1f} s"
    return f"{seconds / 60:.1f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


def format_bytes(size: float) -> str:
    """A number of bytes as text with a decimal unit: ``1.5 MB``."""
    for unit in ("B", "kB", "MB", "GB"):
        if size < 1000:
            return f"{size:.0f} {unit}" if unit == "B" else f"{size:.1f} {unit}"
        size /= 1000
    return f"{size:.1f} TB"
