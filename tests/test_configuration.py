"""Every yaml of conf/ matches its class: same fields, same defaults, one name for file, yaml and kind."""

import importlib
from dataclasses import MISSING, fields
from functools import cache
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from pipeline.spec import build, lists_to_tuples

CONF = Path(__file__).parents[1] / "conf"
STAGES = (
    "render",
    "extract",
    "crop",
    "match",
    "fuse",
    "cluster",
    "correspond",
    "solve",
    "choose",
    "refine",
    "detect",
    "segment",
)
VARIANTS = sorted(path for stage in STAGES for path in (CONF / stage).glob("*.yaml"))


@cache
def loaded(path: Path) -> tuple[type, dict]:
    """The class of a yaml and its fields, with the variants of its defaults list built; not to be changed."""
    around = {"weights": OmegaConf.load(CONF / "config.yaml").weights, "variant": OmegaConf.load(path)}
    values = OmegaConf.to_container(OmegaConf.create(around), resolve=True)["variant"]
    for entry in values.pop("defaults", ()):
        for group, option in entry.items() if isinstance(entry, dict) else ():
            folder, field = group.split("@") if "@" in group else (group, group)
            inner = CONF / folder[1:] if folder.startswith("/") else path.parent / folder
            cls, fields_of = loaded(inner / f"{option}.yaml")
            *parents, last = field.split(".")
            holder = values
            for parent in parents:
                holder = holder[parent]
            holder[last] = build(cls, fields_of, where=field)
    for field, value in values.items():
        if isinstance(value, dict) and "_target_" in value:
            values[field] = build(find_class(value.pop("_target_")), value, where=field)
    return find_class(values.pop("_target_")), values


def find_class(target: str) -> type:
    module, name = target.rsplit(".", 1)
    return getattr(importlib.import_module(module), name)


@pytest.mark.parametrize("path", VARIANTS, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_a_yaml_lists_every_field_of_its_class_with_the_default(path: Path):
    cls, values = loaded(path)
    assert set(values) == {field.name for field in fields(cls)}
    for field in fields(cls):
        if field.default is MISSING and field.default_factory is MISSING:
            continue  # a variant of another stage, which no class here may name
        default = field.default if field.default is not MISSING else field.default_factory()
        assert (lists_to_tuples(values[field.name]), field.name) == (default, field.name)


@pytest.mark.parametrize("path", VARIANTS, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_file_yaml_and_kind_share_one_name(path: Path):
    cls, _ = loaded(path)
    assert cls.__module__ == f"pipeline.stages.{path.parent.name}.{path.stem}"
    assert cls.kind == f"{path.parent.name}.{path.stem}"


def test_every_variant_of_a_stage_has_its_yaml():
    root = CONF.parent / "pipeline" / "stages"
    kinds = {f"{path.parent.name}/{path.stem}" for path in VARIANTS}
    for stage in STAGES:
        for path in (root / stage).glob("*.py"):
            if f'kind: ClassVar[str] = "{stage}.{path.stem}"' in path.read_text():
                assert f"{stage}/{path.stem}" in kinds
