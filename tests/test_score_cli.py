"""``dzop score`` and ``dzop lint`` from the command line."""

import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command import CommandResult, run_dzop
from scipy.spatial.transform import Rotation
from tiny_bop import write_tiny_bop

from pipeline.bop.dataset import open_dataset
from pipeline.bop.results import ResultRow, write_results
from pipeline.functional.rigid import rigid
from pipeline.metrics.recall import average_recall
from pipeline.report.run_records import read_run_records
from pipeline.scoring import Scorer


@pytest.fixture
def dzop(capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    write_tiny_bop(tmp_path / "tiny")
    return lambda *arguments: run_dzop(capsys, monkeypatch, *arguments)


def true_rows(root: Path, name: str = "tiny", models: str = "models") -> list[ResultRow]:
    data = open_dataset(root, name=name, models=models, photographs=False)
    scorer = Scorer(data, data.targets, models)
    return [
        ResultRow(t.scene_id, t.im_id, t.obj_id, 1.0, gt.T_cam_obj, 0.5)
        for t in data.targets
        for gt in scorer.scored_instances(t)
    ]


def rotate(row: ResultRow, angle_deg: float) -> ResultRow:
    R = Rotation.from_rotvec([np.deg2rad(angle_deg), 0, 0]).as_matrix() @ row.T_cam_obj[:3, :3]
    return ResultRow(row.scene_id, row.im_id, row.obj_id, row.score, rigid(R, row.T_cam_obj[:3, 3]), row.time_s)


def to_metres(row: ResultRow) -> ResultRow:
    T = rigid(row.T_cam_obj[:3, :3], row.T_cam_obj[:3, 3] / 1000)
    return ResultRow(row.scene_id, row.im_id, row.obj_id, row.score, T, -1.0)


def figures(dzop, csv: str, *arguments: str, dataset: str = "tiny") -> dict:
    ran: CommandResult = dzop("score", csv, "--dataset", dataset, "--json", "figures.json", *arguments)
    assert ran.status == 0, ran.err
    return json.loads(Path("figures.json").read_text())


def test_ground_truth_scores_one(dzop):
    write_results(Path("gt_tiny-test.csv"), true_rows(Path("tiny")))
    ran = dzop("score", "gt_tiny-test.csv", "--dataset", "tiny")
    assert ran.status == 0
    assert "3 targets in 2 images, 3 of them with an estimate" in ran.out
    scores = figures(dzop, "gt_tiny-test.csv")["metrics"]
    assert (scores["AR_MSSD"], scores["AR_MSPD"], scores["recall_ADD"]) == (1.0, 1.0, 1.0)
    assert scores["AR_VSD"] == 0.75  # a wall hides one of the four boxes
    assert scores["AR"] == pytest.approx((1 + 1 + 0.75) / 3)


def test_vsd_is_not_available_rather_than_zero_where_depth_is_missing(dzop):
    write_results(Path("gt_tiny-test.csv"), true_rows(Path("tiny")))
    Path("tiny/test/000007/depth/000003.png").unlink()
    ran = dzop("score", "gt_tiny-test.csv", "--dataset", "tiny")
    assert "1 of 2 images have no depth image (the first is scene 7, image 3)" in ran.out
    scores = figures(dzop, "gt_tiny-test.csv")
    assert scores["metrics"]["AR"] is scores["metrics"]["AR_VSD"] is None
    assert scores["metrics"]["AR_MSSD"] == 1.0
    assert figures(dzop, "gt_tiny-test.csv", "--no-vsd")["no_vsd"] == "not asked for"


def test_scoring_needs_annotations_and_models_only(dzop):
    """Without photographs and masks, BOP's image width of the dataset is used."""
    write_results(Path("gt_lmo-test.csv"), true_rows(Path("tiny")))
    for folder in ("rgb", "depth", "mask", "mask_visib"):
        for path in Path("tiny/test/000007", folder).iterdir():
            path.unlink()
    assert figures(dzop, "gt_lmo-test.csv")["metrics"]["AR_MSPD"] == 1.0
    Path("gt_lmo-test.csv").rename("gt_own-test.csv")
    ran = dzop("score", "gt_own-test.csv", "--dataset", "tiny")
    assert ran.status == 1
    assert "needs one of them, for its width" in ran.err


def test_the_difference_to_another_csv_is_paired(dzop):
    rows = true_rows(Path("tiny"))
    write_results(Path("gt_tiny-test.csv"), rows)
    write_results(Path("off_tiny-test.csv"), [rotate(row, 20) for row in rows])
    against = figures(dzop, "off_tiny-test.csv", "--no-vsd", "--against", "gt_tiny-test.csv")["against"]
    assert against["csv"] == "gt_tiny-test.csv"
    assert -1 < against["low"] <= against["mean"] <= against["high"] < 0


@pytest.mark.parametrize("t", [(1e300, 0, 1e300), (0, 0, 0), (0, 0, -500), (1e9, 0, 1e-9)])
def test_a_pose_far_off_is_a_miss_without_a_warning(dzop, t, recwarn):
    rows = true_rows(Path("tiny"))
    far = [ResultRow(r.scene_id, r.im_id, r.obj_id, 1.0, rigid(np.eye(3), np.array(t, float)), 0.5) for r in rows]
    write_results(Path("far_tiny-test.csv"), far)
    scores = figures(dzop, "far_tiny-test.csv")["metrics"]
    assert (scores["AR_MSSD"], scores["AR_MSPD"], scores["recall_ADI"]) == (0.0, 0.0, 0.0)
    assert not [w for w in recwarn if issubclass(w.category, RuntimeWarning)]


def test_the_record_for_the_report_has_the_scores(dzop):
    write_results(Path("other_tiny-test.csv"), true_rows(Path("tiny")))
    assert dzop("score", "other_tiny-test.csv", "--dataset", "tiny", "--out", "results").status == 0
    (row,) = read_run_records(Path("results"))
    assert (row.method, row.dataset.name, row.dataset.targets) == ("other", "tiny", 4)
    assert row.scores.mssd.all()


def test_rows_of_another_dataset_are_refused_unless_subset_is_given(dzop):
    rows = true_rows(Path("tiny"))
    unknown = ResultRow(7, 99, 1, 1.0, rows[0].T_cam_obj, 0.5)
    write_results(Path("m_tiny-test.csv"), [*rows, unknown])
    ran = dzop("score", "m_tiny-test.csv", "--dataset", "tiny")
    assert ran.status == 1
    assert "found 1 of 5 rows with ids that tiny does not have, the first: scene 7, image 99, object 1" in ran.err
    assert figures(dzop, "m_tiny-test.csv", "--subset")["metrics"]["AR_MSSD"] == 1.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("score", "absent.csv", "--dataset", "tiny"), "absent.csv: found no such file"),
        (("score", "gt_tiny-test.csv", "--dataset", "nowhere"), "nowhere: found no such folder"),
        (("score", "gt_tiny-test.csv", "--dataset", "tiny", "--split", "val"), "(there: test)"),
        (("score", "gt_tiny-test.csv", "--dataset", "tiny", "--targets", "o.json"), "o.json: found no such file"),
        (("score", "gt_tiny-test.csv", "--dataset", "tiny", "--models", "cad"), "needs the folder of object models"),
        (("score", "nan_tiny-test.csv", "--dataset", "tiny"), "nan_tiny-test.csv, line 2, field R"),
        (("score", "header_tiny-test.csv", "--dataset", "tiny"), "header_tiny-test.csv: found no estimate"),
        (("lint", "absent.csv"), "absent.csv: found no such file"),
    ],
)  # fmt: skip
def test_bad_input_is_one_line(dzop, arguments, message):
    write_results(Path("gt_tiny-test.csv"), true_rows(Path("tiny")))
    text = Path("gt_tiny-test.csv").read_text()
    Path("nan_tiny-test.csv").write_text(text.replace("1.0 0.0 0.0 0.0", "nan 0.0 0.0 0.0", 1))
    Path("header_tiny-test.csv").write_text(text.splitlines()[0])
    ran = dzop(*arguments)
    assert ran.status == 1
    assert message in ran.err
    assert "Traceback" not in ran.err


