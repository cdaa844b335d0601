import errno
import re
import shutil
import time
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from toy_runs import failed_run, toy_run

from pipeline.errors import BadInput, DzopError
from pipeline.report.page import _breakable, write_report
from pipeline.report.plotting import Figure
from pipeline.report.run_records import Case, read_run_records, write_run_record
from pipeline.report.section import Section, sections_of

LIMIT_BYTES = 15_000_000


def page(runs, out) -> str:
    return write_report(runs, out).page.read_text()


@pytest.fixture(scope="module")
def runs():
    return [toy_run(0.5), *(toy_run(0.3 + n / 1000, at=n // 10, cluster__count=n) for n in (40, 80, 130)), failed_run()]


@pytest.fixture
def blank_figures(monkeypatch):
    """Figures without lines, for tests of what else is on a page or of its files: drawing takes seconds."""

    def savefig(canvas, to, **_) -> None:
        with open(to, "w") if isinstance(to, str) else nullcontext(to) as file:
            file.write("<svg></svg>")

    monkeypatch.setattr("pipeline.report.plotting.Canvas.savefig", savefig)


@pytest.fixture(scope="module")
def built(runs, tmp_path_factory):
    """The results folder of a page that several tests look at, and its text."""
    out = tmp_path_factory.mktemp("results")
    noted = replace(runs[0], notice="random weights: nothing was learned")
    return out, page([noted, *runs[1:]], out)


def test_a_page_is_self_contained_and_comes_with_figures_and_tables(built):
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


def test_the_same_runs_give_the_same_page_except_for_its_date(runs, tmp_path):
    first, second = (re.sub(r"Written [^<]*by", "", page(runs[:2], tmp_path / name)) for name in "ab")
    assert first == second


def test_a_failed_job_is_listed_first(built):
    _, text = built
    position = text.index("cluster.count: found -1, needs greater than or equal to 1")
    assert position < text.index("<main>")
    assert "cluster.count=-1 sweep=clusters" in text


def test_published_numbers_are_in_separate_tables(built):
    _, text = built
    for block in re.findall(r'<figure class="table (measured|published)">(.*?)</figure>', text, flags=re.DOTALL):
        kind, body = block
        assert ("published, not measured here" in body) == (kind == "published")
        assert ("GigaPose" in body) <= (kind == "published")
    assert text.count("published, LM-O") >= 2  # theta and clusters, below their measured curves


def test_texts_of_a_run_are_escaped(built):
    assert "needs 6 &lt;&amp;&gt;" in built[1]


def test_runs_on_other_targets_have_their_own_section(runs, tmp_path):
    other = [toy_run(0.9, key="q" * 64, at=50, instances=21)]
    found = sections_of([*runs, *other])
    assert [len(section.runs) for section in found] == [1, 4]
    assert found[0].title.startswith("demo test: 21 targets")
    assert found[0].title.endswith("(qqqqqq)")
    text = page([runs[0], *other], tmp_path)
    assert "results are not compared across sections" in text
    assert text.count('<section id="d-') == 2


def test_runs_that_differ_only_in_reported_thresholds_are_shown_once(runs):
    twins = [toy_run(0.5, evaluate__theta_max=bound) for bound in (0.1, 0.2)]
    section = Section([*runs[:4], *twins], "demo")
    assert len(section.runs) == 4
    assert len(section.jobs) == 6


def test_the_notice_of_random_weights_comes_before_all_tables(built):
    _, text = built
    assert text.index("random weights: nothing was learned") < text.index("<table>")


def test_missing_vsd_is_explained_and_not_shown_as_zero(tmp_path):
    text = page([toy_run(vsd=False)], tmp_path)
    assert "VSD, and with it BOP's AR, is not available: no depth" in re.sub(r"&#39;", "'", text)
    assert ">n/a<" in text


def test_a_run_scored_on_other_meshes_is_named_and_is_never_the_best():
    base = toy_run(0.5, evaluate={"models": "models_eval"})
    easier = toy_run(0.9, evaluate={"models": "models"})
    section = Section([base, toy_run(0.4, evaluate={"models": "models_eval"}, cluster__count=40), easier], "demo")
    assert section.best is base
    assert section.name(easier) == "evaluate.models=models"
    twins = [base, replace(easier, run=base.run)]
    assert len(Section(twins, "demo").runs) == 2


def test_published_recalls_of_a_dataset_are_marked_in_its_section(tmp_path):
    text = page([toy_run(name="lmo")], tmp_path)
    own = text[: text.index('<section id="published">')]
    assert own.count("AR of single-shot methods on LM-O") == 2  # caption and its label
    assert "AR of single-shot methods on" not in page([toy_run()], tmp_path)


def test_long_names_break_between_their_parts():
    assert str(_breakable("correspond.per_cluster=<3>")) == "correspond.<wbr>per_<wbr>cluster=<wbr>&lt;3&gt;"


def test_only_failures_or_a_scored_csv_still_make_a_page(tmp_path):
    assert "found -1" in page([failed_run()], tmp_path / "a")
    foreign = replace(toy_run(), config={}, label={}, times_s={}, counts={}, templates={}, method="megapose")
    text = page([foreign, toy_run()], tmp_path / "b")
    assert "megapose" in text


def test_a_page_of_a_thousand_targets_and_many_runs_stays_below_15_mb(tmp_path):
    runs = [toy_run(0.5, instances=1000)]
    runs += [toy_run(0.4 + n / 1000, at=n, cluster__count=n + 1, instances=1000) for n in range(20)]
    noise = np.random.default_rng(0).integers(0, 256, (1058, 486, 3), dtype=np.uint8)  # compresses worse than any card
    folder = tmp_path / runs[0].folder / "gallery"
    folder.mkdir(parents=True)
    cases = []
    for n in range(60):
        Image.fromarray(np.roll(noise, n, axis=0)).save(folder / f"{n}.jpg", quality=82)
        cases.append(Case(f"gallery/{n}.jpg", 1, n, 1, 0.1, "score 0.50"))
    runs[0] = replace(runs[0], cases=tuple(cases))
    start = time.perf_counter()
    report = write_report(runs, tmp_path)
    assert report.page.stat().st_size < LIMIT_BYTES
    assert time.perf_counter() - start < 60
    text = report.page.read_text()
    shown = text.count("data:image/jpeg;base64,")
    assert 10 < shown < 60
    assert f"{60 - shown} pictures are not in this page" in text


def test_an_oracle_is_never_base_or_best_and_is_always_named(tmp_path):
    oracle = {"_target_": "pipeline.stages.match.oracle.Oracle", "layer": 2, "top_k": 1}
    shown = [toy_run(0.9, variation="oracle_template", match=oracle), toy_run(0.95, match=oracle), toy_run(0.4)]
    section = Section(shown, "demo")
    assert section.base is shown[2]
    assert section.best is shown[2]
    assert [section.name(row) for row in shown] == ["oracle template", "match=oracle", "dzop-hog"]


def test_a_run_without_vsd_has_no_ar_among_runs_that_have_one():
    with_vsd, without = toy_run(0.4), toy_run(0.9, vsd=False, cluster__count=40)
    section = Section([with_vsd, without], "demo")
    assert section.best is with_vsd
    assert section.families == []
    table = section.tables()["runs"][0]
    cells = {row[0]: row[table.head.index("AR")] for row in table.rows}
    assert cells["cluster.count=40"].startswith("n/a; AR_MSSD+MSPD 0.")


def test_a_page_is_made_from_records_on_disk(runs, tmp_path):
    for row in (runs[0], runs[-1]):
        write_run_record(tmp_path, row)
    report = write_report(read_run_records(tmp_path), tmp_path)
    assert "1 run; AR" in report.summary
    assert "failed: cluster.count=-1" in report.summary
    with pytest.raises(BadInput, match="needs finished runs"):
        read_run_records(tmp_path / "empty")


def test_files_of_removed_runs_are_deleted_with_the_old_page(runs, tmp_path, blank_figures):
    page(runs, tmp_path)
    drawn = {path.name for path in (tmp_path / "report").rglob("ablation_cluster_count.*")}
    assert {"ablation_cluster_count.csv", "ablation_cluster_count.tex"} <= drawn
    page(runs[:1], tmp_path)
    assert not list((tmp_path / "report").rglob("ablation_cluster_count.*"))
    assert list((tmp_path / "report" / "tables").rglob("runs.csv"))


def test_a_table_of_many_columns_has_intervals_below_their_figures(built):
    _, text = built
    assert re.search(r"<td>0\.\d{3}<br>\(0\.\d{3} to 0\.\d{3}\)</td>", text)


def fail_at(monkeypatch: pytest.MonkeyPatch, number: int) -> list[str]:
    """Let the n-th write of the report fail as on a full disk; returns what was written."""
    writes: list[str] = []

    def fail(owner, name: str) -> None:
        original = getattr(owner, name)

        def write(self, *args, **kwargs):
            writes.append(f"{name} {self}")
            if len(writes) == number:
                raise OSError(errno.ENOSPC, "No space left on device")
            return original(self, *args, **kwargs)

        monkeypatch.setattr(owner, name, write)

    for owner, name in ((Figure, "save"), (Path, "write_bytes"), (Path, "mkdir"), (Path, "rename"), (Path, "replace")):
        fail(owner, name)
    return writes


def test_a_full_disk_leaves_the_report_that_was_there(runs, tmp_path, monkeypatch, blank_figures):
    page(runs[:2], tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with monkeypatch.context() as patch:
        writes = fail_at(patch, 0)
        page(runs[:1], tmp_path / "other")
    shutil.rmtree(tmp_path / "other")
    last_file = len(writes) - 8  # then the folders and the page are put in their places
    for number in (1, last_file // 2, *range(last_file, len(writes) + 1)):
        with monkeypatch.context() as patch:
            fail_at(patch, number)
            with pytest.raises(DzopError, match=r"report.*: the disk is full; make room"):
                write_report(runs[:1], tmp_path)
        now = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
        assert now[tmp_path / "report" / "index.html"] == before[tmp_path / "report" / "index.html"]
        assert {path.parent.name for path in now} >= {"report", "figures", "tables"} & {p.parent.name for p in before}
        assert not [path for path in tmp_path.rglob("*") if path.name.endswith(".partial")]
        assert now == before or number > last_file + 3, writes[number - 1]


def test_a_page_of_ground_truth_masks_says_so_wherever_figures_stand(tmp_path):
    text = page([toy_run(0.5, name="lmo"), toy_run(0.3, name="lmo", at=1, cluster__count=40)], tmp_path)
    assert text.count("ground-truth masks (oracle)") >= 6
    best = re.search(r'<p class="best">.*?</p>', text)[0]
    runs_caption, published_caption = (
        re.search(rf"<figcaption>{start}.*?</figcaption>", text)[0]
        for start in ("Runs on", "AR of single-shot methods on")
    )
    above_published = text[text.index(published_caption) - 400 : text.index(published_caption)]
    for place in (best, runs_caption, above_published):
        assert "ground-truth masks (oracle)" in place
    for words in ("thresholds up to a bound", "objects 1 to 3", "differ only in cluster.count"):
        assert re.search(rf"<figcaption>[^<]*{words}[^<]*\(oracle\)[^<]*</figcaption>", text)


@pytest.mark.parametrize(
    ("detect", "detections", "shown"),
    [
        ("gt_bbox.GtBbox", "ground-truth boxes (oracle)", "ground-truth boxes (oracle)"),
        ("json.Json", "detections of cnos.json", "detections of cnos.json"),
        ("gt_mask.GtMask", "", "gt_mask (oracle)"),
        ("cnos.Cnos", "", "cnos"),
    ],
)
def test_detections_are_named_also_for_records_of_earlier_versions(tmp_path, detect, detections, shown):
    config = {"_target_": f"pipeline.stages.detect.{detect}"}
    text = page([replace(toy_run(0.5, detect=config), detections=detections)], tmp_path)
    assert f"<p>Detections: <b>{shown}</b>." in text
    assert ("Ground truth tells the method" in text) == ("(oracle)" in shown)


def test_an_ablation_that_changed_no_answer_says_so(tmp_path, blank_figures):
    flat = [toy_run(0.5), *(toy_run(0.5, at=n, correspond__per_cluster=n) for n in (1, 5, 30))]
    note = "correspond.per_cluster changed no answer: all 4 runs gave the same poses and scores."
    assert note in page(flat, tmp_path / "flat")
    assert note not in page([*flat[:-1], replace(flat[-1], answers="others")], tmp_path / "moves")
    assert note not in page([replace(run, answers="") for run in flat], tmp_path / "old")


def test_the_page_says_that_the_papers_bars_are_not_its_ar(built):
    _, text = built
    assert "their means are 0.468 on LM-O (AR 0.328), 0.776 on YCB-V (AR 0.365), 0.474 on T-LESS (AR 0.267)" in text
    assert "0.433 in the table of correspondence estimation, 0.4433 in its ablations" in text
