"""The command line: configuration -> a run. The only module that knows Hydra.

``dzop ...`` and ``python -m pipeline ...`` are the same. ``dzop cache ...`` looks after the store.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from pipeline.cache_cli import cache_command
from pipeline.errors import BadInput, DzopError
from pipeline.route import Stages
from pipeline.run import Options, Select, run
from pipeline.spec import Runtime, build
from pipeline.store import Store

STAGES = ("render", "extract", "crop", "match", "fuse", "cluster", "correspond", "solve", "detect")
PACKAGE = Path(__file__).resolve().parent
CONF = next(folder for folder in (PACKAGE / "conf", PACKAGE.parent / "conf") if folder.is_dir())
_failed_jobs: list[str] = []


def main() -> None:
    """Run, and turn whatever a user can mend into one line on stderr and exit status 1."""
    _failed_jobs.clear()
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra raises instead of printing a paragraph; the line below is the message
    try:
        if sys.argv[1:2] == ["cache"]:
            cache_command(sys.argv[2:])
        else:
            _hydra_main()
            if _failed_jobs:
                sys.exit(f"error: {len(_failed_jobs)} of the sweep's jobs failed: {'; '.join(_failed_jobs)}")
    except (DzopError, HydraException, OmegaConfBaseException) as error:
        sys.exit(_told(error))
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # the reader of a pipe has left: not a fault
        sys.exit(1)
    except KeyboardInterrupt:
        sys.exit("interrupted: what was complete is kept, and the next run goes on from there")


@hydra.main(config_path=str(CONF), config_name="config", version_base="1.3")
def _hydra_main(config: DictConfig) -> None:
    try:
        _job(config)
    except MissingMandatoryValue as error:
        _give_up(BadInput(error.full_key, found="nothing", needed="a value: the yaml in conf/ says which"))
    except DzopError as error:
        _give_up(error)


def _give_up(error: DzopError) -> None:
    """End with the error; in a sweep go on, and end with the errors of all its jobs."""
    told = _told(error)
    if HydraConfig.get().mode is RunMode.RUN:
        sys.exit(told)
    print(told, file=sys.stderr, flush=True)
    _failed_jobs.append(f"{' '.join(HydraConfig.get().overrides.task)} ({told.removeprefix('error: ')})")


def _job(config: DictConfig) -> None:
    # one plain dict, so that nothing below knows OmegaConf
    values = cast(dict[str, Any], OmegaConf.to_container(config, resolve=True, throw_on_missing=True))
    run(
        stages=stages_of(values),
        dataset=variant(values["dataset"], "dataset"),
        store=Store(variant(values["store"], "store"), announce=lambda text: print(text, file=sys.stderr)),
        runtime=build(Runtime, values["runtime"], where="runtime"),
        options=options_of(values),
    )


def stages_of(values: Mapping[str, Any]) -> Stages:
    """The stages a configuration chooses."""
    chosen = {name: variant(values[name], name) for name in STAGES}
    if not isinstance(values["fallback"], bool):
        raise BadInput("fallback", found=repr(values["fallback"]), needed="true or false")
    return Stages(**chosen, fallback=values["fallback"])


def options_of(values: Mapping[str, Any]) -> Options:
    """What to run and where to write, from a configuration."""
    names = ("step", "plan", "out", "overlays", "threads", "method")
    select = build(Select, values["select"], where="select")
    label = {stage: values[stage]["_target_"].rsplit(".", 2)[-2] for stage in STAGES}
    return build(
        Options,
        {**{name: values[name] for name in names}, "select": select, "config": values, "label": label},
        where="config",
    )


def variant(values: Mapping[str, Any], where: str) -> Any:
    """The spec that ``_target_`` names, with its fields checked; ``auto`` variants answer with a concrete one."""
    fields = dict(values)
    target = fields.pop("_target_", None)
    if not isinstance(target, str):
        raise BadInput(f"{where}._target_", found=repr(target), needed="the import path of a class")
    try:
        cls = hydra.utils.get_class(target)
    except (ImportError, ValueError, AttributeError) as error:
        raise BadInput(
            f"{where}._target_", found=f"{target!r} ({error})", needed="the import path of a class"
        ) from None
    chosen: Any = build(cls, fields, where=where)
    return chosen.resolve() if hasattr(chosen, "resolve") else chosen


def _told(error: BaseException) -> str:
    """One line; Hydra's list of the places it searched adds nothing."""
    return "error: " + " ".join(str(error).split("\nConfig search path")[0].split())


if __name__ == "__main__":
    main()
