"""Run the command line in this process, without the seconds that a new one takes to import."""

import io
import re
import signal
import sys
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import pytest

from pipeline.__main__ import main

TOY = (
    "dataset=bop", "dataset.name=toy", "method=dzop", "extract=pixels", "render.size=96", "overlays=false",
    "gallery=0", "threads=1", "runtime.progress=false", "evaluate.vsd=false",
)  # fmt: skip


def toy_arguments(scene: Path, folder: Path, *overrides: str) -> list[str]:
    """A quick run on the fixture ``scene``, with store and results below ``folder``."""
    places = (f"dataset.root={scene}", f"store.root={folder}/cache", f"out={folder}/results")
    return [*TOY, *places, *overrides]


@dataclass(frozen=True)
class CommandResult:
    status: int | None
    out: str
    err: str

    def counts(self) -> list[dict[str, tuple[int, int]]]:
        """(computed, reused) by step of every summary table printed."""
        tables: list[dict[str, tuple[int, int]]] = []
        for line in self.out.splitlines():
            if line.startswith("step ") and "computed" in line:
                tables.append({})
            elif tables and (row := re.fullmatch(r"([a-z ]{20}) +(\d+) +(\d+) +\d+\.\d", line)):
                tables[-1][row[1].strip()] = (int(row[2]), int(row[3]))
        return tables


def run_dzop(capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch, *arguments: str) -> CommandResult:
    """Run ``dzop`` with the arguments."""
    monkeypatch.setattr(sys, "argv", ["dzop", *arguments])
    capsys.readouterr()
    status = _exit_status()
    printed = capsys.readouterr()
    return _result(status, printed.out, printed.err)


def run_dzop_for_module(*arguments: str) -> CommandResult:
    """As run_dzop, for fixtures of a module or a session."""
    out, err = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out), redirect_stderr(err):
        patch.setattr(sys, "argv", ["dzop", *arguments])
        status = _exit_status()
    return _result(status, out.getvalue(), err.getvalue())


def _exit_status() -> int | str | None:
    try:
        main()
    except SystemExit as stop:
        return stop.code
    return 0


def _result(status: int | str | None, out: str, err: str) -> CommandResult:
    """The result as a shell sees it: a text given to sys.exit is printed, and the status is 1."""
    return CommandResult(1, out, err + status) if isinstance(status, str) else CommandResult(status, out, err)


def restore_signals() -> None:
    """Let a child process react to Ctrl-C and SIGHUP (``preexec_fn``): below ``&`` or nohup it would ignore them."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
