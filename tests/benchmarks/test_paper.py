"""The benchmark of the paper's readings: its lines, paired differences, and what is run again."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks import paper
from pipeline.items.scores import Scores
from pipeline.report.run_records import RunRecord


def record(*, correct: bool, at: str = "2026") -> RunRecord:
    """A run on twelve instances in four images, all correct or all wrong."""
    n, hit = 12, np.full((12, 10), correct)
    scores = Scores(np.ones(n, int), np.arange(n) % 4, np.arange(n), np.zeros(n, int), np.ones(n), hit, hit, None, "")
    return RunRecord("0", "done", at, "m", {}, {}, scores=scores)


@pytest.fixture
def runs(monkeypatch, tmp_path):
    """The runs that were asked for: column and line -> overrides. A run leaves a folder with a record."""
    asked = {}

    def run_all(overrides_of, jobs):
        for run, overrides in overrides_of.items():
            out = next(o for o in overrides if o.startswith("out="))[5:-1]
            (tmp_path / out / "rows").mkdir(parents=True)
            asked[run] = overrides

    monkeypatch.setattr(paper, "run_all", run_all)
    monkeypatch.setattr(
        paper, "read_run_records", lambda out: [replace(record(correct="dzop_paper" not in str(out)), at="1")]
    )
    return asked


def test_lines_differ_from_dzop_in_one_switch_and_the_difference_is_paired(runs, tmp_path):
    text = paper.benchmark(tmp_path, lmo=tmp_path / "lmo", found=tmp_path / "found.json", features=["HOG"])
    boxes, masks = "ground-truth boxes (oracle)", "a detector's masks"
    assert {line for column, line in runs if column == masks} == {paper.OURS, paper.PAPER, *paper.SWITCHES}
    assert {line for column, line in runs if column == boxes} > {*paper.SWITCHES, *paper.READINGS}
    assert runs[boxes, "solve.refine=false"][:3] == ("method=dzop", "solve.refine=false", "extract=hog")
    assert runs[boxes, paper.PAPER][:2] == ("method=dzop_paper", "extract=hog")
    right, lost = "1.000 [1.000, 1.000]", "-1.000 [-1.000, -1.000]"
    assert f"| `method=dzop` | {right} |  | {right} |  |" in text
    assert f"| `method=dzop_paper` | 0.000 [0.000, 0.000] | {lost} | 0.000 [0.000, 0.000] | {lost} |" in text
    assert not any("extract.noise" in line for _, line in runs)


def test_finished_runs_are_not_run_again_and_overrides_have_their_own(runs, tmp_path):
    kinds = {"lmo": tmp_path / "lmo", "features": ["embedded, pure"]}
    first = paper.benchmark(tmp_path, **kinds)
    assert {line for _, line in runs} >= set(paper.DIFFUSION)
    runs.clear()
    assert paper.benchmark(tmp_path, **kinds) == first
    assert not runs
    paper.benchmark(tmp_path, **kinds, overrides=["select.images=[3]"])
    assert all("select.images=[3]" in overrides for overrides in runs.values())


def test_every_line_composes(monkeypatch):
    """Switches name fields that exist, and the last of two values for a field counts."""
    from hydra import compose, initialize_config_dir
    from omegaconf import OmegaConf

    from pipeline.configuration import CONF, build_stages

    with initialize_config_dir(str(CONF), version_base="1.3"):
        built = {
            line: build_stages(OmegaConf.to_container(compose("config", overrides=line.split()), resolve=True))
            for line in (f"method=dzop extract=hog {switch}" for switch in (*paper.SWITCHES, "solve.seed=0"))
        }
    methods = list(built.values())
    assert all(a != b for k, a in enumerate(methods) for b in methods[:k])
