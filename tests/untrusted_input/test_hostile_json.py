"""Untrusted JSON: scenes, cameras, targets, models_info, detections and run records."""

import gzip
import json
import os
from pathlib import Path

import numpy as np
import pytest
from hostile import fuzz_settings, message_within, outcome
from hypothesis import given
from hypothesis import strategies as st
from tiny_bop import write_tiny_bop

from pipeline.bop.dataset import open_dataset
from pipeline.bop.jsonio import read_json
from pipeline.bop.masks import encode_rle
from pipeline.errors import BadInput
from pipeline.report.run_records import read_run_records
from pipeline.stages.detect.json import Json

FILES = {
    "scene_camera": "test/000007/scene_camera.json",
    "scene_gt": "test/000007/scene_gt.json",
    "scene_gt_info": "test/000007/scene_gt_info.json",
    "targets": "test_targets_bop19.json",
    "models_info": "models/models_info.json",
}
SPECIAL = (0, -1, 1 << 31, 1 << 63, 10**30, 0.5, -0.0, 1e308, float("nan"), float("inf"), "", "1", "\0", True, None)
SCALARS = st.sampled_from(SPECIAL) | st.integers() | st.floats() | st.text(max_size=5)
VALUES = st.recursive(
    SCALARS,
    lambda inner: (
        st.lists(inner, max_size=16) | st.dictionaries(st.text(max_size=3) | st.just("counts"), inner, max_size=3)
    ),
    max_leaves=16,
)


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    return write_tiny_bop(tmp_path_factory.mktemp("bop") / "tiny")


@pytest.fixture(scope="module")
def detections(root: Path) -> list[dict]:
    mask = np.zeros((48, 64), bool)
    mask[10:20, 10:30] = True
    box = {"scene_id": 7, "image_id": 0, "category_id": 1, "score": 0.5, "bbox": [5, 5, 20, 20], "time": 0.1}
    return [box, box | {"image_id": 3, "category_id": 2, "segmentation": encode_rle(mask)}]


def read_everything(root: Path) -> None:
    """Read everything that a run reads from a dataset."""
    data = open_dataset(root, name="tiny")
    for scene_id, im_id in data.images:
        data.image(scene_id, im_id)
        data.depth_mm(scene_id, im_id)
        data.image_width(scene_id, im_id)
        if data.has_ground_truth(scene_id):
            data.ground_truth(scene_id, im_id)
    for obj_id in data.object_ids:
        data.object_model(obj_id)


def mutate(draw, content):
    """The content with one value replaced, removed or repeated."""
    steps = draw(st.integers(0, 5))
    at, key, parent = content, None, None
    for _ in range(steps):
        if not isinstance(at, (dict, list)) or not at:
            break
        parent, key = at, draw(st.sampled_from(sorted(at) if isinstance(at, dict) else range(len(at))))
        at = parent[key]
    if parent is None:
        return draw(VALUES)
    what = draw(st.sampled_from(["replace", "remove", "add"]))
    if what == "replace":
        parent[key] = draw(VALUES)
    elif what == "remove":
        del parent[key]
    elif isinstance(parent, dict):
        parent[draw(st.text(max_size=4) | st.integers().map(str))] = draw(VALUES)
    else:
        parent.append(draw(VALUES))
    return content


def corrupt(draw, text: str) -> bytes:
    """The text as bytes: unchanged, truncated, with bytes changed, in another encoding, or with a byte order mark."""
    data = bytearray(
        text.encode(draw(st.sampled_from(["utf-8", "utf-8", "utf-8-sig", "utf-16", "latin-1"])), "replace")
    )
    for _ in range(draw(st.integers(0, 3))):
        if data:
            data[draw(st.integers(0, len(data) - 1))] = draw(st.integers(0, 255))
    return bytes(data[: draw(st.integers(0, len(data)))] if draw(st.integers(0, 9)) == 0 else data)


@fuzz_settings(80)
@given(data=st.data())
def test_dataset_is_read_or_rejected_in_one_line(root: Path, data):
    path = root / FILES[data.draw(st.sampled_from(sorted(FILES)))]
    whole = path.read_bytes()
    content = mutate(data.draw, json.loads(whole))
    try:
        path.write_bytes(
            corrupt(data.draw, json.dumps(content)) if data.draw(st.booleans()) else json.dumps(content).encode()
        )
        outcome(lambda: read_everything(root))
    finally:
        path.write_bytes(whole)


@fuzz_settings(100)
@given(data=st.data())
def test_detections_are_read_or_rejected_in_one_line(root: Path, detections, tmp_path_factory, data):
    path = tmp_path_factory.getbasetemp() / "detections.json"
    content = mutate(data.draw, json.loads(json.dumps(detections)))
    path.write_bytes(
        corrupt(data.draw, json.dumps(content)) if data.draw(st.booleans()) else json.dumps(content).encode()
    )
    dataset = open_dataset(root, name="tiny")
    outcome(lambda: Json(path=str(path))(dataset, dataset.targets))


