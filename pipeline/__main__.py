"""The command line: configuration -> a run. The only module that knows Hydra.

``dzop ...`` and ``python -m pipeline ...`` are the same. ``dzop cache ...`` looks after the store; ``dzop score ...``
and ``dzop lint ...`` take results files.
"""

from __future__ import annotations

import signal

if __name__ == "__main__" and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C while the packages below load ends quietly: nothing has begun

import json
import logging
import math
import os
import shutil
import sys
import tempfile
import textwrap
import time
import traceback
import warnings
from collections.abc import Mapping, Sequence
from concurrent.futures import BrokenExecutor
from contextlib import nullcontext
from pathlib import Path
from typing import Any, cast

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException
from pydantic.dataclasses import is_pydantic_dataclass

from pipeline.cli.cache import cache_command
from pipeline.cli.score import lint_command, score_command
from pipeline.errors import BadInput, DzopError
from pipeline.io.checkpoints import NotDownloaded, offline
from pipeline.io.files import write_atomic
from pipeline.options import Evaluate, Options, Select
from pipeline.outputs.records import write_failure_record
from pipeline.route import SecondLook, Stages
from pipeline.run import make_report, run
from pipeline.spec import build
from pipeline.store import Store

STAGES = ("render", "extract", "crop", "match", "fuse", "cluster", "correspond", "solve", "choose", "refine", "detect")
OPTIONS = ("step", "plan", "out", "overlays", "gallery", "threads", "method")
NEEDED = (*STAGES, *OPTIONS, "second_look", "fallback", "dataset", "store", "runtime", "select", "evaluate")
"""What config.yaml has, and ``~`` on the command line can take away."""
PACKAGE = Path(__file__).resolve().parent
CONF = next(folder for folder in (PACKAGE / "conf", PACKAGE.parent / "conf") if folder.is_dir())
COMMANDS = {"cache": cache_command, "score": score_command, "lint": lint_command}
FAILED = "DZOP_FAILED_JOBS"
"""Environment variable: folder where a sweep's jobs, in whatever process a launcher runs them, leave their errors."""
CLOSING = 3
"""Failed jobs, and reasons, that a sweep's last line names; all are told when they fail and in the report."""
QUOTED = """'dataset.image="my shot.png"'"""
KILLED = "a process of the sweep was killed, often for want of memory; the same command goes on where it stopped"


def main() -> None:
    """Run, and turn whatever a user can mend into one line on stderr and exit status 1."""
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra raises instead of printing a paragraph; the line below is the message
    # what Ctrl-C leaves behind of a read or write
    warnings.filterwarnings("ignore", message="coroutine .* was never awaited", category=RuntimeWarning)
    logging.raiseExceptions = False  # Hydra's log of a sweep's jobs has no more to say once its reader has left
    try:
        if sys.argv[1:2] and sys.argv[1] in COMMANDS:
            COMMANDS[sys.argv[1]](sys.argv[2:])
        else:
            _run_jobs()
    except (DzopError, HydraException, OmegaConfBaseException) as error:
        sys.exit(_told(error))
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # the reader of a pipe has left: not a fault
        sys.exit(1)
    except BrokenExecutor:
        sys.exit(f"error: {KILLED}")
    except OSError as error:
        if error.errno is None:
            raise
        where = "" if error.filename is None else f"{error.filename}: "
        sys.exit(f"error: {where}{error.strerror}; what was complete is kept, and the next run goes on from there")
    except MemoryError:
        sys.exit("error: the memory is spent; what was complete is kept, and the next run goes on from there")
    except Exception as error:
        if not _hydras_own(error):
            raise
        sys.exit(_told(error))  # some overrides it answers with a ValueError
    except KeyboardInterrupt:
        sys.exit("interrupted: what was complete is kept, and the next run goes on from there")


def _hydras_own(error: BaseException) -> bool:
    """Whether an error was raised while Hydra read the command line, not by a run."""
    frames = [frame.filename for frame in traceback.extract_tb(error.__traceback__)]
    return not any(Path(name).is_relative_to(PACKAGE) and not name.endswith("__main__.py") for name in frames) and any(
        part in Path(frames[-1]).parts for part in ("hydra", "omegaconf", "antlr4", "yaml")
    )


