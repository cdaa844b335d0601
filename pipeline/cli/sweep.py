"""Failed jobs of a sweep: recorded by every job, whatever process runs it, and named in the command's last line."""

from __future__ import annotations

import json
import math
import os
import shutil
import tempfile
import textwrap
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.io.files import write_atomic
from pipeline.outputs.records import write_failure_record

FOLDER_VARIABLE = "DZOP_FAILED_JOBS"
"""Environment variable through which jobs in other processes learn the folder to write their errors to."""
MAX_NAMED = 3  # failed jobs, and reasons, in the last line; all of them are printed when they fail and in the report
MAX_REASON = 240  # characters


@dataclass(frozen=True)
class FailedJobs:
    """Errors of a sweep's jobs, one file per failed job in a temporary folder."""

    folder: Path

    @classmethod
    def start(cls) -> FailedJobs:
        """Choose a folder and announce it to the jobs. The first job that fails creates it."""
        cwd = Path.cwd()
        parent = cwd if os.access(cwd, os.W_OK) else Path(tempfile.gettempdir())  # jobs on other nodes see the cwd
        folder = parent / f".dzop-failed-{os.getpid()}-{time.time_ns()}"
        os.environ[FOLDER_VARIABLE] = str(folder)
        return cls(folder)

    def read(self) -> list[tuple[list[str], str]]:
        """Overrides and error message of every failed job."""
        failed = [json.loads(path.read_text()) for path in sorted(self.folder.glob("*"))]
        return [(overrides, message) for overrides, message in failed]

    def remove(self) -> None:
        """Delete the folder."""
        shutil.rmtree(self.folder, ignore_errors=True)


def record_failed_job(config: Mapping[str, Any], number: int, overrides: Sequence[str], message: str) -> None:
    """Record that a job failed: for the last line of its sweep, and for reports."""
    if folder := os.environ.get(FOLDER_VARIABLE):  # not set on other machines of Ray's launcher
        write_atomic(Path(folder) / f"{number:06d}", json.dumps([overrides, message]))
    values = {name: _to_json(value) for name, value in config.items()}
    write_failure_record(values.get("out", "results"), values, overrides, message)


def failures_text(failed: Sequence[tuple[Sequence[str], str]], command: Sequence[str]) -> str:
    """Failed jobs grouped by reason. A job is named by its overrides that are not already in ``command``."""
    jobs_by_reason: dict[str, list[str]] = {}
    for overrides, message in failed:
        name = " ".join(word for word in overrides if word not in command) or "a job"
        jobs_by_reason.setdefault(message, []).append(name)
    texts = [
        f"{_join_first(jobs, ', ')} ({textwrap.shorten(reason, MAX_REASON, placeholder=' ...')})"
        for reason, jobs in jobs_by_reason.items()
    ]
    return _join_first(texts, "; ")


def _join_first(texts: Sequence[str], separator: str) -> str:
    more = f"{separator}and {len(texts) - MAX_NAMED} more, see above" if len(texts) > MAX_NAMED else ""
    return separator.join(texts[:MAX_NAMED]) + more


def _to_json(value: Any) -> Any:
    """Replace nan and inf, which JSON lacks and which are often why a job failed, by text."""
    if isinstance(value, Mapping):
        return {str(name): _to_json(item) for name, item in value.items()}
    if isinstance(value, list):
        return [_to_json(item) for item in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value
