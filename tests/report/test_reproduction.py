"""The paper's tables and curves with published and measured values side by side."""

from dataclasses import replace

from toy_runs import CONFIG, failed_run, toy_run

from pipeline.report.page import write_report
from pipeline.report.reproduction import reproduction_tables

SD = {"_target_": "pipeline.stages.extract.stable_diffusion.StableDiffusion", "timestep": 50}
BOXES = {"_target_": "pipeline.stages.detect.gt_bbox.GtBbox"}
VARIATIONS = ("no_coprojection", "no_clusters", "no_subpixel")
MASKS = {"_target_": "pipeline.stages.detect.json.Json", "path": "a.json"}


def sd_run(level: float, detect: dict, *, at: int = 0, name: str = "lmo", **changes):
    """A toy run with Stable Diffusion's features; the level decides its recall."""
    run = toy_run(level, at=at, name=name, extract=SD, detect=detect, **changes)
    return replace(run, config=run.config | {"method": "dzop_sd"}, label=run.label | {"detect": "x"})


def test_published_and_measured_values_are_in_columns_side_by_side():
    runs = [
        sd_run(0.5, MASKS),
        sd_run(0.9, MASKS, name="ycbv"),
        sd_run(0.6, BOXES, at=1),
        *(sd_run(0.3 + i / 20, BOXES, at=2 + i, variation=v) for i, v in enumerate(VARIATIONS)),
        *(sd_run(0.2, BOXES, at=9, cluster__count=count) for count in (40, 80)),
    ]
    methods, correspondence, clusters = reproduction_tables(runs)
    assert methods.head[:3] == ("dataset and method", "published AR", "measured AR")
    assert [row[:2] for row in methods.rows] == [("LM-O: DZOP", "0.328"), ("YCB-V: DZOP", "0.365")]
    assert [row[-1] for row in methods.rows] == ["24 of 1445", "24 of 4123"]
    assert [row[:2] for row in correspondence.rows] == [
        ("clusters", "0.149"),
        ("co-projection", "0.427"),
        ("co-projection, clusters", "0.432"),
        ("co-projection, clusters, sub-pixel", "0.433"),
    ]
    assert len({row[2] for row in correspondence.rows}) == 4
    assert [row[:2] for row in clusters.rows] == [("40", "0.4140"), ("80", "0.4282"), ("200", "0.4433")]
    assert {table.source for table in (methods, correspondence, clusters)} == {"both"}


def test_runs_on_other_terms_stand_beside_no_published_value():
    other = replace(sd_run(0.5, MASKS), config=sd_run(0.5, MASKS).config | {"extract": CONFIG["extract"]})
    oracle = sd_run(0.5, CONFIG["detect"])
    assert reproduction_tables([other, oracle, toy_run(0.5), failed_run()]) == []


def test_without_depth_the_measured_value_is_named_for_what_it_is():
    run = sd_run(0.5, MASKS, vsd=False)
    assert reproduction_tables([run])[0].rows[0][2].startswith("AR_MSSD+MSPD 0.")


def test_the_page_begins_with_the_reproduction(tmp_path):
    page = write_report([sd_run(0.5, MASKS), sd_run(0.4, BOXES, at=1)], tmp_path).page.read_text()
    assert page.index("Published and measured") < page.index('id="d-')
    assert (tmp_path / "report" / "tables" / "reproduction_methods.csv").read_text().startswith("source,dataset and")
