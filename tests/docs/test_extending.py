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


TWO_LAYERS = """
from pipeline.functional.similarity import global_cosine
from pipeline.spec import spec
from pipeline.stages.match import Matcher, rank


@spec
class TwoLayers(Matcher):
    kind = "match.two_layers"
    version = 1
    layer: int = 5
    second: int = 8
    top_k: int = 2

    @property
    def layers(self):
        return self.layer, self.second

    def __call__(self, query, bank):
        assert bank.maps(self.layer).equal(bank.features)
        scores = [global_cosine(query.crop.maps[layer], bank.maps(layer)) for layer in self.layers]
        return rank(sum(scores) / 2, top_k=self.top_k)
"""


@pytest.mark.parametrize(("second", "message"), [(8, ""), (7, "match.layers: found 7, needs one of 2, 5, 8, 11")])
def test_a_matcher_that_lists_two_layers_gets_both(second, message, capsys, monkeypatch, folder, tmp_path):
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(str(folder))
    (folder / "mine" / "two_layers.py").write_text(TWO_LAYERS)
    (folder / "mine" / "conf" / "match" / "two_layers.yaml").write_text("_target_: mine.two_layers.TwoLayers\n")
    chosen = (
        "match=two_layers",
        f"+match.second={second}",
        "extract=hog",
        "fuse.layers=[11]",
        "store=memory",
        *TINY,
        f"out={tmp_path}",
    )
    ran = run_dzop(capsys, monkeypatch, "--config-dir", "mine/conf", *chosen)
    assert message in ran.err
    assert ran.status == bool(message)
    assert len(list(tmp_path.glob("*/*/poses.json"))) == (not message)
