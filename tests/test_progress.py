"""Progress: what a log file gets where a terminal would show bars."""

import pytest

from pipeline import progress
from pipeline.progress import Progress, format_duration, progress_line


class Clock:
    """A clock that a test moves."""

    def __init__(self) -> None:
        self.now = 0.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(progress, "time", made)
    return made


def advance_nested_bars(shown: Progress, clock: Clock, *, title: str = "poses") -> None:
    with shown.bar(100, title, "target") as outer, shown.bar(50, "", "row") as inner:
        for _ in range(100):
            clock.now += 1.0
            outer(1)
            inner(1)


def test_a_log_file_gets_a_line_every_30_s(clock, capsys):
    advance_nested_bars(Progress(_last_line=0.0), clock)
    assert capsys.readouterr().err.splitlines() == [
        "poses: 30 of 100 targets, 1 per second, 70.0 s left",
        "poses: 60 of 100 targets, 1 per second, 40.0 s left",
        "poses: 90 of 100 targets, 1 per second, 10.0 s left",
    ]


def test_bars_inside_one_another_share_the_30_s(clock, capsys):
    with Progress(_last_line=0.0).bar(2, "onboarding", "object") as objects:
        advance_nested_bars(shown := Progress(_last_line=0.0), clock)
        objects(1)
    assert len(capsys.readouterr().err.splitlines()) == 4
    with shown.bar(2, "onboarding", "object") as objects, shown.bar(2, "features", "row") as rows:
        clock.now += 40
        rows(1)
        objects(1)
    assert len(capsys.readouterr().err.splitlines()) == 1


@pytest.mark.parametrize(("shows", "title"), [(False, "poses"), (True, "")])
def test_nothing_is_printed_where_bars_are_off_or_have_no_title(clock, capsys, shows, title):
    advance_nested_bars(Progress(shows, _last_line=0.0), clock, title=title)
    assert capsys.readouterr().err == ""


def test_a_line_says_what_is_left_in_a_readable_unit():
    assert progress_line("poses", "target", 10, 1000, 100.0).endswith("0.1 per second, 2.8 h left")
    assert progress_line("poses", "target", 0, 9, 0.0).endswith("? left")
    assert format_duration(150) == "2.5 min"
