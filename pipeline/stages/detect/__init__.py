"""images -> detections."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from jaxtyping import Float
from torch import Tensor

from pipeline.backbones.extractor import Extractor
from pipeline.bop.dataset import Dataset
from pipeline.items.views import Detection, Proposal, Target
from pipeline.spec import Fraction, NonNegativeFloat, Positive, Spec, spec
from pipeline.stages.detect.proposals import Proposer
from pipeline.stages.detect.proposals.regions import Regions


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


@spec
class SearchPlan(Spec):
    """How objects are searched for in the whole photograph.

    Masks of ``proposals`` are compared with the object's templates: the route's matcher layer cell by cell, plus
    ``colour`` times the similarity of their colours. The poses of the ``candidates`` most similar ones are estimated
    (of two masks with an IoU above ``nms_iou`` only the better) until one has a confidence of ``enough``; the pose of
    highest confidence decides. Below ``min_confidence`` the object is not found. Targets with a detection are searched
    for only if its pose has a confidence below ``doubtful``; the search must then find a more confident one.
    """

    kind: ClassVar[str] = "search"
    version: ClassVar[int] = 1

    proposals: Proposer = field(default_factory=Regions)
    candidates: Positive = 30
    colour: NonNegativeFloat = 1.0
    nms_iou: Fraction = 0.6
    enough: Fraction = 0.98
    min_confidence: Fraction = 0.95
    doubtful: Fraction = 0.0


class Detector(Spec, ABC):
    """Contract of a detect variant, which reads its detections from files or compares descriptors.

    ``gives_boxes``: whether detections may come without a mask; the segment stage then makes one.
    ``finds_objects``: whether it looks for objects itself, so that a mask or box given by the user has no use.
    """

    gives_boxes: ClassVar[bool] = False
    finds_objects: ClassVar[bool] = False

    @property
    def summary(self) -> str:
        """What the detections are, for headlines and reports; ground truth is marked "(oracle)"."""
        return f"detections of {self.kind.partition('.')[2]}"

    @property
    def describer(self) -> Describer | None:
        """What to describe proposals and templates by: the graph computes descriptors and passes them to the call."""
        return None

    @property
    def search_plan(self) -> SearchPlan | None:
        """How the graph searches for targets that this detector has no detection of; None if it does not."""
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