def test_lint_accepts_a_valid_csv(dzop):
    write_results(Path("gt_tiny-test.csv"), true_rows(Path("tiny")))
    ran = dzop("lint", "gt_tiny-test.csv", "--dataset", "tiny")
    assert ran.status == 0
    assert "4 rows, 0 faults, 0 notes" in ran.out


def test_lint_lists_every_fault(dzop):
    rows = true_rows(Path("tiny"))
    write_results(Path("my_method.csv"), [*rows[:3], ResultRow(7, 5, 9, 1.0, rows[0].T_cam_obj, 0.5)])
    lines = Path("my_method.csv").read_text().splitlines()
    lines[1] = lines[1].replace("1.0 0.0 0.0 0.0 1.0", "1.0 0.0 0.0 0.0 1.2")
    lines[2] = lines[2].removesuffix("0.5") + "0.9"
    lines.append("7,3,2,1.0,1 0 0 0 1 0 0 0 1,0 0 1")
    Path("my_method.csv").write_text("\n".join(lines))
    ran = dzop("lint", "my_method.csv", "--dataset", "tiny")
    assert ran.status == 1
    for part in (
        "needs <method>_<dataset>-<split>.csv",
        "line 2, field R: found a matrix whose R R^T differs from the identity",
        "line 4, field time: found 0.5 after 0.9",
        "line 6: found 6 columns",
        "found scene 7, image 5",
        "found object 9",
        "targets have no estimate",
    ):
        assert part in ran.out, part
    assert "found 6 faults" in ran.err


