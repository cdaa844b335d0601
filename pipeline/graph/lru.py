"""LRU cache bounded by bytes."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from typing import Generic, TypeVar

K = TypeVar("K", bound=Hashable)
V = TypeVar("V")


@dataclass(eq=False)
class LRUCache(Generic[K, V]):
    """LRU cache bounded by bytes; the newest entry is never evicted.

    ``make`` computes the value of a missing key, ``size`` returns the bytes of a value, ``limit`` is in bytes.
    """

    make: Callable[[K], V]
    size: Callable[[V], int]
    limit: int
    values: OrderedDict[K, V] = field(default_factory=OrderedDict)

    def __call__(self, key: K) -> V:
        """Value of a key, computed if it is missing."""
        if key not in self.values:
            self.values[key] = self.make(key)
        self.values.move_to_end(key)
        while len(self.values) > 1 and sum(map(self.size, self.values.values())) > self.limit:
            self.values.popitem(last=False)
        return self.values[key]

    def discard(self, key: K) -> None:
        """Remove a key if it is present."""
        self.values.pop(key, None)