def _run_jobs() -> None:
    """The run, or all jobs of a sweep, and then in one line those that failed."""
    shared = Path.cwd() if os.access(Path.cwd(), os.W_OK) else Path(tempfile.gettempdir())  # jobs on other nodes see it
    folder = shared / f".dzop-failed-{os.getpid()}-{time.time_ns()}"  # made by the first that fails
    os.environ[FAILED] = str(folder)
    try:
        _hydra_main()
        failed = [json.loads(path.read_text()) for path in sorted(folder.glob("*"))]
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    if failed:
        sys.exit(f"error: {len(failed)} of the sweep's jobs failed: {_closing(failed)}")


def _closing(failed: Sequence[tuple[Sequence[str], str]]) -> str:
    """Which jobs, by what each has and the command line does not say of all, and why; those of one reason together."""
    by_reason: dict[str, list[str]] = {}
    for overrides, message in failed:
        own = " ".join(word for word in overrides if word not in sys.argv) or "a job"
        by_reason.setdefault(message, []).append(own)
    told = [
        f"{_first(jobs, ', ')} ({textwrap.shorten(why, 240, placeholder=' ...')})" for why, jobs in by_reason.items()
    ]
    return _first(told, "; ")


def _first(parts: Sequence[str], comma: str) -> str:
    """The first few, and how many there are beside them."""
    more = f"{comma}and {len(parts) - CLOSING} more, told above" if len(parts) > CLOSING else ""
    return comma.join(parts[:CLOSING]) + more


@hydra.main(config_path=str(CONF), config_name="config", version_base="1.3")
def _hydra_main(config: DictConfig) -> None:
    sweeping = HydraConfig.get().mode is RunMode.MULTIRUN
    try:
        _job(config, sweeping=sweeping)
    except MissingMandatoryValue as error:
        _give_up(config, BadInput(error.full_key, found="nothing", needed="a value: the yaml in conf/ says which"))
    except OmegaConfBaseException as error:
        _give_up(config, DzopError(_told(error).removeprefix("error: ")))
    except DzopError as error:
        _give_up(config, error)
    except BrokenPipeError:
        raise  # the reader has left: no job's fault
    except Exception as error:
        if not sweeping:
            raise
        place = traceback.extract_tb(error.__traceback__)[-1]
        _give_up(config, DzopError(f"{type(error).__name__}: {error} ({Path(place.filename).name}:{place.lineno})"))


def _give_up(config: DictConfig, error: DzopError) -> None:
    """End with the error; a sweep's job leaves it for the end and for reports, and the sweep goes on."""
    told = _told(error)
    if HydraConfig.get().mode is RunMode.RUN:
        sys.exit(told)
    print(told, file=sys.stderr, flush=True)
    overrides = list(HydraConfig.get().overrides.task)
    message = told.removeprefix("error: ")
    number = int(HydraConfig.get().job.num)
    if folder := os.environ.get(FAILED):  # Ray's launcher does not take it to another machine: there the row must do
        write_atomic(Path(folder) / f"{number:06d}", json.dumps([overrides, message]))
    try:
        plain = OmegaConf.to_container(config, resolve=True)
    except OmegaConfBaseException:  # a value that stands for another which is not there
        plain = OmegaConf.to_container(config, resolve=False)
    values = cast(dict[str, Any], _writable(plain))
    write_failure_record(values.get("out", "results"), values, overrides, message)


