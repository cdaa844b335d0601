"""Errors shown to the user: one line that says where, what was found and what is needed."""

from __future__ import annotations


class DzopError(Exception):
    """An error that the user can fix. Its text is one line; the command line prints it and exits with status 1."""


class BadInput(DzopError):
    """A file, field or option that cannot be used."""

    def __init__(self, where: object, *, found: object, needed: str) -> None:
        self.where, self.found, self.needed = _line(where), _line(found), _line(needed, 2000)
        super().__init__(f"{self.where}: found {self.found}, needs {self.needed}")


def _line(value: object, length: int = 400) -> str:
    """A value, which may come from a file, as part of one line: no line breaks or NUL bytes, at most ``length``."""
    text = str(value)[: length + 1]
    text = " ".join(text.splitlines()).replace("\0", "\\0")
    return text if len(text) <= length else f"{text[:length]}..."


class NoPose(Exception):
    """Raised when a stage of the online route finds no pose; route.py turns it into a NoEstimate.

    A missing pose is data, not a failure. ``reason`` says what the stage found and what it needs.
    """

    def __init__(self, stage: str, reason: str) -> None:
        self.stage, self.reason = stage, reason
        super().__init__(f"{stage}: {reason}")
