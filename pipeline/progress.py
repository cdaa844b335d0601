"""Progress of a run: rows computed and reused per step, seconds per step, and progress bars."""

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
class StepCount:
    """Rows of one step: computed by this run, reused from the store; and the seconds spent."""

    computed: int = 0
    reused: int = 0
    time_s: float = 0.0


@dataclass
class Progress:
    """Counts per step, and progress bars. ``show_bars=False`` hides the bars; counting goes on."""

    show_bars: bool = True
    counts: dict[str, StepCount] = field(default_factory=dict)

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
        """Show a progress bar after three seconds; yields the function that advances it. No bar without a title."""
        disable = None if self.show_bars and title else True  # None: tqdm hides it where stderr is no terminal
        with tqdm(total=total, desc=title, unit=unit, delay=3, disable=disable, dynamic_ncols=True) as bar:

            def advance(rows: int) -> None:
                bar.update(rows)

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


def format_bytes(size: float) -> str:
    """A number of bytes as text with a decimal unit: ``1.5 MB``."""
    for unit in ("B", "kB", "MB", "GB"):
        if size < 1000:
            return f"{size:.0f} {unit}" if unit == "B" else f"{size:.1f} {unit}"
        size /= 1000
    return f"{size:.1f} TB"
