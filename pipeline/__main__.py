"""The command line: Hydra composes the configuration, ``pipeline.run`` runs it.

``dzop ...`` and ``python -m pipeline ...`` are the same. ``dzop cache`` manages the store, ``dzop fetch`` downloads
datasets, ``dzop reproduce`` runs what the paper ran; ``dzop score`` and ``dzop lint`` read results files;
``dzop symmetry`` finds symmetries of meshes, ``dzop watch`` estimates poses of new photographs in a folder.
"""

from __future__ import annotations

import signal

# Ctrl-C during the slow imports below ends the process without a traceback: nothing has been computed yet.
if __name__ == "__main__" and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, signal.SIG_DFL)

import importlib
import logging
import os
import sys
import traceback
import warnings
from collections.abc import Callable
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

from pipeline.cli.termination import Terminated, WorkerLost, stop_children, stop_on_lost_workers, stop_on_signals
from pipeline.errors import BadInput, DzopError
from pipeline.io.digests import track_files
from pipeline.places import CONF, PACKAGE

COMMANDS = ("cache", "doctor", "fetch", "lint", "reproduce", "score", "symmetry", "watch")
"""Commands beside a run; each is ``<name>_command`` of a module of pipeline/cli."""
RESUME = "Completed entries are cached; rerun to resume."
READERS = ("__main__.py", "configuration.py")  # our modules whose frames may lie between Hydra's
NEEDED = {
    "dataset.K": "[fx,fy,cx,cy] in pixels",
    "dataset.mesh": "the file of a mesh in millimetres",
    "dataset.image": "the photograph's file",
    "dataset.root": "the dataset's folder",
    "detect.path": "a detector's json file",
    "store.url": "s3://bucket/prefix",
}
"""What required fields take, by name."""
QUOTING_EXAMPLE = """'dataset.image="my shot.png"'"""


def main() -> None:
    """Run the command line. Errors that a user can fix become one line on stderr and exit status 1."""
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra raises its errors instead of printing them
    # Ctrl-C during a read or write of the store leaves a coroutine of zarr behind.
    warnings.filterwarnings("ignore", message="coroutine .* was never awaited", category=RuntimeWarning)
    _silence_resource_trackers()
    logging.raiseExceptions = False  # no traceback when Hydra logs a sweep's job to a closed pipe
    try:
        with stop_on_signals(), stop_on_lost_workers():
            if sys.argv[1:2] and sys.argv[1] in COMMANDS:
                # Files of one run must not change, but dzop watch waits for files that do.
                with nullcontext() if sys.argv[1] == "watch" else track_files():
                    _load_command(sys.argv[1])(sys.argv[2:])
            else:
                _run_jobs()
    except BrokenPipeError:  # the reader of a pipe, such as head, has closed it: not an error
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except (Exception, KeyboardInterrupt) as error:
        if isinstance(error, KeyboardInterrupt):
            stop_children()
        message = _exit_message(error)
        if message is None:
            raise
        if isinstance(error, WorkerLost):  # at exit, Python would wait for loky's thread, which waits for ever
            print(message, file=sys.stderr, flush=True)
            os._exit(1)
        sys.exit(message)


def _load_command(name: str) -> Callable[[list[str]], None]:
    """The function of a command. Its modules are imported now, so that ``--help`` does not wait for them."""
    module = importlib.import_module(f"pipeline.cli.{'score' if name == 'lint' else name}")
    return cast(Callable[[list[str]], None], getattr(module, f"{name}_command"))


def _silence_resource_trackers() -> None:
    """Let joblib's resource trackers, processes of their own, report no semaphores of a sweep that was ended."""
    silence, given = "ignore:resource_tracker:UserWarning", os.environ.get("PYTHONWARNINGS", "")
    if silence not in given:
        os.environ["PYTHONWARNINGS"] = f"{given},{silence}".strip(",")


def _exit_message(error: BaseException) -> str | None:
    """The line to exit with; None for a bug, which keeps its traceback."""
    if isinstance(error, DzopError | HydraException | OmegaConfBaseException):
        return _format_error(error)
    if isinstance(error, BrokenExecutor | WorkerLost):
        return f"error: a worker process was killed, usually because memory ran out. {RESUME}"
    if isinstance(error, OSError) and error.errno is not None:
        where = "" if error.filename is None else f"{error.filename}: "
        return f"error: {where}{error.strerror}. {RESUME}"
    if isinstance(error, MemoryError):
        return f"error: out of memory. {RESUME}"
    if isinstance(error, KeyboardInterrupt):
        return f"{'terminated' if isinstance(error, Terminated) else 'interrupted'}. {RESUME}"
    return _format_error(error) if _comes_from_hydra(error) else None


def _comes_from_hydra(error: BaseException) -> bool:
    """Whether Hydra or its parsers raised an error while reading the command line: some overrides give ValueError."""
    files = [Path(frame.filename) for frame in traceback.extract_tb(error.__traceback__)]
    in_run = any(file.is_relative_to(PACKAGE) and file.name not in READERS for file in files)
    return not in_run and any(name in files[-1].parts for name in ("hydra", "omegaconf", "antlr4", "yaml"))


