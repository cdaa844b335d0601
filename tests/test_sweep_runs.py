"""Every file of conf/sweep runs end to end on tiny settings, no job of it fails, and a flat one says so."""

from pathlib import Path

import pytest
from command import CommandResult, run_dzop
from make_weights import write_weights
from test_sweep_files import PAPER, SWEEPS
from tiny_bop import write_tiny_bop

from pipeline.report.run_records import read_run_records

TINY = ("render=raycast", "render.count=4", "render.size=64", "evaluate.vsd=false", "runtime.progress=false",
        "threads=1", "select.images=[0]", "select.objects=[1]", "second_look=none")  # fmt: skip
HOG = ("extract=hog",)
SD = ("extract=random_sd", "extract.channels=[8,8,8,8]", "extract.vae_channels=[8,8,8,8]",
      "extract.cross_attention_dim=8")  # fmt: skip
SMALL_SD = (*SD, "extract.input_size=64")  # what the command line sets, a sweep does not vary
FEATURES = dict.fromkeys(("hook", "layers", "noise", "template_layer", "timesteps"), SMALL_SD) | {"input_size": SD}
JOBS = {
    "backbones": 6, "clusters": 14, "correspondence": 4, "hook": 3, "input_size": 3, "ladder": 5, "layers": 7,
    "noise": 6, "pca_dim": 8, "per_cluster": 12, "solver": 2, "template_layer": 4, "theta": 6, "timesteps": 10,
    "top_k": 5, "viewpoints": 2,
}  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Data and store of all sweeps: what they share is computed once."""
    folder = tmp_path_factory.mktemp("sweeps")
    write_tiny_bop(folder / "tiny")
    return folder


@pytest.fixture
def sweep(capsys, monkeypatch, tmp_path, folder):
    """Run a sweep."""

    # Hydra composes every job's configuration once more to find errors early; tests/test_sweeps.py leaves it that way.
    monkeypatch.setattr("hydra.plugins.sweeper.Sweeper.validate_batch_is_legal", lambda *_: None)

    def run(name: str, *more: str) -> CommandResult:
        monkeypatch.chdir(tmp_path)
        where = ("dataset=bop", "dataset.name=tiny", f"dataset.root={folder}/tiny", f"store.root={folder}/cache")
        return run_dzop(capsys, monkeypatch, *where, *TINY, *more, f"sweep={name}")

    return run


@pytest.mark.parametrize("name", SWEEPS)
def test_a_sweep_runs_and_no_job_of_it_fails(sweep, folder, tmp_path, name):
    # six methods at their own input sizes: two templates are enough
    backbones = name == "backbones"
    features = [*write_weights(folder / "weights"), "render.count=2"] if backbones else FEATURES.get(name, HOG)
    ran = sweep(name, *features)
    assert ran.status == 0, ran.err
    records = read_run_records(tmp_path / "results")
    assert {record.status for record in records} == {"done"}
    assert {record.sweep for record in records} == {name}
    assert ran.out.count("\nrecord    ") + ran.out.count("already finished: ") >= len(records)
    assert len(records) == JOBS[name]
    if name in PAPER:
        assert {record.detections for record in records} == {"ground-truth boxes (oracle)"}
        assert "gt-bbox_tiny-test" in ran.out
        assert "scores on ground-truth boxes (oracle)" in ran.out
    answers = {record.answers for record in records}
    assert ("changed no answer" in ran.out) == (len(answers) == 1 and name != "theta")


def test_a_sweep_that_changes_no_answer_says_so_in_the_terminal_and_on_the_page(sweep, tmp_path):
    ran = sweep("per_cluster", *HOG, "cluster.count=60", "hydra.sweeper.params={correspond.per_cluster:'5000,6000'}")
    assert ran.status == 0, ran.err
    note = "correspond.per_cluster changed no answer: all 2"
    assert f"note: {note} jobs" in ran.out.splitlines()[-1]
    assert sweep("per_cluster", "step=report", "hydra.mode=RUN").status == 0
    assert f"{note} runs gave the same poses and scores" in (tmp_path / "results/report/index.html").read_text()
