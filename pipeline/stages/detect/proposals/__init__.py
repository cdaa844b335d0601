"""image -> proposals."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from pipeline.items.views import Image, Proposal
from pipeline.spec import Runtime, Variant


class LoadedProposer(Protocol):
    """A proposer with its weights in memory."""

    def __call__(self, image: Image) -> list[Proposal]:
        """Masks of whatever may be an object, most confident first; they may overlap, and there may be none."""
        ...


@runtime_checkable
class Proposer(Variant, Protocol):
    """What a proposals variant is: a spec that decides, with the image's bytes, what is proposed."""

    def load(self, runtime: Runtime) -> LoadedProposer:
        """Weights into memory. Raises BadInput for weights that are missing or of another class."""
        ...
