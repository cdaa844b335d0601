"""the mask or box of dataset=photo -> one detection."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

from pipeline.bop.dataset import Dataset
from pipeline.bop.given import GivenObjects
from pipeline.errors import BadInput
from pipeline.items.views import Detection, Target
from pipeline.spec import spec
from pipeline.stages.detect import Descriptors, Detector


@spec
class PhotoMask(Detector):
    """The mask or box given to ``dataset=photo``, with score 1."""

    kind: ClassVar[str] = "detect.photo"
    version: ClassVar[int] = 2
    gives_boxes: ClassVar[bool] = True

    @property
    def summary(self) -> str:
        """As Detector.summary."""
        return "the mask or box of dataset=photo"

    def sources(self, dataset: Dataset, targets: Sequence[Target]) -> list[Path]:
        """The photograph, and its mask file if given."""
        return _require_given(dataset).location_files

    def __call__(
        self, dataset: Dataset, targets: Sequence[Target], descriptors: Descriptors | None = None
    ) -> list[Detection]:
        """The detections. Raises BadInput for a mask of another size than the photograph, or an empty one."""
        given = _require_given(dataset)
        return [detection for target in targets for detection in given.locate(target)]


def _require_given(dataset: Dataset) -> GivenObjects:
    if not isinstance(dataset, GivenObjects):
        raise BadInput("detect", found="photo with another dataset", needed="dataset=photo, or another detect")
    return dataset