def _format_error(error: BaseException) -> str:
    """An error as one line, without the parts of Hydra's messages that do not help here."""
    if isinstance(error, DzopError):
        return "error: " + " ".join(str(error).split())
    from pipeline.configuration import suggest_field, suggest_variant

    text = str(error).split("\nConfig search path")[0]
    if text.startswith("Could not override"):
        name = text.split("'")[1]
        needed = f"needs one that dzop --cfg job lists{suggest_field(name)}"
        text = f"Could not override '{name}': found no such field, {needed}"
    if "Could not find '" in text:
        name, _, listed = text.partition("Could not find '")[2].partition("'")
        group, _, variant = name.rpartition("/")
        note = f" (own variants need --config-dir){suggest_variant(group, variant)}"
        text = f"Could not find '{name}'{note} {listed}"
    if text.startswith("Ambiguous value for argument"):
        name, _, value = text.split("'")[1].partition("=")
        needed = f"brackets around a list, and quotes: '{name}=[{value}]'; or -m, which sweeps over the values"
        return f"error: {name}: found {value}, needs {needed}"
    if "hydra.cc" in text:  # a value that Hydra's grammar cannot parse
        text = text.split("See https")[0].strip()
        if "missing EQUAL" in text:
            return f"error: found {text.split()[3]}, needs NAME=VALUE, such as step=report; dzop --help has examples"
        text = f"{text}: a value with special characters needs both kinds of quotes, as {QUOTING_EXAMPLE}"
    return "error: " + " ".join(text.split())


# --- jobs ------------------------------------------------------------------------------------------------------------


def _run_jobs() -> None:
    """Run one job, or all jobs of a sweep. Exits with one line that names the jobs that failed."""
    from pipeline.cli.sweep import SweepJobs, failures_text, same_answers_text

    jobs = SweepJobs.start()
    try:
        _hydra_main()
        failed, note = jobs.list_failed(), same_answers_text(jobs.list_finished())
    finally:
        jobs.remove()
    if note:
        print(f"\n{note}")
    if failed:
        sys.exit(f"error: {len(failed)} of the sweep's jobs failed: {failures_text(failed, sys.argv)}")


@hydra.main(config_path=str(CONF), config_name="config", version_base="1.3")
def _hydra_main(config: DictConfig) -> None:
    """Run one job. A sweep goes on after a job that fails, whatever the error."""
    from pipeline.cli.sweep import record_finished_job

    sweeping = HydraConfig.get().mode is RunMode.MULTIRUN
    try:
        answers = _run_job(config, resume=sweeping)
        if sweeping:
            job = HydraConfig.get()
            record_finished_job(int(job.job.num), list(job.overrides.task), answers)
    except MissingMandatoryValue as error:
        needed = NEEDED.get(str(error.full_key), "a value; the yaml in conf/ explains it")
        _fail_job(config, BadInput(error.full_key, found="nothing", needed=needed))
    except OmegaConfBaseException as error:
        _fail_job(config, DzopError(_format_error(error).removeprefix("error: ")))
    except DzopError as error:
        _fail_job(config, error)
    except BrokenPipeError:
        raise  # a closed pipe ends the whole sweep
    except Exception as error:
        if not sweeping:
            raise
        frame = traceback.extract_tb(error.__traceback__)[-1]
        _fail_job(config, DzopError(f"{type(error).__name__}: {error} ({Path(frame.filename).name}:{frame.lineno})"))


def _run_job(config: DictConfig, *, resume: bool) -> str:
    """Run one job; returns the digest of its answers, "" for none."""
    # These import torch and Zarr, which takes seconds: --help and a mistake on the command line come before.
    from pipeline.configuration import build_options, build_stages, build_variant, check_fields
    from pipeline.io.checkpoints import offline
    from pipeline.run import make_report, run
    from pipeline.store import Store

    # plain dicts: nothing below knows OmegaConf
    values = cast(dict[str, Any], OmegaConf.to_container(config, resolve=True, throw_on_missing=True))
    check_fields(values)
    if values["step"] == "report":
        if values["plan"]:
            raise BadInput("plan=true step=report", found="a step without a plan", needed="plan=false, or another step")
        make_report(values["out"])
        return ""
    # Building stages hashes weights already: the files of a run are tracked from here on.
    with track_files(), offline() if values["plan"] is True else nullcontext():
        return run(
            stages=build_stages(values),
            dataset=build_variant(values["dataset"], "dataset"),
            store=Store(build_variant(values["store"], "store"), announce=lambda text: print(text, file=sys.stderr)),
            runtime=build_variant(values["runtime"], "runtime"),
            options=build_options(values, resume=resume),
        )


def _fail_job(config: DictConfig, error: DzopError) -> None:
    """Exit with an error. In a sweep, print and record it instead, so that the sweep goes on."""
    from pipeline.cli.sweep import record_failed_job

    text = _format_error(error)
    if HydraConfig.get().mode is RunMode.RUN:
        sys.exit(text)
    print(text, file=sys.stderr, flush=True)
    try:
        values = OmegaConf.to_container(config, resolve=True)
    except OmegaConfBaseException:  # an interpolation of a value that does not exist
        values = OmegaConf.to_container(config, resolve=False)
    job = HydraConfig.get()
    record_failed_job(
        cast(dict[str, Any], values), int(job.job.num), list(job.overrides.task), text.removeprefix("error: ")
    )


if __name__ == "__main__":
    if signal.getsignal(signal.SIGINT) is signal.SIG_DFL:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    main()
