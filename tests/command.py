"""Runs the command line in this process, as a shell would, and gives back what it printed."""

import re
import signal
import sys
from dataclasses import dataclass

import pytest

from pipeline.__main__ import main


@dataclass(frozen=True)
class Ran:
    status: int | str | None
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


def run_dzop(capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch, *arguments: str) -> Ran:
    monkeypatch.setattr(sys, "argv", ["dzop", *arguments])
    capsys.readouterr()
    status: int | str | None = 0
    try:
        main()
    except SystemExit as stop:
        status = stop.code
    printed = capsys.readouterr()
    err = printed.err + (status if isinstance(status, str) else "")
    return Ran(1 if isinstance(status, str) else status, printed.out, err)


def heeds_ctrl_c() -> None:
    """For a child before it starts: what a shell runs in the background ignores SIGINT, and so do its children."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
