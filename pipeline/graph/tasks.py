"""What can be done in another process: one object, one image or one group of targets at a time.

A unit of work takes its inputs from the dataset and the store and leaves its results in the store, so that nothing but
its name travels. Keys follow from specs and files alone: whoever does it, the same entries hold the same bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

import cv2
import torch
from threadpoolctl import threadpool_limits

from pipeline.progress import StepCount

Unit = TypeVar("Unit", bound=Hashable)
Advance = Callable[[int], None]
Counts = Mapping[str, StepCount]


@dataclass(frozen=True)
class Work(Generic[Unit]):
    """One kind of work. ``do`` moves a bar by ``size`` of its unit in all; ``done``: all its entries are complete."""

    name: str
    do: Callable[[Unit, Advance], None]
    done: Callable[[Unit], bool]
    size: Callable[[Unit], int] = lambda unit: 1


class Workers(Protocol):
    """Other processes, on this machine or on others, that have the same graph, dataset and store."""

    def each(self, work: str, units: Sequence[Any]) -> Iterator[tuple[Any, Counts]]:
        """Units as they are finished, each with what was computed for it; lost workers are replaced.

        Raises DzopError with the words of the first unit that failed.
        """
        ...


def use_threads(threads: int) -> None:
    """CPU threads of this process from now on, in whatever library; 0 leaves them as they are."""
    if threads:
        torch.set_num_threads(threads)
        cv2.setNumThreads(threads)
        threadpool_limits(threads)  # BLAS beneath SciPy, which has threads of its own
