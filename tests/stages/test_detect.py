import gzip
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from PIL import Image
from tiny_bop import SIZE_HW, edit_json, rectangle, write_json, write_tiny_bop

from pipeline.bop.dataset import Dataset, open_dataset
from pipeline.bop.masks import decode_rle
from pipeline.errors import BadInput
from pipeline.functional.camera import mask_bbox
from pipeline.items.views import Detection, Target
from pipeline.spec import build, digest
from pipeline.stages.detect.gt_bbox import GtBbox
from pipeline.stages.detect.gt_mask import GtMask
from pipeline.stages.detect.json import Json

CONF = Path(__file__).parents[2] / "conf" / "detect"
AREA = SIZE_HW[0] * SIZE_HW[1]


@pytest.fixture
def tiny(tmp_path: Path) -> Dataset:
    return open_dataset(write_tiny_bop(tmp_path / "tiny"), name="tiny")


def entry(**changes: Any) -> dict[str, Any]:
    """A detection of object 2 in image 3, columns 10 to 13, rows 5 to 24."""
    counts = [10 * 48 + 5]
    for _ in range(3):
        counts += [20, 28]
    counts += [20, AREA - sum(counts) - 20]
    ids = {"scene_id": 7, "image_id": 3, "category_id": 2}
    return (
        ids
        | {
            "score": 0.5,
            "time": 0.2,
            "bbox": [10, 5, 4, 20],
            "segmentation": {"size": list(SIZE_HW), "counts": counts},
        }
        | changes
    )


@pytest.fixture
def detected(tiny: Dataset, tmp_path: Path) -> Callable[..., list[Detection]]:
    def run(*entries: dict[str, Any], **fields: Any) -> list[Detection]:
        write_json(tmp_path / "d.json", list(entries))
        return Json(path=str(tmp_path / "d.json"), **fields)(tiny, [t for t in tiny.targets if t.im_id == 3])

    return run


@pytest.mark.parametrize("variant", [GtMask(), GtMask(visible=False), GtBbox(), GtBbox(bbox="obj")])
def test_detections_of_a_target_do_not_depend_on_other_targets(tiny: Dataset, variant: GtMask | GtBbox):
    together = variant(tiny, tiny.targets)
    assert together == [d for target in tiny.targets for d in variant(tiny, [target])]
    assert len(together) == sum(t.inst_count for t in tiny.targets)


def test_order_of_a_detections_file_does_not_matter(detected: Callable[..., list[Detection]]):
    entries = [entry(score=s) for s in (0.2, 0.9, 0.4)]
    assert detected(*entries, keep="all") == detected(*entries[::-1], keep="all")


def test_equivalent_notations_of_a_detection_are_read_equally(tiny: Dataset, tmp_path: Path):
    compressed = {"size": list(SIZE_HW), "counts": None}
    write_json(tmp_path / "list.json", [entry()])
    (plain,) = Json(path=str(tmp_path / "list.json"))(tiny, tiny.targets)
    compressed["counts"] = plain.rle["counts"]
    write_json(tmp_path / "string.json", [entry(segmentation=compressed)])
    (tmp_path / "list.json.gz").write_bytes(gzip.compress((tmp_path / "list.json").read_bytes()))
    for name in ("string.json", "list.json.gz"):
        assert Json(path=str(tmp_path / name))(tiny, tiny.targets) == [plain]
    mask = np.zeros(SIZE_HW, dtype=bool)
    mask[5:25, 10:14] = True
    np.testing.assert_array_equal(decode_rle(plain.rle), mask)
    assert plain.bbox_xyxy == (9.5, 4.5, 13.5, 24.5) == mask_bbox(mask)
    assert (plain.score, plain.time_s, plain.gt_id, plain.defect) == (0.5, 0.2, None, None)


def test_key_depends_on_the_bytes_of_the_file_not_its_path(tmp_path: Path):
    (tmp_path / "a").mkdir()
    for path in (tmp_path / "a" / "x.json", tmp_path / "y.json"):
        write_json(path, [entry()])
    first, second = Json(path=str(tmp_path / "a" / "x.json")), Json(path=str(tmp_path / "y.json"))
    assert digest(first.recipe()) == digest(second.recipe())
    write_json(tmp_path / "y.json", [entry(score=0.6)])
    assert digest(first.recipe()) != digest(second.recipe())


def test_ground_truth_masks_are_those_of_the_files(tiny: Dataset):
    detections = GtMask()(tiny, tiny.targets)
    assert [(d.im_id, d.obj_id, d.gt_id) for d in detections] == [(0, 1, 1), (0, 1, 0), (0, 2, 2), (3, 2, 0)]
    for d in detections:
        np.testing.assert_array_equal(decode_rle(d.rle), tiny.mask(7, d.im_id, d.gt_id))
        assert d.bbox_xyxy == mask_bbox(decode_rle(d.rle))
        assert (d.score, d.defect) == (1.0, None)


def test_ground_truth_boxes_come_without_masks(tiny: Dataset):
    for d in GtBbox()(tiny, tiny.targets):
        assert d.rle is None
        assert d.bbox_xyxy == mask_bbox(tiny.mask(7, d.im_id, d.gt_id))


