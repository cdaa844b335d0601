"""The contract of what is fitted to an object's templates; variants are in pipeline.fits."""

from __future__ import annotations

from typing import Protocol

from torch import Tensor

from pipeline.items.features import FittedArrays, TemplateCells
from pipeline.spec import Variant


class Fit(Variant, Protocol):
    """Contract of a fit to an object's templates: a spec of its own, so that its key holds only what it depends on.

    A stage's variant names the fit it needs in its property ``fit`` and receives the arrays when it is called. Variants
    with equal fits share one entry.
    """

    def __hash__(self) -> int:
        """Fits are frozen and compared by value."""
        ...

    @property
    def layer(self) -> int:
        """The layer whose features it is fitted to."""
        ...

    @property
    def base(self) -> Fit | None:
        """The fit of the same layer that this one is based on, if any."""
        ...

    def array_bytes(self, channels: int, templates: int) -> int:
        """Upper bound of the bytes of its own arrays."""
        ...

    def __call__(self, cells: TemplateCells, base: FittedArrays) -> dict[str, Tensor]:
        """Its own arrays, on the CPU and deterministic. Raises DzopError for features that it cannot be fitted to."""
        ...
