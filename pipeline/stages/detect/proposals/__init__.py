"""image -> proposals."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Protocol

from pipeline.items.views import Image, Proposal
from pipeline.spec import Runtime, Spec


class LoadedProposer(Protocol):
    """A proposer with its weights in memory."""

    def __call__(self, image: Image) -> list[Proposal]:
        """Masks of parts of the image that may be objects, most confident first; they may overlap. Can be empty."""
        ...


class Proposer(Spec, ABC):
    """Base of every proposals variant. Its recipe and the image's bytes determine the proposals."""

    def weight_bytes(self) -> int:
        """Memory that the weights take; 0 where there are none."""
        return 0

    @abstractmethod
    def load(self, runtime: Runtime) -> LoadedProposer:
        """Weights into memory. Raises BadInput for weights that are missing or of another class."""
