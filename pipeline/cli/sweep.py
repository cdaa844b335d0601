"""Jobs of a sweep, recorded by every job, whatever process runs it: what failed, and whether any answer differs."""

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

FOLDER_VARIABLE = "DZOP_SWEEP_JOBS"
"""Environment variable through which jobs in other processes learn the folder to write their outcome to."""
MAX_NAMED = 3  # failed jobs, and reasons, in the last line; all of them are printed when they fail and in the report
MAX_REASON = 240  # characters


@dataclass(frozen=True)
class SweepJobs:
    """Outcomes of a sweep's jobs, one file per job in a temporary folder."""

    folder: Path

    @classmethod
    def start(cls) -> SweepJobs:
        """Choose a folder and announce it to the jobs. The first job that ends creates it."""
        cwd = Path.cwd()
        parent = cwd if os.access(cwd, os.W_OK) else Path(tempfile.gettempdir())  # jobs on other nodes see the cwd
        folder = parent / f".dzop-jobs-{os.getpid()}-{time.time_ns()}"
        os.environ[FOLDER_VARIABLE] = str(folder)
        return cls(folder)

    def list_failed(self) -> list[tuple[list[str], str]]:
        """Overrides and error message of every failed job."""
        return self._read("failed")

    def list_finished(self) -> list[tuple[list[str], str]]:
        """Overrides and digest of the answers of every other job that has answers."""
        return self._read("done")

    def _read(self, outcome: str) -> list[tuple[list[str], str]]:
        jobs = [json.loads(path.read_text()) for path in sorted(self.folder.glob(f"*.{outcome}"))]
        return [(overrides, text) for overrides, text in jobs]

    def remove(self) -> None:
        """Delete the folder."""
        shutil.rmtree(self.folder, ignore_errors=True)


def record_failed_job(config: Mapping[str, Any], number: int, overrides: Sequence[str], message: str) -> None:
    """Record that a job failed: for the last line of its sweep, and for reports."""
    from pipeline.outputs.records import write_failure_record  # slow to import, and most jobs succeed

    _record_job(number, "failed", overrides, message)
    values = {name: _to_json(value) for name, value in config.items()}
    write_failure_record(values.get("out", "results"), values, overrides, message)


def record_finished_job(number: int, overrides: Sequence[str], answers: str) -> None:
    """Record the digest of a job's answers; "" for a job without answers is not recorded."""
    if answers:
        _record_job(number, "done", overrides, answers)


def _record_job(number: int, outcome: str, overrides: Sequence[str], text: str) -> None:
    if folder := os.environ.get(FOLDER_VARIABLE):  # not set on other machines of Ray's launcher
        write_atomic(Path(folder) / f"{number:06d}.{outcome}", json.dumps([overrides, text]))


def same_answers_text(finished: Sequence[tuple[Sequence[str], str]]) -> str:
    """A note that all jobs of a sweep have the same answers; "" where one differs, or where only the scoring varies."""
    if len(finished) < 2 or len({answers for _, answers in finished}) > 1:
        return ""
    values: dict[str, set[str]] = {}
    for overrides, _ in finished:
        for name, _, value in (override.partition("=") for override in overrides):
            values.setdefault(name, set()).add(value)
    swept = [name for name, different in values.items() if len(different) > 1 and not name.startswith("evaluate.")]
    text = f"note: {' and '.join(swept)} changed no answer: all {len(finished)} jobs gave the same poses and scores"
    return text if swept else ""


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
