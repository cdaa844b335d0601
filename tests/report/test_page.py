import re
import time
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from toy_runs import failed_run, toy_run

from pipeline.errors import BadInput
from pipeline.report.page import _breakable, write_report
from pipeline.report.run_records import Case, read_run_records, write_run_record
from pipeline.report.section import Section, sections_of

LIMIT_BYTES = 15_000_000


def page(rows, out) -> str:
    return write_report(rows, out).page.read_text()


@pytest.fixture(scope="module")
def rows():
    return [toy_run(0.5), *(toy_run(0.3 + n / 1000, at=n // 10, cluster__count=n) for n in (40, 80, 130)), failed_run()]


@pytest.fixture(scope="module")
def built(rows, tmp_path_factory):
    """The results folder of a page that several tests look at, and its text."""
    out = tmp_path_factory.mktemp("results")
    noted = replace(rows[0], notice="random weights: nothing was learned")
    return out, page([noted, *rows[1:]], out)


def test_a_page_stands_by_itself_and_comes_with_its_figures_and_tables(built):
    tmp_path, text = built
    assert not re.search(r"""(src|href)=["'](?!data:|#)""", text.replace('xlink:href="#', ""))
    assert "<script" not in text
    assert "@import" not in text
    assert "url(http" not in text
    figures = {path.suffix for path in (tmp_path / "report" / "figures").rglob("*.*")}
    assert figures == {".png", ".pdf"}
    names = {path.name for path in (tmp_path / "report" / "tables").rglob("*.*")}
    assert {"runs.csv", "runs.tex", "ablation_cluster_count.csv", "published_methods.csv"} <= names
    assert not list((tmp_path / "report").rglob("*.partial"))


def test_the_same_rows_give_the_same_page_but_for_its_date(rows, tmp_path):
    first, second = (re.sub(r"Written [^<]*by", "", page(rows[:2], tmp_path / name)) for name in "ab")
    assert first == second


def test_a_failed_job_is_told_first(built):
    _, text = built
    told = text.index("cluster.count: found -1, needs greater than or equal to 1")
    assert told < text.index("<main>")
    assert "cluster.count=-1 sweep=clusters" in text


def test_published_numbers_stand_in_tables_of_their_own(built):
    _, text = built
    for block in re.findall(r'<figure class="table (measured|published)">(.*?)</figure>', text, flags=re.DOTALL):
        kind, body = block
        assert ("published, not measured here" in body) == (kind == "published")
        assert ("GigaPose" in body) <= (kind == "published")
    assert text.count("published, LM-O") >= 2  # theta and clusters, below their measured curves


def test_what_a_run_says_is_text_and_no_markup(built):
    assert "needs 6 &lt;&amp;&gt;" in built[1]


def test_runs_on_other_targets_have_a_part_of_their_own(rows, tmp_path):
    other = [toy_run(0.9, key="q" * 64, at=50, instances=21)]
    found = sections_of([*rows, *other])
    assert [len(section.runs) for section in found] == [1, 4]
    assert found[0].title.startswith("demo test: 21 targets")
    assert found[0].title.endswith("(qqqqqq)")
    text = page([rows[0], *other], tmp_path)
    assert "results are not compared across sections" in text
    assert text.count('<section id="d-') == 2


def test_runs_that_differ_in_reported_thresholds_alone_are_shown_once(rows):
    twins = [toy_run(0.5, evaluate__theta_max=bound) for bound in (0.1, 0.2)]
    section = Section([*rows[:4], *twins], "demo")
    assert len(section.runs) == 4
    assert len(section.jobs) == 6


def test_a_random_models_notice_cannot_be_missed(built):
    _, text = built
    assert text.index("random weights: nothing was learned") < text.index("<table>")


def test_missing_vsd_is_told_and_never_a_zero(tmp_path):
    text = page([toy_run(vsd=False)], tmp_path)
    assert "VSD, and with it BOP's AR, is not available: no depth" in re.sub(r"&#39;", "'", text)
    assert ">n/a<" in text


def test_a_run_scored_on_other_meshes_is_shown_by_name_and_never_the_best():
    base = toy_run(0.5, evaluate={"models": "models_eval"})
    easier = toy_run(0.9, evaluate={"models": "models"})
    section = Section([base, toy_run(0.4, evaluate={"models": "models_eval"}, cluster__count=40), easier], "demo")
    assert section.best is base
    assert section.name(easier) == "evaluate.models=models"
    twins = [base, replace(easier, run=base.run)]
    assert len(Section(twins, "demo").runs) == 2


def test_published_recalls_of_a_dataset_stand_beside_its_runs_marked_so(tmp_path):
    text = page([toy_run(name="lmo")], tmp_path)
    own = text[: text.index('<section id="published">')]
    assert own.count("AR of single-shot methods on LM-O") == 2  # caption and its label
    assert "AR of single-shot methods on" not in page([toy_run()], tmp_path)


def test_long_names_break_between_their_parts():
    assert str(_breakable("correspond.per_cluster=<3>")) == "correspond.<wbr>per_<wbr>cluster=<wbr>&lt;3&gt;"


def test_rows_of_failures_alone_and_of_a_csv_still_make_a_page(tmp_path):
    assert "found -1" in page([failed_run()], tmp_path / "a")
    foreign = replace(toy_run(), config={}, label={}, times_s={}, counts={}, templates={}, method="megapose")
    text = page([foreign, toy_run()], tmp_path / "b")
    assert "megapose" in text


def test_a_page_of_a_thousand_targets_and_many_runs_stays_below_15_mb(tmp_path):
    rows = [toy_run(0.5, instances=1000)]
    rows += [toy_run(0.4 + n / 1000, at=n, cluster__count=n + 1, instances=1000) for n in range(20)]
    noise = np.random.default_rng(0).integers(0, 256, (1058, 486, 3), dtype=np.uint8)  # compresses worse than any card
    folder = tmp_path / rows[0].folder / "gallery"
    folder.mkdir(parents=True)
    cases = []
    for n in range(60):
        Image.fromarray(np.roll(noise, n, axis=0)).save(folder / f"{n}.jpg", quality=82)
        cases.append(Case(f"gallery/{n}.jpg", 1, n, 1, 0.1, "score 0.50"))
    rows[0] = replace(rows[0], cases=tuple(cases))
    start = time.perf_counter()
    report = write_report(rows, tmp_path)
    assert report.page.stat().st_size < LIMIT_BYTES
    assert time.perf_counter() - start < 60
    text = report.page.read_text()
    shown = text.count("data:image/jpeg;base64,")
    assert 10 < shown < 60
    assert f"{60 - shown} pictures are not in this page" in text


def test_an_oracle_is_never_the_base_nor_the_best_and_always_named(tmp_path):
    oracle = {"_target_": "pipeline.stages.match.oracle.Oracle", "layer": 2, "top_k": 1}
    shown = [toy_run(0.9, variation="oracle_template", match=oracle), toy_run(0.95, match=oracle), toy_run(0.4)]
    section = Section(shown, "demo")
    assert section.base is shown[2]
    assert section.best is shown[2]
    assert [section.name(row) for row in shown] == ["oracle template", "match=oracle", "dzop-hog"]


def test_a_run_without_vsd_has_no_ar_beside_runs_that_have_one():
    with_vsd, without = toy_run(0.4), toy_run(0.9, vsd=False, cluster__count=40)
    section = Section([with_vsd, without], "demo")
    assert section.best is with_vsd
    assert section.families == []
    table = section.tables()["runs"][0]
    told = {row[0]: row[1] for row in table.rows}
    assert told["cluster.count=40"].startswith("n/a; AR_MSSD+MSPD 0.")


def test_rows_on_disk_make_the_page(rows, tmp_path):
    for row in (rows[0], rows[-1]):
        write_run_record(tmp_path, row)
    report = write_report(read_run_records(tmp_path), tmp_path)
    assert "1 runs; AR" in report.summary
    assert "failed: cluster.count=-1" in report.summary
    with pytest.raises(BadInput, match="needs finished runs"):
        read_run_records(tmp_path / "empty")


def test_files_of_runs_that_are_gone_do_not_lie_beside_a_new_page(rows, tmp_path):
    page(rows, tmp_path)
    drawn = {path.name for path in (tmp_path / "report").rglob("ablation_cluster_count.*")}
    assert {"ablation_cluster_count.csv", "ablation_cluster_count.tex"} <= drawn
    page(rows[:1], tmp_path)
    assert not list((tmp_path / "report").rglob("ablation_cluster_count.*"))
    assert list((tmp_path / "report" / "tables").rglob("runs.csv"))


def test_a_table_of_many_columns_has_intervals_below_their_figures(built):
    _, text = built
    assert re.search(r"<td>0\.\d{3}<br>\(0\.\d{3} to 0\.\d{3}\)</td>", text)
