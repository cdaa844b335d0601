import json

import numpy as np
import pytest

from pipeline.errors import BadInput
from pipeline.items.scores import DatasetId, Scores, TemplateError
from pipeline.report.rows import Case, Row, read_row, read_rows, row_id, row_path, write_row


def row(id_: str = "a", at: str = "2026-01-01T00:00:00") -> Row:
    rng = np.random.default_rng(0)
    ids = [np.array([1, 1, 2]), np.array([0, 0, 4]), np.array([1, 2, 1]), np.array([0, 1, 0])]
    hits = [rng.random((3, 10)) < 0.5 for _ in range(2)]
    scores = Scores(*ids, np.array([0.5, np.nan, 1.0]), *hits, None, "no depth")
    return Row(
        id=id_,
        status="done",
        at=at,
        method="dzop-hog",
        config={"cluster": {"count": 40}},
        label={"cluster": "kmeans"},
        dataset=DatasetId("demo", "test", "key", 3, 2, (1, 2)),
        counts={"templates": {"computed": 3, "reused": 0, "time_s": 1.5}},
        failures=(("solve", "too few inliers", 2),),
        metrics={"AR": None, "AR_MSSD": 0.5},
        scores=scores,
        templates={(1, 0, 1, 0): TemplateError(1.0, 2.0, 3.0)},
        cases=(Case("gallery/a.jpg", 1, 0, 1, None, "no pose"),),
    )


def test_a_row_reads_back_as_it_was_written(tmp_path):
    written = row()
    back = read_row(write_row(tmp_path, written))
    for name in ("id", "config", "dataset", "counts", "failures", "metrics", "templates", "cases", "overrides"):
        assert getattr(back, name) == getattr(written, name), name
    np.testing.assert_array_equal(back.scores.mssd, written.scores.mssd)
    assert back.scores.vsd is None
    assert back.scores.no_vsd == "no depth"
    assert [p.name for p in (tmp_path / "rows").iterdir()] == ["a.json"]


def test_rows_come_in_the_order_of_their_time(tmp_path):
    for id_, at in (("a", "2026-01-02"), ("b", "2026-01-01"), ("c", "2026-01-03")):
        write_row(tmp_path, row(id_, at))
    assert [r.id for r in read_rows(tmp_path)] == ["b", "a", "c"]


def test_what_changes_no_answer_changes_no_identity():
    config = {"cluster": {"count": 40}, "out": "a", "threads": 0, "overlays": True, "step": "all"}
    assert row_id(config) == row_id({**config, "out": "b", "threads": 2, "overlays": False, "step": "evaluate"})
    assert row_id(config) != row_id({**config, "cluster": {"count": 80}})


@pytest.mark.parametrize("text", ["", "{}", '{"format": 99}', '{"format": 1, "id": "a"}', "[]", '{"format": 1'])
def test_a_broken_row_is_named(tmp_path, text):
    path = row_path(tmp_path, "a")
    path.parent.mkdir()
    path.write_text(text)
    with pytest.raises(BadInput, match=r"rows/a\.json: found"):
        read_rows(tmp_path)


@pytest.mark.parametrize("field", ["label", "config", "run", "folder", "counts", "times_s", "method", "id", "metrics"])
def test_a_field_of_another_type_is_named(tmp_path, field):
    path = write_row(tmp_path, row())
    record = json.loads(path.read_text())
    path.write_text(json.dumps(record | {field: [1]}))
    with pytest.raises(BadInput, match=f"{field} is no"):
        read_rows(tmp_path)


def test_all_broken_rows_are_counted(tmp_path):
    write_row(tmp_path, row("a"))
    for name in "bcd":
        (tmp_path / "rows" / f"{name}.json").write_text("{")
    with pytest.raises(BadInput, match=r"b\.json: found .*; 2 other files of 4 likewise"):
        read_rows(tmp_path)


def test_no_rows_say_how_to_make_some(tmp_path):
    with pytest.raises(BadInput, match="run step=all"):
        read_rows(tmp_path)