def _writable(value: Any) -> Any:
    """A configuration as JSON can hold it: numbers that are none, often what made the job fail, as text."""
    if isinstance(value, dict):
        return {str(name): _writable(item) for name, item in value.items()}
    if isinstance(value, list):
        return [_writable(item) for item in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def _job(config: DictConfig, *, sweeping: bool) -> None:
    # one plain dict, so that nothing below knows OmegaConf
    values = cast(dict[str, Any], OmegaConf.to_container(config, resolve=True, throw_on_missing=True))
    for name in NEEDED:
        if name not in values:
            raise BadInput(name, found="nothing", needed=f"a value: leave ~{name} out")
    if values["step"] == "report":
        if values["plan"]:
            raise BadInput("plan=true step=report", found="a step without a plan", needed="plan=false, or another step")
        make_report(values["out"])
        return
    with offline() if values["plan"] is True else nullcontext():
        _run(values, resume=sweeping)


def _run(values: dict[str, Any], *, resume: bool) -> None:
    run(
        stages=stages_of(values),
        dataset=variant(values["dataset"], "dataset"),
        store=Store(variant(values["store"], "store"), announce=lambda text: print(text, file=sys.stderr)),
        runtime=variant(values["runtime"], "runtime"),
        options=options_of(values, resume=resume),
    )


def stages_of(values: Mapping[str, Any]) -> Stages:
    """The stages a configuration chooses."""
    chosen = {name: variant(values[name], name) for name in STAGES}
    if hasattr(chosen["fuse"], "resolve_for"):
        chosen["fuse"] = chosen["fuse"].resolve_for(_model_of(chosen["extract"]))
    if not isinstance(values["fallback"], bool):
        raise BadInput("fallback", found=repr(values["fallback"]), needed="true or false")
    looks: SecondLook = variant(values["second_look"], "second_look")
    return Stages(**chosen, fallback=values["fallback"], second_look=looks.hypotheses)


def _model_of(extract: Any) -> str:
    try:
        return str(extract.model)
    except NotDownloaded:
        return str(extract.kind)  # a head is trained on weights that ship, never on such as have to be fetched


def options_of(values: Mapping[str, Any], *, resume: bool = False) -> Options:
    """What to run and where to write, from a configuration."""
    made = {
        "sweep": values.get("sweep"),
        "select": build(Select, values["select"], where="select"),
        "evaluate": build(Evaluate, values["evaluate"], where="evaluate"),
        "label": {stage: values[stage]["_target_"].rsplit(".", 2)[-2] for stage in STAGES},
        "config": values,
        "resume": resume,
    }
    return build(Options, {**{name: values[name] for name in OPTIONS}, **made}, where="config")


def variant(values: Mapping[str, Any], where: str) -> Any:
    """The spec that ``_target_`` names, with its fields checked; ``auto`` variants answer with a concrete one.

    A field whose value has a ``_target_`` of its own is built first, to any depth: a variant made of variants.
    """
    fields = {name: _nested(value, f"{where}.{name}") for name, value in values.items()}
    target = fields.pop("_target_", None)
    if not isinstance(target, str):
        raise BadInput(f"{where}._target_", found=repr(target), needed="the import path of a class")
    if target.split(".")[0] != "pipeline" and not _own_yamls():
        needed = "a class of pipeline; others are named in a yaml below the folder of --config-dir"
        raise BadInput(f"{where}._target_", found=repr(target), needed=needed)
    try:
        cls = hydra.utils.get_class(target)
    except (ImportError, ValueError, AttributeError) as error:
        raise BadInput(
            f"{where}._target_", found=f"{target!r} ({error})", needed="the import path of a class"
        ) from None
    if not is_pydantic_dataclass(cls):
        raise BadInput(f"{where}._target_", found=repr(target), needed="a class made with @spec")
    chosen: Any = build(cls, fields, where=where)
    return chosen.resolve() if hasattr(chosen, "resolve") else chosen


def _own_yamls() -> bool:
    """Whether the user gave a folder of yamls and set no class beside them: only then others are imported."""
    if not HydraConfig.initialized():
        return False
    told = HydraConfig.get()
    given = any(source.provider == "command-line" for source in told.runtime.config_sources)
    return given and not any("_target_" in override for override in told.overrides.task)


def _nested(value: Any, where: str) -> Any:
    return variant(value, where) if isinstance(value, Mapping) and "_target_" in value else value


def _told(error: BaseException) -> str:
    """One line; Hydra's list of the places it searched adds nothing, nor does its advice to append what is misspelt."""
    text = str(error).split("\nConfig search path")[0]
    if text.startswith("Could not override"):
        text = f"{text.splitlines()[0].rstrip('.')}: found no such field, needs one that the yamls in conf/ have"
    if "hydra.cc" in text:  # a value that its grammar cannot read
        text = f"{text.split('See https')[0].strip()}: a value with such signs needs both quotes, as {QUOTED}"
    return "error: " + " ".join(text.split())


if __name__ == "__main__":
    if signal.getsignal(signal.SIGINT) is signal.SIG_DFL:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    main()
