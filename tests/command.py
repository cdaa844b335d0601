"""Runs the command line in this process, as a shell would, and gives back what it printed."""

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
            elif tables and len(line) == 50 and not line.startswith("whole run"):
                tables[-1][line[:20].strip()] = (int(line[20:30]), int(line[30:40]))
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
