"""The validation data set, and its imitated detector."""

import json
from collections import Counter

import numpy as np
import pytest

from pipeline.bop.masks import decode_rle, read_segmentation
from pipeline.errors import BadInput
from pipeline.synthetic.detector_masks import SHARES, box_xywh, imitate_detector
from pipeline.synthetic.validation import SIZE_HW, ValidationConfig

SMALL = {"objects": 2, "images": 2, "per_image": 2}


def disc(centre, radius=24) -> np.ndarray:
    y, x = np.mgrid[:120, :160]
    return (x - centre[0]) ** 2 + (y - centre[1]) ** 2 < radius**2


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / (a | b).sum())


def test_the_data_set_is_the_same_in_every_folder_and_its_detections_are_those_of_its_targets(tmp_path):
    first, second = (ValidationConfig(root=str(tmp_path / name), **SMALL).open() for name in "ab")
    files = sorted(path.relative_to(first.root) for path in first.root.rglob("*") if path.is_file())
    assert files == sorted(path.relative_to(second.root) for path in second.root.rglob("*") if path.is_file())
    assert all((first.root / name).read_bytes() == (second.root / name).read_bytes() for name in files)
    targets = {(t.scene_id, t.im_id, t.obj_id) for t in first.targets}
    for entry in json.loads((first.root / "detections.json").read_text()):
        assert (entry["scene_id"], entry["image_id"], entry["category_id"]) in targets
        if "segmentation" in entry:
            assert box_xywh(decode_rle(read_segmentation(entry["segmentation"], SIZE_HW))) == entry["bbox"]


def test_a_folder_with_other_content_is_refused(tmp_path):
    ValidationConfig(root=str(tmp_path / "a"), **SMALL).open()
    with pytest.raises(BadInput, match="with other content"):
        ValidationConfig(root=str(tmp_path / "a"), **SMALL | {"images": 3}).open()


def test_masks_of_the_imitated_detector_are_mostly_near_and_a_fifth_elsewhere():
    visible, silhouette, other = disc((60, 60)) & ~disc((85, 60)), disc((60, 60)), disc((120, 60))
    made = [imitate_detector(visible, silhouette, [other], np.random.default_rng([1, k])) for k in range(400)]
    found = [mask for mask, _ in filter(None, made)]
    share = Counter(
        "good" if iou(m, visible) > 0.85 else "elsewhere" if iou(m, visible) < 0.05 else "wrong" for m in found
    )
    assert all(m.any() for m in found)
    assert len(made) - len(found) == pytest.approx(400 * SHARES["missing"], abs=12)
    assert share["elsewhere"] == pytest.approx(400 * SHARES["another"], abs=20)
    assert share["good"] > 120
    assert share["wrong"] > 60
    assert sum(as_box for _, as_box in filter(None, made)) == pytest.approx(400 * SHARES["box"], abs=12)


def test_an_instance_that_is_not_visible_is_missed():
    nothing = np.zeros((120, 160), bool)
    assert imitate_detector(nothing, disc((60, 60)), [], np.random.default_rng(0)) is None
