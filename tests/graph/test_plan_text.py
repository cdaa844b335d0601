"""Text of a plan: its table, and the costs of what is missing."""

from dataclasses import replace

import pytest

from pipeline.graph.plan import Node
from pipeline.graph.plan_text import format_duration, plan_costs, plan_table
from pipeline.store import make_ref

REF = make_ref("templates", {"kind": "templates"}, {})
CACHED = Node("templates", "object 1", REF, "cached", 2_000, "")
MISSING = Node("template features", "object 1 layer 2", REF, "missing", 3_000, "12 images", passes=12, seconds=1.5)


def test_the_table_has_a_line_per_node_and_a_total_per_state():
    lines = plan_table([CACHED, MISSING]).splitlines()
    assert lines[2].endswith("template features: object 1 layer 2  (12 images)")
    assert lines[3:] == ["1 nodes cached, 2.0 kB", "1 nodes missing, 3.0 kB"]


def test_costs_count_only_missing_nodes():
    disk, passes, time = plan_costs([CACHED, MISSING]).splitlines()
    assert disk.startswith("disk    3.0 kB of features, fits and encodings, at most 0 B of templates and crops")
    assert passes == "passes  12 images through the backbone"
    assert time == "time    1.5 s (template features 1.5 s)"


def test_a_step_is_timed_only_if_all_its_nodes_are():
    time = plan_costs([MISSING, replace(MISSING, seconds=None)]).splitlines()[-1]
    assert time.startswith("time    unknown for template features: not measured")


def test_a_cached_plan_costs_nothing():
    assert plan_costs([CACHED]).splitlines()[-1] == "time    nothing to compute"


@pytest.mark.parametrize(("seconds", "text"), [(1.25, "1.2 s"), (150, "2.5 min"), (9000, "2.5 h")])
def test_durations_have_a_readable_unit(seconds, text):
    assert format_duration(seconds) == text
