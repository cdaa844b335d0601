"""Resolved configuration -> the specs of a run. Values are plain dicts; of Hydra only class lookup is used here."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import fields
from functools import cache
from pathlib import Path
from typing import Any, cast, get_origin, get_type_hints

from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.utils import get_class
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from pydantic.dataclasses import is_pydantic_dataclass

from pipeline.errors import BadInput
from pipeline.io.checkpoints import NotDownloaded
from pipeline.method import DepthFit, SecondLook, Stages
from pipeline.options import Evaluate, Options, Select
from pipeline.places import CONF
from pipeline.spec import build, did_you_mean

STAGES = (
    "render", "extract", "crop", "match", "fuse", "cluster", "correspond", "solve", "choose", "refine", "detect",
    "segment",
)  # fmt: skip
OPTIONS = ("step", "plan", "out", "overlays", "gallery", "threads", "method", "confidence")
REQUIRED = (*STAGES, *OPTIONS, "second_look", "depth", "fallback", "dataset", "store", "runtime", "select", "evaluate")
"""Fields of config.yaml that a run needs and that ``~field`` on the command line can remove."""

OWN_CLASS_WARNING = (
    "a class outside the package: cached results are found by its kind, version and fields, not by its code; "
    "raise its version after a change, or use store=memory"
)


def compose_settings(settings: Sequence[str]) -> dict[str, Any]:
    """The configuration of a command line with these overrides, as plain values. Raises BadInput."""
    try:
        with initialize_config_dir(str(CONF), version_base="1.3"):
            config = compose("config", overrides=list(settings))
        return cast(dict[str, Any], OmegaConf.to_container(config, resolve=True, throw_on_missing=True))
    except (HydraException, OmegaConfBaseException) as error:
        found = " ".join(str(error).split())
        raise BadInput("settings", found=found, needed="overrides as on the command line") from None


def check_fields(values: Mapping[str, Any]) -> None:
    """Raise BadInput for a required field that was removed."""
    for name in REQUIRED:
        if name not in values:
            raise BadInput(name, found="nothing", needed=f"a value: leave ~{name} out")


def build_stages(values: Mapping[str, Any]) -> Stages:
    """The variant of every stage."""
    values = drop_replaced_fields(values)
    stages = {name: build_variant(values[name], name) for name in STAGES}
    if hasattr(stages["fuse"], "resolve_for"):
        stages["fuse"] = stages["fuse"].resolve_for(_model_name(stages["extract"]))
    if not isinstance(values["fallback"], bool):
        raise BadInput("fallback", found=repr(values["fallback"]), needed="true or false")
    second_look: SecondLook = build_variant(values["second_look"], "second_look")
    depth: DepthFit = build_variant(values["depth"], "depth")
    return Stages(**stages, fallback=values["fallback"], second_look=second_look, depth=depth)


def drop_replaced_fields(values: Mapping[str, Any]) -> dict[str, Any]:
    """The configuration without a method's fields for a variant that was replaced by one without them.

    With ``solve=epnp``, say, ``method=dzop_x`` sets ``solve.refit_px``, which only its own solver has.
    """
    kept, path = dict(values), _find_yaml("method", values.get("method"))
    by_method = {} if path is None else _read_yaml(path)
    for stage in STAGES:
        given, variant = by_method.get(stage), values.get(stage)
        if not isinstance(given, dict) or not isinstance(variant, Mapping):
            continue
        if variant.get("_target_") != _target_of_method(by_method, stage):
            names = {field.name for field in fields(_find_class(variant.get("_target_"), f"{stage}._target_"))}
            replaced = {name for name in given if name not in names and variant.get(name) == given[name]}
            kept[stage] = {name: value for name, value in variant.items() if name not in replaced}
    return kept


def _target_of_method(by_method: Mapping[str, Any], stage: str) -> Any:
    """``_target_`` of the variant that a method's yaml chooses, or of the default one where it chooses none."""
    defaults = [entry for entry in _read_yaml(CONF / "config.yaml")["defaults"] if isinstance(entry, dict)]
    chosen = {name: value for entry in defaults for name, value in entry.items()}
    for entry in by_method.get("defaults", ()):
        if isinstance(entry, dict):
            chosen |= {name.removeprefix("override /"): value for name, value in entry.items()}
    path = _find_yaml(stage, chosen[stage])
    return None if path is None else _read_yaml(path).get("_target_")


def _find_yaml(group: str, name: Any) -> Path | None:
    """The yaml of a method or variant, in conf/ or else in the folder of --config-dir; None if there is none."""
    paths = (folder / group / f"{name}.yaml" for folder in (CONF, *_own_folders()))
    return next((path for path in paths if path.is_file()), None)


def _own_folders() -> list[Path]:
    """The folder that --config-dir names, if any."""
    if not HydraConfig.initialized():
        return []
    sources = HydraConfig.get().runtime.config_sources
    return [Path(source.path) for source in sources if source.provider == "command-line"]


@cache
def _read_yaml(path: Path) -> Any:
    return OmegaConf.to_container(OmegaConf.load(path))


def build_options(values: Mapping[str, Any], *, resume: bool = False) -> Options:
    """What to run and where to write."""
    given = {name: values[name] for name in OPTIONS}
    built = {
        "sweep": values.get("sweep"),
        "select": build(Select, values["select"], where="select"),
        "evaluate": build(Evaluate, values["evaluate"], where="evaluate"),
        "label": {stage: values[stage]["_target_"].rsplit(".", 2)[-2] for stage in STAGES},
        "config": drop_replaced_fields(values),
        "resume": resume,
    }
    return build(Options, given | built, where="")