@fuzz_settings(60)
@given(data=st.data())
def test_run_records_are_read_or_rejected_in_one_line(tmp_path_factory, data):
    folder = tmp_path_factory.getbasetemp() / "rows"
    folder.mkdir(exist_ok=True)
    row = {
        "format": 1,
        "id": "a",
        "status": "done",
        "at": "",
        "method": "m",
        "config": {},
        "label": {},
        "dataset": None,
    }
    row |= {"cases": [], "scores": None, "templates": [], "overrides": [], "failures": [], "counts": {}, "times_s": {}}
    text = json.dumps(mutate(data.draw, row))
    (folder / "a.json").write_bytes(corrupt(data.draw, text) if data.draw(st.booleans()) else text.encode())
    outcome(lambda: read_run_records(folder.parent))


def test_deeply_nested_run_record_is_rejected(tmp_path: Path):
    (tmp_path / "rows").mkdir()
    (tmp_path / "rows" / "a.json").write_bytes(b"[" * 100_000)
    assert "a.json: found RecursionError" in outcome(lambda: read_run_records(tmp_path))


HOSTILE = {
    "deep lists": (b"[" * 100_000, "nested too deeply"),
    "deep objects": (b'{"a":' * 100_000, "nested too deeply"),
    "deep enough for the parser alone": (b"[" * 900 + b"]" * 900, ""),
    "an integer of a million digits": (b"[" + b"9" * 1_000_000 + b"]", "4300 digits"),
    "an id of a million digits": (b'{"' + b"9" * 1_000_000 + b'": 1}', ""),
    "a name twice": (b'{"1": 1, "2": 0, "1": 2}', "the name '1' twice"),
    "zero bytes": (b"\0" * 4096, "invalid JSON"),
    "utf-16": ('{"1": 1}'.encode("utf-16"), "UnicodeDecodeError"),
    "nothing": (b"", "invalid JSON at line 1"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_json_is_message_within_limits(root: Path, tmp_path: Path, case: str):
    content, said = HOSTILE[case]
    write_tiny_bop(tmp_path / "tiny")
    (tmp_path / "tiny" / FILES["models_info"]).write_bytes(content)
    message = message_within(lambda: read_everything(tmp_path / "tiny"), seconds=5, megabytes=512)
    assert "models_info.json" in message
    assert said in message


@pytest.mark.parametrize("name", ["²", "1²", "", "--1", "1_0", " 1", "1.0", "9" * 5000])
def test_key_that_is_not_an_id_is_reported(tmp_path: Path, name: str):
    write_tiny_bop(tmp_path / "tiny")
    (tmp_path / "tiny" / FILES["scene_camera"]).write_text(json.dumps({name: {}}))
    message = outcome(lambda: read_everything(tmp_path / "tiny"))
    assert f"found the key {name[:40]!r}, needs integer ids as keys" in message


def test_id_written_in_two_ways_is_rejected(tmp_path: Path):
    write_tiny_bop(tmp_path / "tiny")
    (tmp_path / "tiny" / FILES["scene_camera"]).write_text('{"0": {}, "00": {}}')
    assert "an id written in two ways" in outcome(lambda: read_everything(tmp_path / "tiny"))


def test_byte_order_mark_is_ignored(tmp_path: Path):
    write_tiny_bop(tmp_path / "tiny")
    for name in FILES.values():
        path = tmp_path / "tiny" / name
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert outcome(lambda: read_everything(tmp_path / "tiny")) == "read"


def test_decompression_bomb_is_rejected(tmp_path: Path):
    path = tmp_path / "bomb.json.gz"
    with gzip.open(path, "wb", compresslevel=1) as stream:
        stream.write(b"[" + b" " * (200 << 20) + b"]")
    assert path.stat().st_size < 1 << 20
    message = message_within(lambda: read_json(path), seconds=5, megabytes=160)
    assert "decompress to more than" in message


def test_compressed_detections_can_be_read(tmp_path: Path):
    path = tmp_path / "fine.json.gz"
    content = [{"scene_id": i, "bbox": [0, 0, i, i]} for i in range(2000)]
    path.write_bytes(gzip.compress(json.dumps(content).encode()))
    assert read_json(path) == content


def test_reading_a_pipe_does_not_block(tmp_path: Path):
    os.mkfifo(tmp_path / "pipe.json")
    with pytest.raises(BadInput, match="not a regular file"):
        read_json(tmp_path / "pipe.json")
