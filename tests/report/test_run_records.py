import json

import numpy as np
import pytest

from pipeline.errors import BadInput
from pipeline.items.errors import TemplateError
from pipeline.items.scores import DatasetId, Scores
from pipeline.report.run_records import (
    Case,
    RunRecord,
    read_run_record,
    read_run_records,
    run_id,
    run_record_path,
    write_run_record,
)


def record(id_: str = "a", at: str = "2026-01-01T00:00:00") -> RunRecord:
    rng = np.random.default_rng(0)
    ids = [np.array([1, 1, 2]), np.array([0, 0, 4]), np.array([1, 2, 1]), np.array([0, 1, 0])]
    hits = [rng.random((3, 10)) < 0.5 for _ in range(2)]
    scores = Scores(*ids, np.array([0.5, np.nan, 1.0]), *hits, None, "no depth")
    return RunRecord(
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


def test_a_record_reads_back_as_it_was_written(tmp_path):
    written = record()
    back = read_run_record(write_run_record(tmp_path, written))
    for name in ("id", "config", "dataset", "counts", "failures", "metrics", "templates", "cases", "overrides"):
        assert getattr(back, name) == getattr(written, name), name
    np.testing.assert_array_equal(back.scores.mssd, written.scores.mssd)
    assert back.scores.vsd is None
    assert back.scores.no_vsd == "no depth"
    assert [p.name for p in (tmp_path / "rows").iterdir()] == ["a.json"]


def test_records_are_read_oldest_first(tmp_path):
    for id_, at in (("a", "2026-01-02"), ("b", "2026-01-01"), ("c", "2026-01-03")):
        write_run_record(tmp_path, record(id_, at))
    assert [r.id for r in read_run_records(tmp_path)] == ["b", "a", "c"]


def test_settings_that_cannot_change_results_do_not_change_the_id():
    config = {"cluster": {"count": 40}, "out": "a", "threads": 0, "overlays": True, "step": "all"}
    assert run_id(config) == run_id({**config, "out": "b", "threads": 2, "overlays": False, "step": "evaluate"})
    assert run_id(config) != run_id({**config, "cluster": {"count": 80}})


@pytest.mark.parametrize("text", ["", "{}", '{"format": 99}', '{"format": 1, "id": "a"}', "[]", '{"format": 1'])
def test_a_broken_record_is_named(tmp_path, text):
    path = run_record_path(tmp_path, "a")
    path.parent.mkdir()
    path.write_text(text)
    with pytest.raises(BadInput, match=r"rows/a\.json: found"):
        read_run_records(tmp_path)


@pytest.mark.parametrize("field", ["label", "config", "run", "folder", "counts", "times_s", "method", "id", "metrics"])
def test_a_field_of_another_type_is_named(tmp_path, field):
    path = write_run_record(tmp_path, record())
    content = json.loads(path.read_text())
    path.write_text(json.dumps(content | {field: [1]}))
    with pytest.raises(BadInput, match=f"{field} is not"):
        read_run_records(tmp_path)


def test_all_broken_records_are_counted(tmp_path):
    write_run_record(tmp_path, record("a"))
    for name in "bcd":
        (tmp_path / "rows" / f"{name}.json").write_text("{")
    with pytest.raises(BadInput, match=r"b\.json: found .*; 2 other files of 4 are also broken"):
        read_run_records(tmp_path)


def test_missing_records_say_how_to_make_some(tmp_path):
    with pytest.raises(BadInput, match="run step=all"):
        read_run_records(tmp_path)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda content: content.update(folder="../../outside"),
        lambda content: content.update(folder="/etc"),
        lambda content: content["cases"][0].update(file="../../../etc/passwd"),
        lambda content: content["dataset"].update(name="../../"),
        lambda content: content["dataset"].update(split="a/b"),
        lambda content: content.update(method="..\\up"),
    ],
)
def test_a_record_that_leads_out_of_the_results_folder_is_refused(tmp_path, spoil):
    path = write_run_record(tmp_path, record())
    content = json.loads(path.read_text())
    spoil(content)
    path.write_text(json.dumps(content))
    with pytest.raises(BadInput, match=r"lies outside the results folder|is no name"):
        read_run_record(path)
