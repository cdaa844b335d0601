"""images -> detections."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from pipeline.bop.dataset import Dataset
from pipeline.items.views import Detection, Proposal, Target
from pipeline.spec import Spec, Variant
from pipeline.stages.detect.proposals import Proposer


class Detector(Variant, Protocol):
    """What a detect variant is that reads its detections from files."""

    def sources(self, dataset: Dataset, targets: Sequence[Target]) -> list[Path]:
        """The files whose bytes decide the answer (they enter the key)."""
        ...

    def __call__(self, dataset: Dataset, targets: Sequence[Target]) -> list[Detection]:
        """Detections of the targets' objects in the targets' images, best score first within image and object."""
        ...


@runtime_checkable
class DescribingDetector(Variant, Protocol):
    """A detect variant that compares proposals with templates by features; the graph provides both and keeps them.

    ``describe``: an extract variant; one vector of a crop is its map of ``describe_layer``, averaged over the mask.
    """

    proposals: Proposer
    describe: Spec
    describe_layer: int

    def by_description(
        self,
        targets: Sequence[Target],
        proposals: Sequence[Proposal],
        described: Float[Tensor, "p c"],
        templates: Mapping[int, Float[Tensor, "n c"]],
        time_s: float,
    ) -> list[Detection]:
        """Detections of one image's targets, best score first within an object.

        ``described``: descriptors of the proposals; ``templates``: those of every object of the run, by obj_id;
        ``time_s``: seconds that the image has taken so far. A target without a detection gets one with a defect.
        """
        ...
