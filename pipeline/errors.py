"""What a user is told: one line that names the place, what was found and what is needed."""

from __future__ import annotations


class DzopError(Exception):
    """Anything a user can mend. Its text is one line; the command line prints it and exits with 1."""


class BadInput(DzopError):
    """A file, a field or an option that cannot be used."""

    def __init__(self, where: object, *, found: object, needed: str) -> None:
        self.where, self.found, self.needed = str(where), str(found), needed
        super().__init__(f"{where}: found {found}, needs {needed}")


class NoPose(Exception):
    """Raised inside the online route; route.py turns it into a NoEstimate, which is data, not a failure.

    ``stage`` is the stage that gave up; ``reason`` says what it found and what it needs.
    """

    def __init__(self, stage: str, reason: str) -> None:
        self.stage, self.reason = stage, reason
        super().__init__(f"{stage}: {reason}")
