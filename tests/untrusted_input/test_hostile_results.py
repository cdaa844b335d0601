"""Untrusted results csv files."""

from pathlib import Path

import pytest
from hostile import fuzz_settings, message_within, outcome
from hypothesis import given
from hypothesis import strategies as st
from tiny_bop import write_tiny_bop

from pipeline.bop.dataset import open_dataset
from pipeline.bop.lint import lint
from pipeline.bop.results import COLUMNS, read_results
from pipeline.scoring import Scorer

POSE = ["1 0 0 0 1 0 0 0 1", "0 0 400"]
CELLS = [
    "0",
    "1",
    "7",
    "-1",
    "1e400",
    "1e308",
    "nan",
    "inf",
    "0.5",
    "1_0",
    "²",
    "9" * 5000,
    "",
    " ",
    "\0",
    '"1"',
    "True",
]
CELLS += [*POSE, "1e200 0 0 0 1 0 0 0 1", "1e308 1e308 1e308", "0 0 1e-320"]


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return open_dataset(write_tiny_bop(tmp_path_factory.mktemp("bop") / "tiny"), name="tiny")


def score(path: Path, data) -> None:
    """Read a csv as `dzop score` and `dzop lint` do."""
    lint(path, data)
    rows = [row for row in read_results(path) if row.scene_id == 7 and row.im_id in (0, 3) and row.obj_id in (1, 2)]
    Scorer(data, data.targets, data.models, vsd_delta_mm=15.0, with_vsd=False).score(rows)


@fuzz_settings(100)
@given(drawn=st.data())
def test_csv_is_scored_or_rejected_in_one_line(tmp_path_factory, data, drawn):
    lines = [",".join(COLUMNS)]
    for _ in range(drawn.draw(st.integers(0, 3))):
        cells = ["7", "0", "1", "0.5", *POSE, "0.1"]
        for _ in range(drawn.draw(st.integers(0, 2))):
            cells[drawn.draw(st.integers(0, 6))] = drawn.draw(st.sampled_from(CELLS) | st.text(max_size=8))
        lines.append(",".join(cells))
    text = drawn.draw(st.sampled_from(["\n", "\r\n", "\r", "\n\n"])).join(lines)
    path = tmp_path_factory.getbasetemp() / "m_tiny-test.csv"
    path.write_bytes(text.encode(drawn.draw(st.sampled_from(["utf-8", "utf-8-sig", "utf-16", "latin-1"])), "replace"))
    outcome(lambda: score(path, data))


HOSTILE = {
    "zero bytes": bytes(1 << 20),
    "one long line": b"1," * (8 << 20),
    "a number of ten million digits": b"7,0,1," + b"9" * 10_000_000 + b",1 0 0 0 1 0 0 0 1,0 0 1,1",
    "an id of ten million digits": b"9" * 10_000_000 + b",0,1,1,1 0 0 0 1 0 0 0 1,0 0 1,1",
    "utf-16": "scene_id,im_id".encode("utf-16"),
    "ten million rotations": b"7,0,1,1," + b"1 " * 5_000_000 + b",0 0 1,1",
}


@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_csv_is_message_within_limits(tmp_path: Path, case: str):
    path = tmp_path / "m_tiny-test.csv"
    path.write_bytes(HOSTILE[case])
    message = message_within(lambda: read_results(path), seconds=8, megabytes=700)
    assert "m_tiny-test.csv" in message
    assert len(message) < 400