def test_inst_count_keeps_the_most_visible_instances(tiny: Dataset):
    (best,) = GtMask()(tiny, [Target(7, 0, 1, 1)])
    assert best.gt_id == 1  # visible to 1.0, the other to 0.5


@pytest.mark.parametrize(("keep", "scores"), [("inst_count", [0.9]), (2, [0.9, 0.4]), ("all", [0.9, 0.4, 0.2])])
def test_best_scored_detections_of_a_target_are_kept(detected, keep: object, scores: list[float]):
    assert [d.score for d in detected(*(entry(score=s) for s in (0.2, 0.9, 0.4)), keep=keep)] == scores


def test_detections_without_a_target_are_ignored(detected: Callable[..., list[Detection]]):
    others = [entry(image_id=999), entry(category_id=77), entry(scene_id=1, segmentation="broken")]
    assert detected(*others, entry()) == detected(entry())


def test_box_without_a_mask_is_a_detection(detected: Callable[..., list[Detection]]):
    without = entry()
    del without["segmentation"], without["time"]
    (d,) = detected(without)
    assert (d.rle, d.bbox_xyxy, d.time_s, d.defect) == (None, (9.5, 4.5, 13.5, 24.5), -1.0, None)


def test_mask_without_a_box_gets_the_box_of_its_pixels(detected: Callable[..., list[Detection]]):
    without = entry()
    del without["bbox"]
    assert detected(without) == detected(entry())


@pytest.mark.parametrize(
    ("changes", "part"),
    [
        ({"score": float("nan")}, "score is NaN"),
        ({"score": "0.9"}, 'score is "0.9"'),
        ({"bbox": [1, 2, 10**400, 3]}, "not 4 numbers"),
        ({"bbox": [1, 2, float("inf"), 3]}, "not finite"),
        ({"bbox": [1, 2, 3]}, "not 4 numbers"),
        ({"bbox": [1, 2, 0, 3], "segmentation": None}, "no area"),
        ({"bbox": [900, 2, 5, 3], "segmentation": None}, "outside the image of 64 x 48"),
        ({"segmentation": {"size": [64, 48], "counts": [AREA]}}, "mask of [64, 48] where the image is [48, 64]"),
        ({"segmentation": {"size": list(SIZE_HW), "counts": [AREA]}}, "mask is empty"),
        ({"segmentation": {"size": list(SIZE_HW), "counts": [AREA - 1]}}, f"cover {AREA - 1} pixels"),
        ({"segmentation": "rle"}, "not an RLE"),
        ({"segmentation": [[1, 2, 3, 4, 5]]}, "polygon has 5 numbers"),
        ({"segmentation": [[0.1, 0.1, 0.9, 0.1, 0.9, 0.8]]}, "not in pixels"),
        ({"segmentation": [[1, 2, 3, 4, 1e300, 6]]}, "far outside the image"),
    ],
)
def test_one_bad_detection_is_recorded_and_the_others_are_kept(detected, changes: dict[str, Any], part: str):
    bad, good = detected(entry(**changes), keep=2), detected(entry(**changes), entry(score=0.1), keep=2)
    assert len(bad) == 1
    assert part in bad[0].defect
    assert [d.defect is None for d in good] == [True, False]
    assert [d.defect for d in detected(entry(**changes), entry(score=0.1))] == [None]  # one place: the usable one


@pytest.mark.parametrize(
    ("damage", "part"),
    [
        (lambda path: path.unlink(), "no such file"),
        (lambda path: path.write_bytes(path.read_bytes()[:60]), "broken image"),
        (lambda path: Image.new("L", (64, 48)).save(path), "mask is empty"),
        (lambda path: Image.new("L", (32, 24), 255).save(path), "mask of [24, 32] where the image is [48, 64]"),
    ],
)
def test_bad_ground_truth_mask_is_recorded_and_the_others_are_kept(tiny: Dataset, damage, part: str):
    whole = GtMask()(tiny, tiny.targets)
    damage(tiny.mask_path(7, 0, 2))
    now = GtMask()(tiny, tiny.targets)
    assert [d.defect is None for d in now] == [True, True, False, True]
    assert part in now[2].defect
    assert str(tiny.root) not in now[2].defect  # kept in a store, which knows no places
    assert "\n" not in now[2].defect
    assert [d for d in now if not d.defect] == [d for d in whole if d.gt_id != 2]


def test_invisible_instance_has_no_box(tmp_path: Path):
    root = write_tiny_bop(tmp_path / "tiny")
    path = root / "test" / "000007" / "scene_gt_info.json"
    edit_json(path, lambda info: info["3"][0].update(bbox_visib=[-1, -1, -1, -1]))
    dataset = open_dataset(root, name="tiny")
    (d,) = GtBbox()(dataset, [Target(7, 3, 2)])
    assert d.defect == "bbox_visib has no area"
    (d,) = GtBbox(bbox="obj")(dataset, [Target(7, 3, 2)])
    x0, y0, x1, y1 = rectangle(2, (10.0, 0.0, 400.0))
    assert (d.defect, d.bbox_xyxy) == (None, (x0 - 0.5, y0 - 0.5, x1 + 0.5, y1 + 0.5))


