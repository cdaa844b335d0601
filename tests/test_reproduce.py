"""``dzop reproduce``: its jobs, their cost, and the page that sets published beside measured values."""

import re
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from command import run_dzop
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from pipeline.configuration import build_stages
from pipeline.fetch import DATASETS
from pipeline.io.checkpoints import offline
from pipeline.report import published
from pipeline.report.reproduction import INSTANCES
from pipeline.reproduction import Request, job_cost, list_jobs
from pipeline.reproduction.jobs import SWEEPS

VARIATIONS = ("no_coprojection", "no_clusters", "no_subpixel", "none")
CONF = Path(__file__).parents[1] / "conf"


@pytest.fixture
def started(monkeypatch) -> list[list[str]]:
    """Commands that would be started; the fixture's ``fails`` is a word of those that fail."""
    commands: list[list[str]] = []

    def run(command, check):
        assert command[:3] == [sys.executable, "-m", "pipeline"]
        commands.append(command[3:])
        return SimpleNamespace(returncode=int(any("sweep=clusters" in word for word in command[3:])))

    monkeypatch.setattr("subprocess.run", run)
    return commands


def test_every_job_composes_and_its_sweep_has_the_jobs_that_the_plan_counts():
    with initialize_config_dir(str(CONF), version_base="1.3"):
        for job in list_jobs(Request(images=3, baselines=("zs6d",))):
            for variation in VARIATIONS if "sweep=correspondence" in job.arguments else ["none"]:
                config = compose("config", overrides=[*job.arguments, f"variation={variation}"])
                values = OmegaConf.to_container(config, resolve=True)
                assert (values["select"]["sample"], values["variation"]) == (3, variation)
                with offline():
                    build_stages(values)
    for name, (count, _) in SWEEPS.items():
        swept = OmegaConf.load(CONF / "sweep" / f"{name}.yaml").hydra.sweeper.params
        assert [len(str(values).split(",")) for values in swept.values()] == [count]


def test_every_published_point_and_dataset_has_a_job():
    jobs = list_jobs(Request())
    assert {job.dataset for job in jobs} == set(published.DATASETS) == set(DATASETS)
    assert {name: dataset.instances for name, dataset in DATASETS.items()} == INSTANCES
    swept = [OmegaConf.load(CONF / "sweep" / f"{name}.yaml").hydra.sweeper.params for name in SWEEPS]
    assert {axis for params in swept for axis in params} == {"variation", *published.ABLATIONS}


def test_the_plan_has_passes_bytes_and_hours_and_starts_nothing(started, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    ran = run_dzop(capsys, monkeypatch, "reproduce", "plan=true")
    assert (ran.status, started, list(tmp_path.iterdir())) == (0, [], [])
    first = ran.out.splitlines()[1].split()
    assert first[:4] == ["1445", str(8 * 301 + 1445), "18.3", "GB"]
    assert re.search(r"GPU hours: \d+\.\d on one H200 at extract\.dtype=float32", ran.out)


def test_a_part_costs_its_share_and_half_precision_less():
    request, part = Request(datasets=("lmo",)), Request(datasets=("lmo",), images=20)
    whole, tenth = (job_cost(list_jobs(r)[0], r, first_views=True) for r in (request, part))
    assert (whole.poses, tenth.poses) == (1445, 144)
    assert whole.passes - tenth.passes == 1445 - 144  # templates do not depend on the images
    half = Request(datasets=("lmo",), overrides=("extract.dtype=float16",))
    cost = job_cost(list_jobs(half)[0], half, first_views=True)
    assert (cost.passes, cost.feature_bytes) == (whole.passes, whole.feature_bytes)
    assert cost.seconds < whole.seconds
    baseline = Request(datasets=("lmo",), baselines=("zs6d", "foundpose"))
    assert [job_cost(job, baseline, first_views=False).seconds for job in list_jobs(baseline)[1:3]] == [None, None]


def test_what_is_missing_is_fetched_all_jobs_run_and_failed_ones_are_named(started, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    ran = run_dzop(capsys, monkeypatch, "reproduce", "datasets=[lmo]", "images=2", "threads=1")
    assert started[0] == ["fetch", "lmo", "--masks", "--to", "data"]
    assert started[-1] == ["step=report", "out=results/reproduction"]
    assert [words[0] for words in started[3:-1]] == [f"sweep={name}" for name in SWEEPS]
    assert all({"select.sample=2", "threads=1"} <= set(words) for words in started[1:-1])
    assert ran.status == 1
    assert ran.err == "error: 1 of 7 jobs failed: lmo: ablation clusters; run again to resume"
    (tmp_path / "data" / "lmo" / "detections").mkdir(parents=True)
    (tmp_path / "data" / "lmo" / "detections" / "mine.json").write_text("[]")
    started.clear()
    run_dzop(capsys, monkeypatch, "reproduce", "datasets=lmo", "detections=detections/mine.json")
    assert started[0][0] != "fetch"
    assert "detect.path=data/lmo/detections/mine.json" in started[0]


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("datasets=[hope]", "datasets: found [hope], needs some of lmo, tless, ycbv, such as [lmo]"),
        ("datasets=", "datasets: found , needs some of lmo, tless, ycbv, such as [lmo]"),
        ("images=0", "images: found 0, needs a number of images, at least 1"),
        ("plan=maybe", "plan: found maybe, needs true or false"),
        ("--plan", "dzop reproduce: found --plan, needs NAME=VALUE; dzop reproduce --help lists the names"),
        ("detections=mine.json", "data/lmo/mine.json: found no such file, needs a detector's file, "
         "or detections= left out: it is fetched"),
    ],
)  # fmt: skip
def test_options_are_checked(argument, message, started, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    ran = run_dzop(capsys, monkeypatch, "reproduce", argument)
    assert (ran.status, ran.err, started) == (1, f"error: {message}", [])
