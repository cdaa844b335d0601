"""Every command that README and docs show is read by the program that it calls. Nothing is run."""

import argparse
import re
import runpy
import subprocess
import sys
import tomllib
from functools import partial, partialmethod
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf
from pages import PAGES, ROOT, Command, commands

from pipeline.__main__ import COMMANDS, main
from pipeline.configuration import STAGES, build_options, build_stages, build_variant
from pipeline.io.checkpoints import offline

CONF = ROOT / "conf"
SHOWN = list({command.words: command for page in PAGES for command in commands(page)}.values())
EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]


class Parsed(Exception):
    """A command line was read without an error."""


@pytest.mark.parametrize("command", SHOWN, ids=str)
def test_a_shown_command_is_one_that_the_program_takes(command: Command, monkeypatch, tmp_path):
    program, *arguments = command.words
    if program == "dzop":
        program, arguments = "python", ["-m", "pipeline", *arguments]
    if program == "make":
        check_make(arguments)
    elif program == "pip":
        check_extras(arguments)
    elif arguments[:2] == ["-m", "pipeline"]:
        check_pipeline(arguments[2:], monkeypatch, tmp_path)
    elif arguments[:2] == ["-m", "pytest"]:
        assert all((ROOT / word).exists() for word in arguments[2:] if not word.startswith("-"))
    elif arguments[:2] != ["-m", "venv"]:
        check_arguments(arguments, monkeypatch)


def check_make(arguments: list[str]) -> None:
    ran = subprocess.run(["make", "-n", *arguments], cwd=ROOT, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr


def check_extras(arguments: list[str]) -> None:
    named = re.findall(r"(?:^|\s)(?:dzop|\.)\[([\w,-]+)\]", " ".join(arguments))
    assert all(extra in EXTRAS for names in named for extra in names.split(","))


def check_pipeline(arguments: list[str], monkeypatch, folder: Path) -> None:
    if arguments and arguments[0] in COMMANDS:
        if len(arguments) == 1:
            return  # a command's name in running text
        monkeypatch.setattr(sys, "argv", ["dzop", *arguments])
        check_parser(monkeypatch, main)
        return
    overrides = [word for word in arguments if word not in ("-m", "--help")]
    if "--config-dir" in overrides or "--cfg" in overrides:
        return  # the worked examples of docs/extending.md have a test of their own
    values = composed(first_of_sweep(overrides))
    with offline():
        build_stages(values)
    build_options(values)
    for name in ("dataset", "store", "runtime"):
        build_variant(values[name], name)
    assert set(STAGES) <= set(values)


def first_of_sweep(overrides: list[str]) -> list[str]:
    """The first job's overrides."""
    parsed = OverridesParser.create().parse_overrides(overrides)
    return [
        f"{o.key_or_group}={next(iter(o.sweep_string_iterator()))}" if o.is_sweep_override() else o.input_line
        for o in parsed
    ]


def composed(overrides: list[str]) -> dict:
    needs_dataset = "dataset=photo" not in " ".join(overrides)
    dummies = [] if needs_dataset else ["dataset.mesh=mug.ply", "dataset.image=shot.png", "dataset.K=[600,600,320,240]"]
    given = {override.split("=")[0] for override in overrides}
    dummies = [dummy for dummy in dummies if dummy.split("=")[0] not in given]
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("config", overrides=[*overrides, *dummies], return_hydra_config=True)
    values = {name: value for name, value in config.items_ex(resolve=False) if name != "hydra"}
    return OmegaConf.to_container(OmegaConf.create(values), resolve=True, throw_on_missing=True)


def check_arguments(arguments: list[str], monkeypatch) -> None:
    """A script or module of ours whose main reads its arguments with argparse."""
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(sys, "argv", [*arguments])
    if arguments[0] == "-m":
        monkeypatch.setattr(sys, "argv", arguments[1:])
        check_parser(monkeypatch, lambda: runpy.run_module(arguments[1], run_name="__main__"))
    else:
        check_parser(monkeypatch, lambda: runpy.run_path(arguments[0], run_name="__main__"))


def check_parser(monkeypatch, call) -> None:
    """``call`` gets as far as having read its arguments."""

    def parse_and_stop(parse, self, *args, **kwargs):
        parse(self, *args, **kwargs)
        raise Parsed

    for name in ("parse_args", "parse_intermixed_args"):
        parse = getattr(argparse.ArgumentParser, name)
        monkeypatch.setattr(argparse.ArgumentParser, name, partialmethod(partial(parse_and_stop, parse)))
    with pytest.raises(Parsed):
        call()


def test_pages_show_commands_of_every_kind():
    assert len(SHOWN) > 60
    assert {command.words[0] for command in SHOWN} == {"dzop", "make", "pip", "python"}


def test_configuration_names_every_variant_of_every_stage():
    page = (ROOT / "docs" / "configuration.md").read_text()
    for folder in (*STAGES, "second_look", "store", "runtime", "dataset"):
        names = [path.stem for path in (CONF / folder).glob("*.yaml")]
        assert [name for name in names if f"`{name}`" not in page] == [], folder


def test_methods_names_every_method_and_sweep():
    page = (ROOT / "docs" / "methods.md").read_text()
    names = [path.stem for path in (CONF / "method").glob("*.yaml")]
    assert [name for name in names if f"`{name}`" not in page] == []
    sweeps = {path.stem for path in (CONF / "sweep").glob("*.yaml")} - {"backbones"}
    assert [name for name in sweeps if not re.search(rf"\b{name}\b", page)] == []
