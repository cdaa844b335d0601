"""What a user is told: one line that names the place, what was found and what is needed."""

from __future__ import annotations


class DzopError(Exception):
    """Anything a user can mend. Its text is one line; the command line prints it and exits with 1."""


class BadInput(DzopError):
    """A file, a field or an option that cannot be used."""

    def __init__(self, where: object, *, found: object, needed: str) -> None:
        self.where, self.found, self.needed = _line(where), _line(found), _line(needed, 2000)
        super().__init__(f"{self.where}: found {self.found}, needs {self.needed}")


def _line(value: object, length: int = 400) -> str:
    """A value as part of one line, whatever a file made of it."""
    text = str(value)[: length + 1]
    text = " ".join(text.splitlines()).replace("\0", "\\0")
    return text if len(text) <= length else f"{text[:length]}..."


class NoPose(Exception):
    """Raised inside the online route; route.py turns it into a NoEstimate, which is data, not a failure.

    ``stage`` is the stage that gave up; ``reason`` says what it found and what it needs.
    """

    def __init__(self, stage: str, reason: str) -> None:
        self.stage, self.reason = stage, reason
        super().__init__(f"{stage}: {reason}")
