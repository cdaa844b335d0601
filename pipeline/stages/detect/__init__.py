"""images -> detections."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from jaxtyping import Float
from torch import Tensor

from pipeline.backbones.extractor import Extractor
from pipeline.bop.dataset import Dataset
from pipeline.items.views import Detection, Proposal, Target
from pipeline.spec import Spec
from pipeline.stages.detect.proposals import Proposer


@dataclass(frozen=True)
class Describer:
    """How proposals and templates get their descriptors: the extractor's map of ``layer``, averaged over the mask."""

    proposer: Proposer
    extractor: Extractor
    layer: int


@dataclass(frozen=True, eq=False)
class ImageDescriptors:
    """An image's proposals, a descriptor of each, and the seconds that computing them took."""

    proposals: Sequence[Proposal]
    descriptors: Float[Tensor, "p c"]
    time_s: float


@dataclass(frozen=True, eq=False)
class Descriptors:
    """Descriptors of the templates of every object of the run, by obj_id, and of any image (scene_id, im_id)."""

    templates: Mapping[int, Float[Tensor, "n c"]]
    of_image: Callable[[tuple[int, int]], ImageDescriptors]


class Detector(Spec, ABC):
    """Contract of a detect variant, which reads its detections from files or compares descriptors.

    ``gives_boxes``: whether detections may come without a mask; the segment stage then makes one.
    """

    gives_boxes: ClassVar[bool] = False

    @property
    def summary(self) -> str:
        """What the detections are, for headlines and reports; ground truth is marked "(oracle)"."""
        return f"detections of {self.kind.partition('.')[2]}"

    @property
    def describer(self) -> Describer | None:
        """What to describe proposals and templates by: the graph computes descriptors and passes them to the call."""
        return None

    def sources(self, dataset: Dataset, targets: Sequence[Target]) -> list[Path]:
        """Files whose bytes determine the detections; they enter the key."""
        return []

    def warnings(self, dataset: Dataset, targets: Sequence[Target]) -> list[str]:
        """Results of sanity checks on the sources, one line each; also made when the detections are cached."""
        return []

    @abstractmethod
    def __call__(
        self, dataset: Dataset, targets: Sequence[Target], descriptors: Descriptors | None = None
    ) -> list[Detection]:
        """Detections of the targets' objects in the targets' images, best score first within image and object.

        ``descriptors``: those of ``describer``; None without one.
        """
