import csv
import io

import pytest
from toy_runs import toy_run

from pipeline.metrics.recall import average_recall
from pipeline.report import published, tables
from pipeline.report.families import families
from pipeline.report.published_tables import published_tables
from pipeline.report.run_statistics import ar_interval, paired_difference
from pipeline.report.table import Table
from pipeline.report.variation_tables import correspondence_table, ladder_table


def columns(table: Table) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(table.csv())))


def test_a_difference_is_paired_and_starred_if_it_is_significant():
    base, better, same = toy_run(0.4), toy_run(0.6, cluster__count=40), toy_run(0.4, cluster__count=80)
    rows = {row["run"]: row for row in columns(tables.runs_table([base, better, same], base))}
    assert rows["dzop-hog"]["vs base"] == "base"
    assert rows["cluster.count=40"]["vs base"].endswith("*")
    assert rows["cluster.count=80"]["vs base"] == "+0.000 (+0.000 to +0.000)"
    gain = ar_interval(better.scores).mean - ar_interval(base.scores).mean
    assert rows["cluster.count=40"]["vs base"].startswith(f"{gain:+.3f}")


def test_without_vsd_the_mean_of_two_is_not_called_ar():
    row = toy_run(vsd=False)
    (cells,) = columns(tables.runs_table([row], row))
    assert "AR" not in cells
    assert cells["AR_VSD"] == "n/a"
    assert "AR_MSSD+MSPD" in cells


def test_a_run_with_vsd_among_runs_without_shows_the_mean_of_two():
    base, other = toy_run(vsd=False), toy_run(cluster__count=40)
    (_, cells) = sorted(columns(tables.runs_table([base, other], base)), key=lambda row: row["run"], reverse=True)
    assert cells["run"] == "cluster.count=40"
    assert cells["AR_MSSD+MSPD"].split()[0] == f"{average_recall(other.scores).mssd_mspd:.3f}"


def test_no_table_calls_the_mean_of_two_ar():
    concat = {"_target_": "pipeline.stages.fuse.concat.Concat"}
    oracle = {"_target_": "pipeline.stages.match.oracle.Oracle"}
    rows = [
        toy_run(vsd=False),
        toy_run(vsd=False, variation="no_coprojection", fuse=concat, correspond__kernel=1),
        toy_run(vsd=False, variation="oracle_template", match=oracle),
    ]
    family = families([rows[0], toy_run(vsd=False, cluster__count=40)])[0]
    made = [
        correspondence_table([*rows, toy_run(vsd=False, variation="no_subpixel", correspond__kernel=1)]),
        ladder_table(rows),
        tables.improvement_table([("ours", rows[0]), ("theirs", toy_run(vsd=False, method="zs6d"))]),
        tables.family_table(family),
    ]
    for table in made:
        assert "AR" not in table.head
        assert "AR_MSSD+MSPD" in table.head


def test_runs_on_other_instances_have_no_difference():
    assert paired_difference(toy_run(), toy_run(instances=21)) is None
    assert tables.signed_text(None) == "n/a"


def test_the_correspondence_table_has_the_papers_four_rows():
    concat, one = {"_target_": "pipeline.stages.fuse.concat.Concat"}, {"_target_": "pipeline.stages.cluster.one.One"}
    rows = [
        toy_run(0.1, variation="no_coprojection", fuse=concat, correspond__kernel=1),
        toy_run(0.2, variation="no_clusters", cluster=one, correspond__kernel=1),
        toy_run(0.3, variation="no_subpixel", correspond__kernel=1),
        toy_run(0.4),
        toy_run(0.9, cluster__count=40),
    ]
    table = correspondence_table(rows)
    assert [row[:3] for row in table.rows] == [
        ("no", "yes", "no"), ("yes", "no", "no"), ("yes", "yes", "no"), ("yes", "yes", "yes"),
    ]  # fmt: skip
    assert [row[3] for row in table.rows] == [f"{ar_interval(row.scores).mean:.3f}" for row in rows[:4]]
    assert correspondence_table([toy_run(), toy_run(cluster__count=40)]) is None


def test_the_ladder_shows_the_gain_of_each_step():
    oracle = {"_target_": "pipeline.stages.match.oracle.Oracle", "layer": 2, "top_k": 1}
    rows = [
        toy_run(0.2),
        toy_run(0.3, variation="oracle_mask"),
        toy_run(0.6, variation="oracle_template", match=oracle),
    ]
    table = ladder_table(rows)
    assert [row[0] for row in table.rows] == ["as estimated", "true mask", "true mask, template"]
    assert table.rows[0][3] == ""
    assert table.rows[2][3].startswith("+")
    assert ladder_table(rows[:2]) is None


def test_improvements_are_relative_to_the_other_method():
    ours, theirs = toy_run(0.6), toy_run(0.4, method="zs6d-dino")
    (row,) = tables.improvement_table([("dzop-hog", ours), ("zs6d-dino", theirs)]).rows
    assert row[0] == "dzop-hog over zs6d-dino"
    assert row[1] == "+12.5%"  # 14 degrees instead of 16
    before, after = (ar_interval(r.scores).mean for r in (theirs, ours))
    assert row[3] == f"{(after - before) / before:+.1%}"
    assert tables.improvement_table([("dzop-hog", ours)]) is None


def test_the_counts_table_shows_what_jobs_computed_and_reused():
    row = toy_run()
    (cells,) = columns(tables.counts_table([row], row))
    assert cells["template features"] == "0 + 900"
    assert cells["query features"] == "n/a"


def test_every_csv_row_says_whether_it_was_measured_or_published():
    for table in published_tables():
        assert {row["source"] for row in columns(table)} == {"published"}
    base = toy_run()
    family = families([base, toy_run(cluster__count=40)])[0]
    for table in (tables.runs_table([base], base), tables.family_table(family), tables.failures_table([base], base)):
        assert {row["source"] for row in columns(table)} == {"measured"}


def test_latex_special_characters_are_escaped():
    table = tables.failures_table([toy_run()], toy_run())
    assert r"<\&>" in table.latex()
    assert table.latex().count("&") - table.latex().count(r"\&") == 2 * 3
    assert r"50\,\%" not in table.latex()


@pytest.mark.parametrize(
    ("dataset", "method", "object_", "value"), [("lmo", "DZOP", 12, 0.550), ("tless", "ZS6D", 30, 0.8750)]
)
def test_published_objects_are_those_of_the_paper(dataset, method, object_, value):
    assert published.OBJECTS[dataset][method][object_] == value


def test_published_curves_peak_where_the_paper_says():
    """200 clusters, dimension 64, 10 correspondences, timestep 50: the paper's own choice."""
    peaks = {axis: max(points, key=lambda p: p[1])[0] for axis, points in published.ABLATIONS.items()}
    assert peaks == {"cluster.count": 200, "fuse.dim": 64, "correspond.per_cluster": 10, "extract.timestep": 50}
    assert [len(values["DZOP"]) for values in published.OBJECTS.values()] == [8, 21, 30]
