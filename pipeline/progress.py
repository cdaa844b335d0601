"""What a run computed and what it found: rows and seconds by step, and progress bars for what takes long."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field

from tqdm import tqdm

STEPS = (
    "templates",
    "template crops",
    "template features",
    "fits",
    "proposals",
    "proposal features",
    "detections",
    "query crops",
    "query features",
    "poses",
    "scores",
    "overlays",
    "gallery",
)


@dataclass
class Count:
    """Rows of one step."""

    computed: int = 0
    reused: int = 0
    time_s: float = 0.0


@dataclass
class Tally:
    """Counts by step. ``progress`` False silences the bars, never the table."""

    progress: bool = True
    counts: dict[str, Count] = field(default_factory=dict)

    def add(self, step: str, *, computed: int = 0, reused: int = 0, time_s: float = 0.0) -> None:
        """Count rows of a step."""
        count = self.of(step)
        count.computed += computed
        count.reused += reused
        count.time_s += time_s

    def merge(self, counts: Mapping[str, Count]) -> None:
        """Add what another process has counted."""
        for step, count in counts.items():
            self.add(step, computed=count.computed, reused=count.reused, time_s=count.time_s)

    def of(self, step: str) -> Count:
        """The counts of a step so far."""
        return self.counts.setdefault(step, Count())

    @contextmanager
    def bar(self, total: int, title: str, unit: str) -> Iterator[Callable[[int], None]]:
        """A progress bar that appears after three seconds; yields the function that moves it."""
        hidden = None if self.progress else True  # None: hidden where stderr is no terminal
        with tqdm(total=total, desc=title, unit=unit, delay=3, disable=hidden, dynamic_ncols=True) as bar:
            yield lambda rows: (bar.update(rows), None)[1]

    def table(self) -> str:
        """Step, computed, reused, seconds; steps in the order of the route."""
        lines = [f"{'step':<20}{'computed':>10}{'reused':>10}{'seconds':>10}"]
        for step in sorted(self.counts, key=STEPS.index):
            count = self.counts[step]
            lines.append(f"{step:<20}{count.computed:>10}{count.reused:>10}{count.time_s:>10.1f}")
        return "\n".join(lines)

    def as_record(self) -> dict[str, dict[str, float]]:
        """JSON-able counts."""
        return {step: {**vars(count), "time_s": round(count.time_s, 3)} for step, count in self.counts.items()}


def human(size: float) -> str:
    """Bytes in a unit a person reads."""
    for unit in ("B", "kB", "MB", "GB"):
        if size < 1000:
            return f"{size:.0f} {unit}" if unit == "B" else f"{size:.1f} {unit}"
        size /= 1000
    return f"{size:.1f} TB"