def build_variant(values: Mapping[str, Any], where: str) -> Any:
    """The spec whose class ``_target_`` names, with checked fields; ``auto`` variants return the one they select.

    Fields that have a ``_target_`` of their own are built first, to any depth. Raises BadInput. Warns on stderr that
    results of a class outside the package are found by its kind, version and fields, not by its code.
    """
    fields = {name: _build_field(value, f"{where}.{name}") for name, value in values.items()}
    cls = _find_class(fields.pop("_target_", None), f"{where}._target_")
    if where.split(".")[0] in STAGES and cls.__module__.split(".")[0] != "pipeline":
        _check_contract(cls, where)
        _check_kind(cls, where)
        print(f"warning: {where}: {OWN_CLASS_WARNING}", file=sys.stderr)
    variant: Any = build(cls, fields, where=where)
    return variant.resolve() if hasattr(variant, "resolve") else variant


def _build_field(value: Any, where: str) -> Any:
    return build_variant(value, where) if isinstance(value, Mapping) and "_target_" in value else value


def _find_class(target: object, where: str) -> type:
    """Import a spec class by its path. Raises BadInput."""
    if not isinstance(target, str):
        raise BadInput(where, found=repr(target), needed="the import path of a class")
    if target.split(".")[0] != "pipeline" and not _may_import_others():
        needed = "a class of pipeline; others are named in a yaml below the folder of --config-dir"
        raise BadInput(where, found=repr(target), needed=needed)
    try:
        cls = get_class(target)
    except (ImportError, ValueError, AttributeError) as error:
        raise BadInput(where, found=f"{target!r} ({error})", needed="the import path of a class") from None
    if not is_pydantic_dataclass(cls):
        raise BadInput(where, found=repr(target), needed="a class made with @spec")
    return cls


def _check_contract(cls: type, where: str) -> None:
    """Raise BadInput for an own variant of a stage that does not derive from the stage's base class."""
    hint = get_type_hints(Stages).get(where)
    base = get_origin(hint) or hint
    if base is not None and not issubclass(cls, base):
        place = f"{cls.__module__}.{cls.__qualname__}"
        needed = f"a subclass of {base.__name__} ({base.__module__})"
        raise BadInput(place, found="a class without the contract of its stage", needed=needed)


def _check_kind(cls: type, where: str) -> None:
    """Raise BadInput unless an own variant's kind follows the rule and is not that of a variant of the package."""
    module, kind = cls.__module__.split(".")[-1], getattr(cls, "kind", None)
    stage = where if where in STAGES else str(kind).split(".")[0]  # a nested field may hold a variant of another stage
    place = f"{cls.__module__}.{cls.__qualname__}.kind"
    if kind != f"{stage}.{module}":
        needed = f"{stage}.{module}, the stage and the file name: variants of one kind would share cached results"
        raise BadInput(place, found=repr(kind), needed=needed)
    if (CONF / stage / f"{module}.yaml").exists():
        raise BadInput(place, found=f"{kind!r}, which is the package's", needed="a file name of its own")


def _may_import_others() -> bool:
    """Whether classes outside the package may be imported.

    Importing runs code, so it takes a folder of the user's own yamls (--config-dir) and no ``_target_`` among the
    overrides.
    """
    return bool(_own_folders()) and not any("_target_" in line for line in HydraConfig.get().overrides.task)


def suggest_field(name: str) -> str:
    """Hint for an unknown field: variants that have it, a parent that is a value, or a field with a similar name."""
    known = _list_fields()
    if choices := known.get(name):
        return f"; {choices[0]} has it: add {choices[0]}" if len(choices) == 1 else f"; {', '.join(choices)} have it"
    group, dot, field = name.rpartition(".")
    if "." in group and group in known:
        return f"; {group} is a value and has no fields"
    return did_you_mean(field, [k.removeprefix(group + dot) for k in known if k.rpartition(".")[0] == group])


def suggest_variant(group: str, name: str) -> str:
    """The variant of a group with the most similar name."""
    return did_you_mean(name, [path.stem for path in (CONF / group).glob("*.yaml")])


def _list_fields() -> dict[str, list[str]]:
    """Every field that the package's yamls have, with the choices, such as ``dataset=photo``, that have it."""
    known: dict[str, list[str]] = {}
    for path in sorted(CONF.rglob("*.yaml")):
        values = OmegaConf.to_container(OmegaConf.load(path), resolve=False)
        is_global = path.parent == CONF or path.read_text().startswith("# @package _global_")
        group = "" if path.parent == CONF else path.parent.relative_to(CONF).as_posix()
        prefix = "" if is_global else group.replace("/", ".") + "."
        for name in [group, *_flatten(values, prefix)]:
            known.setdefault(name, []).append(f"{group}={path.stem}")
    return known


def _flatten(values: Any, prefix: str) -> list[str]:
    """Dotted names of all fields of nested mappings."""
    names = []
    for name, value in values.items() if isinstance(values, Mapping) else ():
        names += [f"{prefix}{name}", *_flatten(value, f"{prefix}{name}.")]
    return names


def _model_name(extract: Any) -> str:
    """Name of the extractor's model, by which fuse=auto looks for a head that was trained on its features."""
    try:
        return str(extract.model)
    except NotDownloaded:
        return str(extract.kind)  # no head ships for weights that have to be downloaded
