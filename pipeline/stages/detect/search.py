"""photograph, templates -> detections, without mask, box or download."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field
from typing import ClassVar

from pipeline.bop.dataset import Dataset
from pipeline.items.views import Detection, Target
from pipeline.spec import spec
from pipeline.stages.detect import Descriptors, Detector, SearchPlan


@spec
class Search(Detector):
    """Finds one instance of each object in the whole photograph, as ``plan`` says."""

    kind: ClassVar[str] = "detect.search"
    version: ClassVar[int] = 1
    finds_objects: ClassVar[bool] = True

    plan: SearchPlan = field(default_factory=SearchPlan)

    @property
    def summary(self) -> str:
        """As Detector.summary."""
        return "objects found by search"

    @property
    def search_plan(self) -> SearchPlan:
        """As Detector.search_plan: nothing is given, so every target is searched for."""
        return self.plan

    def __call__(
        self, dataset: Dataset, targets: Sequence[Target], descriptors: Descriptors | None = None
    ) -> list[Detection]:
        """Nothing: the graph searches for every target without a detection."""
        return []
