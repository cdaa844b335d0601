"""Proposals of small SAM and SAM 2 models with random weights, against a plain loop through the library."""

import json
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F  # noqa: N812
import yaml
from make_sam import SIDE, write_sam
from pycocotools import mask as coco
from safetensors.torch import load_file, save_file
from transformers import Sam2Model, SamModel

from pipeline.bop.masks import decode_rle
from pipeline.errors import BadInput
from pipeline.functional.camera import mask_bbox
from pipeline.items.views import Image, Proposal
from pipeline.spec import Runtime, build, digest
from pipeline.stages.detect.proposals.sam import Sam, compute_stability, make_grid

CPU = Runtime(device="cpu")
ALL = {"points_per_side": 3, "min_iou": 0.0, "min_stability": 0.0, "nms_iou": 1.0, "min_box_size": 0.0}


@pytest.fixture(scope="module", params=[1, 2], ids=["sam", "sam2"])
def folder(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_sam(tmp_path_factory.mktemp("sam") / f"sam{request.param}", version=request.param)


@pytest.fixture(scope="module")
def sam1(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_sam(tmp_path_factory.mktemp("sam") / "sam")


def photograph(h: int = 48, w: int = 80) -> Image:
    blocks = np.random.default_rng(0).integers(0, 256, (h // 8, w // 8, 3))
    return Image(0, 0, np.kron(blocks, np.ones((8, 8, 1))).astype(np.uint8), np.eye(3))


def proposed(folder: Path, image: Image | None = None, batch: int = 0, **fields: object) -> list[Proposal]:
    spec = build(Sam, {"weights": str(folder), **ALL, **fields}, where="detect.proposals")
    return spec.load(Runtime(device="cpu", batch=batch))(image or photograph())


def used_hw(folder: Path, image: Image) -> tuple[int, int]:
    h, w = image.rgb.shape[:2]
    return (round(h * SIDE / max(h, w)), round(w * SIDE / max(h, w))) if is_first(folder) else (SIDE, SIDE)


def library_input(folder: Path, image: Image) -> torch.Tensor:
    used = used_hw(folder, image)
    pixels = torch.from_numpy(image.rgb).movedim(-1, 0)[None].float() / 255
    pixels = F.interpolate(pixels, used, mode="bilinear", antialias=True)
    mean, std = (torch.tensor(v).view(3, 1, 1) for v in ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)))
    return F.pad((pixels - mean) / std, (0, SIDE - used[1], 0, SIDE - used[0]))


def by_plain_loop(folder: Path, image: Image) -> list[tuple[np.ndarray, float, float]]:
    """Mask, predicted IoU and stability of every point's three masks, by one full forward pass per point."""
    model = (SamModel if is_first(folder) else Sam2Model).from_pretrained(folder).eval()
    (h, w), used, pixels = image.rgb.shape[:2], used_hw(folder, image), library_input(folder, image)
    found = []
    for y in (np.arange(3) + 0.5) / 3 * used[0]:
        for x in (np.arange(3) + 0.5) / 3 * used[1]:
            with torch.no_grad():
                out = model(pixel_values=pixels, input_points=torch.tensor([[[[x, y]]]], dtype=torch.float32))
            logits = out.pred_masks[0, 0][None]
            if is_first(folder):
                logits = F.interpolate(logits, (SIDE, SIDE), mode="bilinear")[..., : used[0], : used[1]]
            logits = F.interpolate(logits, (h, w), mode="bilinear")[0]
            for mask, iou in zip(logits, out.iou_scores[0, 0].tolist(), strict=True):
                stable = (mask > 1).sum() / max((mask > -1).sum(), 1)
                found.append(((mask > 0).numpy(), iou, float(stable)))
    return found


def is_first(folder: Path) -> bool:
    return bool(json.loads((folder / "config.json").read_text())["model_type"] == "sam")


def test_proposals_are_those_of_a_plain_loop_through_the_library(folder: Path):
    image = photograph(40, 64) if is_first(folder) else photograph(64, 64)  # sizes at which nothing is resized
    expected = [found for found in by_plain_loop(folder, image) if found[1] > 0 and found[2] > 0 and found[0].any()]
    expected.sort(key=lambda found: -found[1])
    ours = proposed(folder, image)
    assert len(ours) == len(expected) > 3
    np.testing.assert_allclose([p.confidence for p in ours], [iou for _, iou, _ in expected], atol=1e-4)
    # a logit near 0 may fall on either side, and masks of equal confidence may swap
    assert (
        np.median([(decode_rle(p.rle) == mask).mean() for p, (mask, _, _) in zip(ours, expected, strict=True)]) > 0.999
    )


def test_input_is_resized_as_the_library_does(folder: Path):
    image = photograph(96, 160)
    ours = Sam(weights=str(folder)).load(CPU).prepare(image.rgb)
    assert (ours - library_input(folder, image)).abs().max() < 0.018  # Pillow rounds twice to 8 bit: 1 / 255 / 0.224


def test_thresholds_drop_masks_below_them(folder: Path):
    whole = proposed(folder)
    middle = float(np.median([p.confidence for p in whole]))
    assert proposed(folder, min_iou=min(max(middle, 0.0), 1.0)) == [p for p in whole if p.confidence > min(middle, 1.0)]
    least = float(np.median([decode_rle(p.rle).mean() for p in whole]))
    assert proposed(folder, min_mask_size=least) == [p for p in whole if decode_rle(p.rle).mean() > least]
    stable = [s for m, iou, s in by_plain_loop(folder, photograph()) if iou > 0 and m.mean() > 3e-4]
    # a mask near the threshold may fall on either side: see the resized image above
    assert abs(len(proposed(folder, min_stability=0.8)) - sum(s > 0.8 for s in stable)) <= 1


def test_near_duplicates_and_small_boxes_are_dropped(folder: Path):
    few = proposed(folder, nms_iou=0.5)
    assert 0 < len(few) < len(proposed(folder))
    assert few == sorted(few, key=lambda p: -p.confidence)
    assert proposed(folder, min_box_size=0.999) == [
        p for p in proposed(folder) if p.bbox_xyxy == (-0.5, -0.5, 79.5, 47.5)
    ]


def test_boxes_are_those_of_the_masks_and_masks_have_the_size_of_the_image(folder: Path):
    for proposal in proposed(folder):
        assert proposal.rle["size"] == [48, 80]
        assert proposal.bbox_xyxy == mask_bbox(coco.decode(proposal.rle).astype(bool))


def test_masks_do_not_depend_on_the_batch(folder: Path):
    ours, theirs = proposed(folder), proposed(folder, batch=2)
    assert [p.bbox_xyxy for p in ours] == [p.bbox_xyxy for p in theirs]
    np.testing.assert_allclose([p.confidence for p in ours], [p.confidence for p in theirs], atol=1e-5)


def test_an_image_without_a_reliable_mask_has_no_proposal(folder: Path):
    assert proposed(folder, min_stability=1.0) == []


def test_key_depends_on_the_weights_not_their_path(sam1: Path, tmp_path: Path):
    copy = tmp_path / "elsewhere"
    copy.mkdir()
    for path in sam1.iterdir():
        (copy / path.name).write_bytes(path.read_bytes())
    key = digest(Sam(weights=str(sam1)).recipe())
    assert digest(Sam(weights=str(copy)).recipe()) == key
    other = write_sam(tmp_path / "other", seed=1)
    assert digest(Sam(weights=str(other)).recipe()) != key
    assert digest(Sam(weights=str(sam1), points_per_side=16).recipe()) != key


def test_points_are_the_centres_of_equal_cells():
    assert make_grid(2, (40, 80)).tolist() == [[20, 10], [60, 10], [20, 30], [60, 30]]


def test_stability_is_the_overlap_of_two_thresholds():
    logits = torch.tensor([[[-2.0, -0.5, 0.5, 2.0]], [[-2.0, -2.0, -2.0, -2.0]]])
    assert compute_stability(logits, offset=1.0).tolist() == pytest.approx([1 / 3, 0.0])


def test_missing_weights_are_named(tmp_path: Path):
    with pytest.raises(BadInput, match=r"detect\.proposals\.weights: found .*does not exist"):
        Sam(weights=str(tmp_path / "nowhere")).recipe()
    with pytest.raises(BadInput, match=r"config\.json"):
        Sam(weights=str(tmp_path)).recipe()


def test_another_model_is_named(tmp_path: Path):
    (tmp_path / "config.json").write_text('{"model_type": "dinov2"}')
    with pytest.raises(BadInput, match="model_type 'dinov2', needs one of sam, sam2") as raised:
        Sam(weights=str(tmp_path)).recipe()
    assert "\n" not in str(raised.value)


def test_pickled_weights_are_never_opened(sam1: Path, tmp_path: Path):
    (tmp_path / "config.json").write_bytes((sam1 / "config.json").read_bytes())
    (tmp_path / "pytorch_model.bin").write_bytes(b"pickle")
    with pytest.raises(BadInput, match="safetensors"):
        Sam(weights=str(tmp_path)).recipe()


def test_weights_that_lack_a_tensor_or_are_truncated_are_named(sam1: Path, tmp_path: Path):
    (tmp_path / "config.json").write_bytes((sam1 / "config.json").read_bytes())
    tensors = load_file(sam1 / "model.safetensors")
    del tensors["mask_decoder.iou_token.weight"]
    save_file(tensors, tmp_path / "model.safetensors", metadata={"format": "pt"})
    with pytest.raises(BadInput, match=r"no tensor for mask_decoder\.iou_token\.weight \(1 missing\)"):
        Sam(weights=str(tmp_path)).load(CPU)
    whole = (sam1 / "model.safetensors").read_bytes()
    (tmp_path / "model.safetensors").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(BadInput, match="needs a complete safetensors file") as raised:
        Sam(weights=str(tmp_path)).load(CPU)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("field", "value"), [("min_iou", 1.2), ("min_stability", -0.1), ("points_per_side", 0), ("min_box_size", 1.0)]
)
def test_bad_field_is_one_line(field: str, value: object):
    with pytest.raises(BadInput, match=rf"detect\.proposals\.{field}"):
        build(Sam, {field: value}, where="detect.proposals")


def test_yaml_lists_every_field_with_its_default():
    path = Path(__file__).parents[2] / "conf" / "detect" / "proposals" / "sam.yaml"
    values = yaml.safe_load(path.read_text())
    assert values.pop("_target_") == f"{Sam.__module__}.{Sam.__name__}"
    assert set(values) == {field.name for field in fields(Sam)}
    values["weights"] = yaml.safe_load((path.parents[2] / "config.yaml").read_text())["weights"]["sam"]
    assert build(Sam, values, where="detect.proposals") == Sam()


def test_points_with_unreliable_masks_give_no_proposal(folder: Path):
    every = [p.confidence for p in proposed(folder)]
    sure = [p.confidence for p in proposed(folder, batch=1, min_iou=1.0)]  # random weights predict any IoU
    assert sure == pytest.approx([c for c in every if c > 1.0], abs=1e-4)
    assert len(sure) < len(every)
