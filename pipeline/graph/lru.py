"""Values that are dear to make and too large to keep all of: the last used ones, within a number of bytes."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from typing import Generic, TypeVar

K = TypeVar("K", bound=Hashable)
V = TypeVar("V")


@dataclass(eq=False)
class Kept(Generic[K, V]):
    """``make`` of a key, made anew where it was let go: the last is always kept, others while all fit ``limit``."""

    make: Callable[[K], V]
    size: Callable[[V], int]
    limit: int
    values: OrderedDict[K, V] = field(default_factory=OrderedDict)

    def __call__(self, key: K) -> V:
        """The value of a key."""
        if key not in self.values:
            self.values[key] = self.make(key)
        self.values.move_to_end(key)
        while len(self.values) > 1 and sum(map(self.size, self.values.values())) > self.limit:
            self.values.popitem(last=False)
        return self.values[key]

    def forget(self, key: K) -> None:
        """Let a value go."""
        self.values.pop(key, None)