def test_sources_are_the_files_that_detections_depend_on(tiny: Dataset, tmp_path: Path):
    scene = tiny.root / "test" / "000007"
    annotations = [scene / "scene_gt.json", scene / "scene_gt_info.json"]
    target = [Target(7, 0, 2)]
    assert GtBbox().sources(tiny, target) == annotations
    photograph, mask = scene / "rgb" / "000000.png", "000000_000002.png"
    assert GtMask().sources(tiny, target) == [*annotations, photograph, scene / "mask_visib" / mask]
    assert GtMask(visible=False).sources(tiny, target) == [*annotations, photograph, scene / "mask" / mask]
    assert Json(path=str(tmp_path / "d.json")).sources(tiny, target) == [tmp_path / "d.json", photograph]


@pytest.mark.parametrize(
    ("content", "parts"),
    [
        (None, ["no such file"]),
        ("[{]", ["invalid JSON at line 1"]),
        ('{"annotations": []}', ["a list of detections"]),
        ("[3]", ["detection 0", "scene_id"]),
        ('[{"scene_id": 7, "image_id": 3}]', ["detection 0", "category_id"]),
        ('[{"scene_id": 7, "image_id": "3a", "category_id": 2, "bbox": []}]', ["detection 0", "image_id", "integer"]),
        ('[{"score": 1}, {"scene_id": 7, "image_id": 3, "category_id": 2, "bbox": []}]', ["detection 0", "scene_id"]),
        (
            '[{"scene_id": 7, "image_id": 3, "category_id": 2, "bbox": [], "score": 1},'
            ' {"scene_id": 7, "image_id": 3, "category_id": 2, "bbox": []}]',
            ["detection 1", "score"],
        ),
        ('{"detections": [], "model": "x"}', ["the fields detections, model", "COCO annotation file"]),
        ('{"images": [], "categories": []}', ["field annotations", "images, categories"]),
        ('{"images": [{"id": [1]}], "annotations": []}', ["image 0, field id", "integer"]),
        ('[{"scene_id": 7, "image_id": 3, "category_id": 2, "score": 1}]', ["detection 0", "bbox"]),
    ],
)
def test_file_in_another_format_is_one_line(tiny: Dataset, tmp_path: Path, content: str | None, parts: list[str]):
    path = tmp_path / "d.json"
    if content is not None:
        path.write_text(content)
    with pytest.raises(BadInput) as raised:
        Json(path=str(path))(tiny, tiny.targets)
    for part in [str(path), *parts]:
        assert part in str(raised.value)


def test_broken_gzip_is_one_line(tiny: Dataset, tmp_path: Path):
    path = tmp_path / "d.json.gz"
    path.write_bytes(gzip.compress(b"[]" * 100)[:-12])
    with pytest.raises(BadInput, match="readable JSON"):
        Json(path=str(path))(tiny, tiny.targets)


def test_no_path_says_which_field_is_missing(tiny: Dataset):
    with pytest.raises(BadInput, match=r"detect\.path"):
        Json().recipe()


@pytest.mark.parametrize(
    ("cls", "field", "value"),
    [(GtBbox, "bbox", "full"), (Json, "keep", 0), (Json, "keep", "most"), (GtMask, "visible", "yes")],
)
def test_bad_field_is_one_line(cls: type, field: str, value: object):
    with pytest.raises(BadInput, match=f"detect.{field}") as raised:
        build(cls, {field: value}, where="detect")
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(("name", "cls"), [("gt_mask", GtMask), ("gt_bbox", GtBbox), ("json", Json)])
def test_yaml_lists_every_field_with_its_default(name: str, cls: type):
    values = yaml.safe_load((CONF / f"{name}.yaml").read_text())
    assert values.pop("_target_") == f"{cls.__module__}.{cls.__name__}"
    assert build(cls, values, where="detect") == cls()
    assert set(values) == {field.name for field in fields(cls)}
    assert cls.kind == f"detect.{name}"


def test_sam_detections_of_lmo_are_all_read(bop_mini: Path):
    dataset = open_dataset(bop_mini / "lmo", name="lmo")
    path = bop_mini / "lmo" / "detections" / "sam_lmo-test.json"
    detections = Json(path=str(path))(dataset, dataset.targets)
    assert len(detections) == 268  # the file has 10 more, of objects that the targets do not ask for
    assert [d for d in detections if d.defect] == []
    for d in detections[:20]:
        assert d.bbox_xyxy == mask_bbox(decode_rle(d.rle))


def test_visible_masks_of_lmo_give_a_detection_for_every_target(bop_mini: Path):
    dataset = open_dataset(bop_mini / "lmo", name="lmo")
    detections = GtMask()(dataset, dataset.targets)
    assert [(d.scene_id, d.im_id, d.obj_id) for d in detections] == [
        (t.scene_id, t.im_id, t.obj_id) for t in dataset.targets
    ]
    assert [d.defect for d in detections if d.defect] == []