def test_lint_notes_single_rows_to_metres(dzop):
    first, *others = true_rows(Path("tiny"))
    write_results(Path("m_tiny-test.csv"), [replace(to_metres(first), time_s=first.time_s), *others])
    ran = dzop("lint", "m_tiny-test.csv", "--dataset", "tiny")
    assert ran.status == 0
    assert "note:  t of 1 rows is shorter than 20 mm (in metres?)" in ran.out
    assert "0 faults, 1 note\n" in ran.out


def test_lint_notices_metres_and_rounded_rotations(dzop):
    rows = [rotate(row, 10) for row in true_rows(Path("tiny"))]
    small = [to_metres(row) for row in rows]
    write_results(Path("m_tiny-test.csv"), small)
    ran = dzop("lint", "m_tiny-test.csv")
    assert ran.status == 1
    assert "it looks like metres" in ran.out
    assert "the time of 4 rows is unknown" in ran.out
    rounded = [ResultRow(r.scene_id, r.im_id, r.obj_id, 1.0, np.round(r.T_cam_obj, 2), 0.5) for r in rows]
    write_results(Path("m_tiny-test.csv"), rounded)
    ran = dzop("lint", "m_tiny-test.csv", "--dataset", "tiny")
    assert ran.status == 0
    assert "few digits?" in ran.out


@pytest.mark.slow
def test_lmo_is_scored_at_a_hundred_targets_a_minute_or_more(bop_mini):
    """855 estimates: 285 targets, a fifth of LM-O's test set, each rotated by three angles."""
    root = bop_mini / "lmo"
    data = open_dataset(root, name="lmo", models="models_eval", photographs=False)
    scorer, rows = Scorer(data, data.targets, "models_eval"), true_rows(root, "lmo", "models_eval")
    start = time.perf_counter()
    recalls = [average_recall(scorer.score([rotate(row, angle) for row in rows]).scores) for angle in (5, 20, 90)]
    assert time.perf_counter() - start < 3 * 285 / 100 * 60
    assert [r.mspd for r in recalls] == sorted((r.mspd for r in recalls), reverse=True)
    assert recalls[0].mssd > 0.9
    assert recalls[-1].mssd < 0.2
