from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.bop.results import ResultRow, make_rows, read_results, results_name, write_results
from pipeline.errors import BadInput
from pipeline.functional.rigid import rigid
from pipeline.items.poses import PoseEstimate

HEADER = "scene_id,im_id,obj_id,score,R,t,time"
LINE = "1,2,3,0.5,1 0 0 0 1 0 0 0 1,1.5 -2 700,0.25"


def pose(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rigid(Rotation.random(random_state=seed).as_matrix(), rng.normal(size=3) * 300)


def estimate(scene_id: int, im_id: int, obj_id: int, score: float) -> PoseEstimate:
    numbers = {"template_id": 0, "template_score": 0.9, "template_margin": 0.1, "correspondences": 9, "inliers": 8}
    ids = {"scene_id": scene_id, "im_id": im_id, "obj_id": obj_id, "detection_id": 0}
    scores = {"score": score, "detection_score": 1.0, "reprojection_px": 1.0}
    return PoseEstimate(T_cam_obj=pose(obj_id), **ids, **scores, **numbers)


def test_rows_read_back_bit_for_bit(tmp_path: Path):
    rows = [ResultRow(1, i, 5, 0.1 * i, pose(i), 1 / 3 + i) for i in range(20)]
    write_results(tmp_path / "r.csv", rows)
    for row, back in zip(rows, read_results(tmp_path / "r.csv"), strict=True):
        written, read = ((r.scene_id, r.im_id, r.obj_id, r.score, r.time_s) for r in (row, back))
        assert written == read
        np.testing.assert_array_equal(row.T_cam_obj, back.T_cam_obj)


def test_file_has_bops_format(tmp_path: Path):
    T = rigid(np.eye(3), np.array([1.5, -2.0, 700.0]))
    write_results(tmp_path / "deep" / "r.csv", [ResultRow(1, 2, 3, 0.5, T, 0.25)])
    text = (tmp_path / "deep" / "r.csv").read_bytes().decode("ascii")
    assert text == f"{HEADER}\n1,2,3,0.5,1.0 0.0 0.0 0.0 1.0 0.0 0.0 0.0 1.0,1.5 -2.0 700.0,0.25\n"
    assert [p.name for p in (tmp_path / "deep").iterdir()] == ["r.csv"]


def test_rows_of_one_image_share_its_time_and_are_sorted():
    estimates = [estimate(2, 7, 5, 0.1), estimate(2, 7, 5, 0.9), estimate(1, 7, 5, 0.3), estimate(2, 7, 1, 0.2)]
    rows = make_rows(estimates, {(2, 7): 1.25})
    assert [(r.scene_id, r.obj_id, r.score, r.time_s) for r in rows] == [
        (1, 5, 0.3, -1.0),
        (2, 1, 0.2, 1.25),
        (2, 5, 0.9, 1.25),
        (2, 5, 0.1, 1.25),
    ]


def test_without_rows_the_file_has_only_a_header(tmp_path: Path):
    write_results(tmp_path / "r.csv", [])
    assert (tmp_path / "r.csv").read_text() == HEADER + "\n"
    assert read_results(tmp_path / "r.csv") == []


@pytest.mark.parametrize("text", [LINE, f"{HEADER}\n{LINE}\n", f"\ufeff{HEADER}\r\n{LINE}\r\n"])
def test_header_line_ends_and_byte_order_mark_may_vary(tmp_path: Path, text: str):
    (tmp_path / "r.csv").write_bytes(text.encode("utf-8"))
    (row,) = read_results(tmp_path / "r.csv")
    assert (row.scene_id, row.im_id, row.obj_id, row.score, row.time_s) == (1, 2, 3, 0.5, 0.25)
    np.testing.assert_array_equal(row.T_cam_obj[:3, 3], [1.5, -2, 700])


def test_rotations_rounded_to_three_decimals_are_read(tmp_path: Path):
    R = " ".join(f"{v:.3f}" for v in pose(4)[:3, :3].ravel())
    (tmp_path / "r.csv").write_text(f"1,2,3,0.5,{R},0 0 700,-1\n")
    assert len(read_results(tmp_path / "r.csv")) == 1


@pytest.mark.parametrize(
    ("lines", "parts"),
    [
        (["obj_id,scene_id,im_id,score,R,t,time", LINE], ["line 1", "scene_id", "'obj_id'"]),
        ([HEADER, LINE.rsplit(",", 1)[0]], ["line 2", "6 columns", HEADER]),
        ([HEADER, LINE.replace("0.5,", "nan,")], ["line 2", "field score", "finite"]),
        ([HEADER, LINE.replace("1.5 -2 700", "1.5 -2")], ["line 2", "field t", "2 numbers", "3 finite numbers"]),
        ([HEADER, LINE.replace("700", "inf")], ["line 2", "field t", "inf"]),
        ([HEADER, LINE.replace("1.5 -2", "1.5 x")], ["line 2", "field t", "x"]),
        ([HEADER, LINE.replace("1 0 0 0 1 0", "1 0 0 0 1.1 0")], ["line 2", "field R", "differs from the identity"]),
        ([HEADER, LINE.replace("0 0 1,", "0 0 -1,")], ["line 2", "field R", "reflection"]),
        ([HEADER, LINE.replace("1,2,3,", "1,2.0,3,")], ["line 2", "field im_id", "'2.0'"]),
        ([HEADER, LINE.replace("1,2,3,", "-1,2,3,")], ["line 2", "field scene_id", "'-1'"]),
        ([HEADER, LINE.replace("0.25", "-0.5")], ["line 2", "field time", "-0.5"]),
        ([HEADER, LINE, LINE.replace("0.25", "0.5")], ["line 3", "field time", "0.5 after 0.25", "image 2"]),
    ],
)
def test_fault_in_a_csv_is_reported_with_line_and_field(tmp_path: Path, lines: list[str], parts: list[str]):
    path = tmp_path / "r.csv"
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(BadInput) as raised:
        read_results(path)
    for part in [str(path), *parts]:
        assert part in str(raised.value)


def test_missing_csv_is_reported_in_one_line(tmp_path: Path):
    with pytest.raises(BadInput, match=r"absent\.csv"):
        read_results(tmp_path / "absent.csv")


def test_file_name_follows_bop():
    assert results_name("dzop", "lmo") == "dzop_lmo-test.csv"
    assert results_name("dzop-x", "tless", "test_primesense") == "dzop-x_tless-test.csv"


@pytest.mark.parametrize(
    "name", ["lm_o", "", "a/b", "=cmd|calc!A0", "-x", "..", "a\0b", "a\nb", "ü", "a" * 81, "$(id)"]
)
def test_unsafe_name_is_refused(name: str):
    with pytest.raises(BadInput, match=r"^method: found .*no underscore"):
        results_name(name, "lmo")
    with pytest.raises(BadInput, match=r"^dataset\.name: found .*no underscore"):
        results_name("dzop", name)


@pytest.mark.parametrize("split", ["", "../test", "test/a", "=1+1", ".", "test test"])
def test_unsafe_split_is_refused(split: str):
    with pytest.raises(BadInput, match=r"^dataset\.split: found"):
        results_name("dzop", "lmo", split)
