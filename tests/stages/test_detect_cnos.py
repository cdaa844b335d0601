"""detect=cnos on given descriptors: assignment, thresholds, suppression, reasons."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline.bop.dataset import Dataset
from pipeline.bop.masks import encode_rle
from pipeline.errors import BadInput
from pipeline.functional.camera import mask_bbox
from pipeline.items.features import CLASS_TOKEN_LAYER
from pipeline.items.views import Detection, Proposal, Target
from pipeline.spec import build
from pipeline.stages.detect import Descriptors, ImageDescriptors
from pipeline.stages.detect.cnos import Cnos
from pipeline.stages.detect.gt_mask import GtMask
from pipeline.stages.detect.proposals.sam import Sam
from pipeline.stages.extract.hog import Hog

DATASET = Dataset("toy", Path("unused"), "test", "models", {})  # detections depend on descriptors alone
TARGETS = [Target(1, 4, 3, 2), Target(1, 4, 5, 1)]
AXES = torch.eye(4)
TEMPLATES = {3: AXES[[0] * 6], 5: AXES[[1] * 6], 9: AXES[[2] * 6]}  # each object looks the same in all of its views


def cnos(**fields: object) -> Cnos:
    return build(Cnos, {"describe": Hog(), **fields}, where="detect")


def proposal(x: int, y: int = 0, side: int = 10) -> Proposal:
    mask = np.zeros((60, 200), bool)
    mask[y : y + side, x : x + side] = True
    box = mask_bbox(mask)
    assert box is not None
    return Proposal(box, encode_rle(mask), 0.9)


def like(**cosines: float) -> torch.Tensor:
    """A unit descriptor with the given cosines with objects 3, 5 and 9; the rest is orthogonal to all of them."""
    first = [cosines.get(f"o{obj_id}", 0.0) for obj_id in TEMPLATES]
    return torch.tensor([*first, (1 - sum(c * c for c in first)) ** 0.5])


def found(
    parts: list[tuple[Proposal, torch.Tensor]], templates: Mapping[int, torch.Tensor] = TEMPLATES, **fields: object
) -> list[Detection]:
    described = torch.stack([d for _, d in parts]) if parts else torch.zeros((0, 4))
    image = ImageDescriptors([p for p, _ in parts], described, 1.5)
    return cnos(**fields)(DATASET, TARGETS, Descriptors(templates, lambda image_id: image))


def test_each_proposal_is_assigned_to_the_most_similar_object():
    parts = [(proposal(0), like(o3=0.6, o5=0.3)), (proposal(20), like(o3=0.2, o5=0.9))]
    three, five = found(parts)
    assert (three.obj_id, three.bbox_xyxy, three.rle) == (3, parts[0][0].bbox_xyxy, parts[0][0].rle)
    assert (five.obj_id, five.bbox_xyxy) == (5, parts[1][0].bbox_xyxy)
    assert [three.score, five.score] == pytest.approx([0.6, 0.9], abs=1e-6)
    assert {(d.scene_id, d.im_id, d.time_s, d.defect, d.gt_id) for d in (three, five)} == {(1, 4, 1.5, None, None)}


def test_score_is_the_mean_of_the_five_best_templates():
    views = torch.stack([like(o3=c) for c in (0.9, 0.1, 0.8, 0.3, 0.7, 0.6, 0.2)])
    score = found([(proposal(0), AXES[0])], {**TEMPLATES, 3: views})[0].score
    assert score == pytest.approx(np.mean([0.9, 0.8, 0.7, 0.6, 0.3]), abs=1e-6)
    assert found([(proposal(0), AXES[0])], {**TEMPLATES, 3: views}, best=1)[0].score == pytest.approx(0.9, abs=1e-6)


def test_order_of_proposals_matters_only_for_ties():
    parts = [(proposal(25 * i), like(o3=0.9 - 0.1 * i, o5=0.1 + 0.1 * i)) for i in range(8)]
    assert found(parts, keep="all") == found(parts[::-1], keep="all")


def test_a_target_gets_its_inst_count_best_first():
    parts = [(proposal(25 * i), like(o3=c)) for i, c in enumerate((0.3, 0.9, 0.5))]
    scores = [d.score for d in found(parts) if d.obj_id == 3]
    assert scores == pytest.approx([0.9, 0.5], abs=1e-6)
    assert len([d for d in found(parts, keep=1) if d.obj_id == 3]) == 1
    assert len([d for d in found(parts, keep="all") if d.obj_id == 3]) == 3


def test_overlapping_detections_are_suppressed_within_one_object_only():
    parts = [(proposal(0), like(o3=0.9)), (proposal(3), like(o3=0.8)), (proposal(2), like(o5=0.7))]
    kept = found(parts, keep="all")
    assert [(d.obj_id, d.bbox_xyxy) for d in kept] == [(3, parts[0][0].bbox_xyxy), (5, parts[2][0].bbox_xyxy)]
    assert len(found(parts, keep="all", nms_iou=0.6)) == 3  # 7 of 13 columns are shared


def test_an_image_keeps_at_most_max_per_image():
    parts = [(proposal(25 * i), like(o3=0.9 - 0.1 * i)) for i in range(4)] + [(proposal(120), like(o5=0.3))]
    kept = found(parts, keep="all", max_per_image=3)
    assert [d.obj_id for d in kept if d.defect is None] == [3, 3, 3]
    assert "3 detections of higher score" in kept[-1].defect


@pytest.mark.parametrize(
    ("parts", "reason"),
    [
        ([], "no mask was proposed"),
        ([(proposal(0), like(o5=0.1))], "the best of 1 proposals scores 0.10, needs more than 0.15"),
        ([(proposal(0), like(o9=0.9))], "each of 1 proposals looks more like another object than like object 5"),
    ],
)
def test_a_target_that_is_not_found_says_why(parts: list, reason: str):
    five = found(parts)[-1]
    assert five.obj_id == 5
    assert reason in five.defect
    assert (five.rle, five.score, five.bbox_xyxy) == (None, 0.0, (0.0, 0.0, 0.0, 0.0))


def test_a_detector_says_how_proposals_are_described_or_that_none_are():
    describer = cnos(describe_layer=8).describer
    assert (describer.proposer, describer.extractor, describer.layer) == (Sam(), Hog(), 8)
    assert GtMask().describer is None


@pytest.mark.parametrize(
    ("field", "value"),
    [("min_score", 1.5), ("nms_iou", -0.1), ("best", 0), ("keep", 0), ("max_per_image", 0), ("describe", "dinov2")],
)
def test_bad_field_is_one_line(field: str, value: object):
    with pytest.raises(BadInput, match=f"detect.{field}") as raised:
        cnos(**{field: value})
    assert "\n" not in str(raised.value)


def test_class_token_and_sam_are_the_default():
    assert (cnos().proposals, cnos().describe_layer) == (Sam(), CLASS_TOKEN_LAYER)
