"""the mask or box of dataset=photo -> one detection."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

from pipeline.bop.dataset import Dataset
from pipeline.bop.masks import encode_rle
from pipeline.bop.photo import Photo
from pipeline.errors import BadInput
from pipeline.functional.camera import mask_bbox
from pipeline.items.views import Detection, Target
from pipeline.spec import spec
from pipeline.stages.detect import Descriptors, Detector


@spec
class PhotoMask(Detector):
    """The mask or box given to ``dataset=photo``, with score 1."""

    kind: ClassVar[str] = "detect.photo"
    version: ClassVar[int] = 2

    @property
    def summary(self) -> str:
        """As Detector.summary."""
        return "the mask or box of dataset=photo"

    def sources(self, dataset: Dataset, targets: Sequence[Target]) -> list[Path]:
        """The photograph, and its mask file if given."""
        photo = _require_photo(dataset)
        return [photo.photo_path] + ([] if photo.mask_file is None else [photo.mask_file])

    def __call__(
        self, dataset: Dataset, targets: Sequence[Target], descriptors: Descriptors | None = None
    ) -> list[Detection]:
        """One detection. Raises BadInput for a mask of another size than the photograph, or an empty one."""
        photo = _require_photo(dataset)
        return [_read_detection(photo, target) for target in targets]


def _require_photo(dataset: Dataset) -> Photo:
    if not isinstance(dataset, Photo):
        raise BadInput("detect", found="photo with another dataset", needed="dataset=photo, or another detect")
    if dataset.mask_file is None and dataset.bbox_xyxy is None:
        needed = "dataset.mask=FILE or dataset.bbox=[x,y,w,h], or detect=cnos, which finds the object"
        raise BadInput("dataset", found="neither of mask and bbox", needed=needed)
    return dataset


def _read_detection(photo: Photo, target: Target) -> Detection:
    ids = target.scene_id, target.im_id, target.obj_id
    h, w = photo.image_size(target.scene_id, target.im_id)
    if photo.mask_file is None:
        x0, y0, x1, y1 = photo.bbox_xyxy or (0.0,) * 4
        if x1 <= x0 or y1 <= y0 or x1 <= -0.5 or y1 <= -0.5 or x0 >= w - 0.5 or y0 >= h - 0.5:
            needed = f"x, y, width, height of a box inside the image of {w} x {h}"
            raise BadInput("dataset.bbox", found=[x0 + 0.5, y0 + 0.5, x1 - x0, y1 - y0], needed=needed)
        box = (x0, y0, x1, y1) if photo.lens is None else photo.lens.undistort_box((x0, y0, x1, y1), "dataset.bbox")
        return Detection(*ids, 1.0, 0.0, box)
    mask = photo.object_mask(photo.mask_file, (h, w))
    around = mask_bbox(mask)
    if around is None:
        raise BadInput(photo.mask_file, found="an empty mask", needed="the object's pixels not black")
    return Detection(*ids, 1.0, 0.0, around, encode_rle(mask))
