"""The worked examples of docs/extending.md run as they stand."""

import json
import re

import pytest
from command import run_dzop
from pages import ROOT, commands

PAGE = ROOT / "docs" / "extending.md"
FILES = re.findall(r"^`([\w./]+)`:\n\n```\w+\n(.*?)^```$", PAGE.read_text(), re.MULTILINE | re.DOTALL)
EXAMPLES = [command for command in commands(PAGE) if "--config-dir" in command.words]
TINY = (
    "dataset.objects=1", "dataset.images=1", "dataset.per_image=1", "dataset.occluded=0", "render.count=12",
    "threads=1", "runtime.device=cpu", "overlays=false", "gallery=0", "evaluate.vsd=false",
)  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The page's files, and a store that its examples share."""
    folder = tmp_path_factory.mktemp("extending")
    for name, text in FILES:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    (folder / "mine" / "__init__.py").touch()
    return folder


def test_the_page_has_a_file_of_each_kind():
    assert {name.rpartition(".")[2] for name, _ in FILES} == {"py", "yaml"}
    assert EXAMPLES


@pytest.mark.parametrize("command", EXAMPLES, ids=str)
def test_a_worked_example_runs(command, capsys, monkeypatch, folder, tmp_path):
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(str(folder))
    arguments = command.words[command.words.index("pipeline") + 1 :]
    ran = run_dzop(capsys, monkeypatch, *arguments, *TINY, f"out={tmp_path}")
    assert ran.status == 0, ran.err
    record = json.loads(next(tmp_path.glob("*/*/poses.json")).read_text())
    chosen = [argument.split("=") for argument in arguments if "=" in argument]
    assert all(f"mine.{name}." in record["config"][stage]["_target_"] for stage, name in chosen)
    assert [answer["status"] for answer in record["answers"]] == ["estimate"]
