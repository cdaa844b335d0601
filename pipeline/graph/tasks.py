"""Tasks that can run in another process: one item (an object, an image, or a group of targets) at a time.

A task reads its inputs from the dataset and the store and writes its results to the store, so only the task's name
and the item are sent to a worker. Keys follow from specs and files alone: whichever process runs an item, the entries
hold the same bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

from pipeline.progress import StepCount

Item = TypeVar("Item", bound=Hashable)
Advance = Callable[[int], None]
"""Moves a progress bar by a number of steps."""
Counts = Mapping[str, StepCount]
"""Rows and seconds by step."""


@dataclass(frozen=True)
class Task(Generic[Item]):
    """A computation for every item of a run.

    ``do`` computes one item and advances the progress bar by its ``size`` in total; ``done`` says whether all entries
    of an item are complete.
    """

    name: str
    do: Callable[[Item, Advance], None]
    done: Callable[[Item], bool]
    size: Callable[[Item], int] = lambda item: 1


class Workers(Protocol):
    """Other processes, local or remote, that hold the same graph and share the dataset and the store."""

    def map(self, task: str, items: Sequence[Any]) -> Iterator[tuple[Any, Counts]]:
        """Yield each item with its counts as soon as it is finished. Workers that die are replaced.

        Raises DzopError with the message of the first item that failed.
        """
        ...
