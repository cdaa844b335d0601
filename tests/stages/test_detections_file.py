"""Detections files whose ids, boxes or masks mean something else than BOP's format says."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from tiny_bop import SIZE_HW, write_json, write_tiny_bop

from pipeline.bop.dataset import Dataset, open_dataset
from pipeline.bop.masks import decode_rle, encode_rle, to_uncompressed
from pipeline.errors import BadInput
from pipeline.items.views import Detection
from pipeline.stages.detect.json import Json

H, W = SIZE_HW
BOXES = {(0, 1): (6, 20, 9, 13), (0, 2): (28, 10, 6, 8), (3, 2): (40, 24, 12, 10)}
"""x, y, width, height of one detection of each target."""
COMPACT = {"scene_id": 7, "score": 0.5, "time": 0.1}

Entries = list[dict[str, Any]]


@pytest.fixture
def tiny(tmp_path: Path) -> Dataset:
    return open_dataset(write_tiny_bop(tmp_path / "tiny"), name="tiny")


@pytest.fixture
def read(tiny: Dataset, tmp_path: Path) -> Callable[[Any], tuple[list[Detection], list[str]]]:
    def read_file(content: Any) -> tuple[list[Detection], list[str]]:
        write_json(tmp_path / "found.json", content)
        detect = Json(path=str(tmp_path / "found.json"), keep="all")
        return detect(tiny, tiny.targets), detect.warnings(tiny, tiny.targets)

    return read_file


@pytest.fixture
def refusal(read) -> Callable[[Any], str]:
    def message(content: Any) -> str:
        with pytest.raises(BadInput) as raised:
            read(content)
        assert "\n" not in str(raised.value)
        return str(raised.value)

    return message


def ellipse(box: tuple[int, ...]) -> np.ndarray:
    """A mask that fills the box as an ellipse."""
    x, y, w, h = box
    ys, xs = np.mgrid[:H, :W]
    return ((xs - x - (w - 1) / 2) / (w / 2)) ** 2 + ((ys - y - (h - 1) / 2) / (h / 2)) ** 2 <= 1


def entries(*, masks: bool = True) -> Entries:
    result = []
    for (im_id, obj_id), box in BOXES.items():
        record = COMPACT | {"image_id": im_id, "category_id": obj_id, "bbox": list(box)}
        result.append(record | ({"segmentation": to_uncompressed(encode_rle(ellipse(box)))} if masks else {}))
    return result


def change_boxes(change: Callable[..., list[float]], *, masks: bool) -> Entries:
    return [record | {"bbox": change(*record["bbox"])} for record in entries(masks=masks)]


def test_right_file_has_no_warnings(read):
    detections, warnings = read(entries())
    assert len(detections) == 3
    assert warnings == []


def test_boxes_of_full_silhouettes_beside_visible_masks_are_right(read):
    visible = [record | {"segmentation": encode_rle(ellipse((x, y, w // 2, h // 2)))} for record, (x, y, w, h) in
               zip(entries(), BOXES.values(), strict=True)]  # fmt: skip
    assert read(visible)[1] == []


@pytest.mark.parametrize(
    ("change", "part"),
    [
        (lambda x, y, w, h: [x, y, x + w, y + h], "two corners"),
        (lambda x, y, w, h: [x + w / 2, y + h / 2, w, h], "centre and size"),
        (lambda x, y, w, h: [y, x, y + h, x + w], "corners with y before x"),
        (lambda x, y, w, h: [x / W, y / H, w / W, h / H], "parts of the image's size"),
    ],
)
def test_boxes_in_another_format_are_recognised_by_their_masks(refusal, read, change, part: str):
    text = refusal(change_boxes(change, masks=True))
    assert part in text
    assert "field bbox" in text
    assert "detection 0" in text
    one_wrong = [change_boxes(change, masks=True)[0], *entries()[1:]]
    _, warnings = read(one_wrong)
    assert "1 of 3 boxes disagree with their masks (detection 0" in warnings[0]


@pytest.mark.parametrize(
    ("change", "part"),
    [
        (lambda x, y, w, h: [x + 10, y + 12, x + w + 12, y + h + 12], "two corners"),
        (lambda x, y, w, h: [x / W, y / H, w / W, h / H], "parts of the image's size"),
        (lambda x, y, w, h: [x / W, y / H, (x + w) / W, (y + h) / H], "parts of the image's size"),
    ],
)
def test_boxes_in_another_format_are_recognised_without_masks(refusal, change, part: str):
    assert part in refusal(change_boxes(change, masks=False))


def test_corners_that_stay_in_the_image_and_few_boxes_outside_are_warnings(read):
    (*_, warning) = read(change_boxes(lambda x, y, w, h: [x / 4, y / 4, x / 2 + w / 4, y / 2 + h / 4], masks=False))[1]
    assert "two corners" in warning
    assert (
        "boxes leave their images" in read(change_boxes(lambda x, y, w, h: [3 * x + 40, y, w, h], masks=False))[1][-1]
    )


@pytest.mark.parametrize("order", [(1, 2, 0), (2, 0, 1)])
def test_boxes_of_other_objects_masks_are_refused(refusal, order: tuple[int, ...]):
    boxes = [record["bbox"] for record in entries()]
    mixed = [record | {"bbox": boxes[i]} for record, i in zip(entries(), order, strict=True)]
    assert "lie away from their masks (3 of 3" in refusal(mixed)


def test_one_box_of_another_object_is_a_warning(read):
    first, *others = entries()
    assert "detection 0 lies beside its mask" in read([first | {"bbox": [40, 4, 9, 9]}, *others])[1][0]


@pytest.mark.parametrize("with_boxes", [True, False])
@pytest.mark.parametrize("compressed", [True, False])
def test_runs_along_rows_are_refused(refusal, with_boxes: bool, compressed: bool):
    found = entries()
    for record, box in zip(found, BOXES.values(), strict=True):
        runs_along_rows = ellipse(box).reshape(W, H).T
        rle = encode_rle(runs_along_rows)
        record["segmentation"] = rle if compressed else to_uncompressed(rle)
        if not with_boxes:
            del record["bbox"]
    text = refusal(found)
    assert "runs go along rows in 3 of 3" in text
    assert "down the columns" in text


def test_runs_along_rows_of_a_square_image_are_recognised_by_their_boxes(tmp_path: Path):
    root = write_tiny_bop(tmp_path / "square")
    for path in (root / "test" / "000007" / "rgb").iterdir():
        Image.new("RGB", (W, W)).save(path)
    data, found = open_dataset(root, name="square"), entries()
    for record, (x, y, w, h) in zip(found, BOXES.values(), strict=True):
        mask = np.zeros((W, W), bool)
        mask[x : x + w, y : y + h] = True
        record["segmentation"] = encode_rle(mask)
    write_json(tmp_path / "found.json", found)
    with pytest.raises(BadInput, match="runs go along rows"):
        Json(path=str(tmp_path / "found.json"))(data, data.targets)


@pytest.mark.parametrize(
    ("change", "parts"),
    [
        (lambda r: r | {"category_id": r["category_id"] - 1, "image_id": 99}, ["category_id looks shifted", "+1"]),
        (lambda r: r | {"category_id": r["category_id"] + 1, "image_id": 99}, ["category_id looks shifted", "-1"]),
        (lambda r: r | {"image_id": r["image_id"] + 1}, ["images 1 4", "images 0 3", "image_id looks shifted", "-1"]),
        (lambda r: r | {"scene_id": 48}, ["scenes 48", "scenes 7"]),
        (
            lambda r: r | {"category_id": 7 * (r["category_id"] - 1), "scene_id": 8},
            ["objects 0 7", "objects 1 2", "category_id counts from 0?"],
        ),
        (lambda r: r | {"category_id": 10 * r["category_id"]}, ["objects 10 20", "objects 1 2", "another dataset"]),
    ],
)
def test_file_of_which_nothing_fits_lists_its_ids(refusal, change, parts: list[str]):
    text = refusal([change(record) for record in entries()])
    assert "3 detections of which none is of a target" in text
    for part in parts:
        assert part in text


@pytest.mark.parametrize(
    ("change", "part"),
    [
        (lambda r: r | {"category_id": r["category_id"] - 1}, "category_id looks shifted: object ids are +1"),
        (lambda r: r | {"category_id": r["category_id"] + 1}, "category_id looks shifted: object ids are -1"),
    ],
)
def test_shifted_ids_that_fit_by_accident_are_a_warning(read, change, part: str):
    assert any(part in warning for warning in read([change(record) for record in entries()])[1])


def test_file_without_detections_is_a_warning(read):
    detections, warnings = read([])
    assert detections == []
    assert "has no detections" in warnings[0]


@pytest.mark.parametrize(
    "write",
    [str, lambda i: f"{i:06d}", lambda i: f"{i:03d}"],
)
@pytest.mark.parametrize("fields", [("image_id",), ("scene_id", "image_id", "category_id")])
def test_ids_written_as_text_are_read(read, write, fields: tuple[str, ...]):
    text = [record | {name: write(record[name]) for name in fields} for record in entries()]
    assert read(text) == read(entries())


def test_files_without_scores_are_read_with_a_warning(read):
    detections, warnings = read([{k: v for k, v in record.items() if k != "score"} for record in entries()])
    assert [d.score for d in detections] == [1.0] * 3
    assert "no entry has a score" in warnings[0]


@pytest.mark.parametrize("masks", [{}, {"segmentation": None}, {"segmentation": []}])
def test_files_without_masks_are_read_with_a_warning(read, masks: dict[str, Any]):
    detections, warnings = read([record | masks for record in entries(masks=False)])
    assert [(d.rle, d.defect) for d in detections] == [(None, None)] * 3
    assert "no entry has a mask" in warnings[0]


def polygon(box: tuple[int, ...]) -> list[int]:
    x, y, w, h = box
    return [x, y, x + w, y, x + w, y + h, x, y + h]


@pytest.mark.parametrize(
    "write",
    [
        lambda box: [polygon(box)],
        polygon,
        lambda box: np.reshape(polygon(box), (4, 2)).tolist(),
        lambda box: [polygon((*box[:3], 3)), polygon((box[0], box[1] + 3, box[2], box[3] - 3))],
    ],
)
def test_polygons_are_drawn(read, write):
    drawn = [record | {"segmentation": write(record["bbox"])} for record in entries(masks=False)]
    detections, warnings = read(drawn)
    assert warnings == []
    for d, (x, y, w, h) in zip(detections, BOXES.values(), strict=True):
        mask = np.zeros(SIZE_HW, bool)
        mask[y : y + h, x : x + w] = True
        np.testing.assert_array_equal(decode_rle(d.rle), mask)


@pytest.mark.parametrize("box", [(W - 14, 5, 10, 10), (W - 13, 20, 12, 16)])
def test_polygons_with_y_before_x_are_refused(read, box):
    tall = [record | {"segmentation": [np.reshape(polygon(box), (4, 2))[:, ::-1].ravel().tolist()]}
            for record in entries(masks=False)]  # fmt: skip
    for record in tall:
        del record["bbox"]
    with pytest.raises(BadInput, match="y before x"):
        read(tall)


def test_polygons_of_a_larger_image_are_named(read):
    larger = [record | {"segmentation": [polygon((2 * W - 60, 2 * H - 60, 50, 50))]} for record in entries(masks=False)]
    _, warnings = read(larger)
    assert any("polygons leave their images" in warning for warning in warnings)


def coco(file_name: str, *, add: int = 0) -> dict[str, Any]:
    """The entries as a COCO annotation file, image ids raised by ``add``."""
    images = [{"id": i + add, "file_name": file_name.format(i), "width": W, "height": H} for i in (0, 3)]
    names = ("scene_id", "score", "time")
    annotations = [{k: v for k, v in record.items() if k not in names} for record in entries()]
    annotations = [a | {"id": i, "image_id": a["image_id"] + add} for i, a in enumerate(annotations)]
    return {"images": images, "annotations": annotations, "categories": [{"id": 1, "name": "1"}]}


@pytest.mark.parametrize(
    "content",
    [
        coco("rgb/{:06d}.png"),
        coco("000007/rgb/{:06d}.png", add=10),
        coco("{:06d}.jpg", add=5),
        coco("photo of a desk {}.png"),
    ],
)
def test_coco_annotation_files_are_read(read, content: dict[str, Any]):
    detections, warnings = read(content)
    expected, _ = read(entries())
    assert [(d.im_id, d.obj_id, d.rle) for d in detections] == [(d.im_id, d.obj_id, d.rle) for d in expected]
    assert len(warnings) == 1
    assert "no entry has a score" in warnings[0]
