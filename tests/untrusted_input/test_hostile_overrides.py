"""Overrides and yaml files can only build specs; no other code is imported or run."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from command import run_dzop
from hostile import fuzz_settings
from hypothesis import given
from hypothesis import strategies as st
from tiny_bop import write_tiny_bop

ROOT = Path(__file__).resolve().parents[2]
TRAP = "from pathlib import Path\nPath({!r}).touch()\n\nclass Trap:\n    pass\n"


@pytest.fixture(scope="module")
def chosen(tmp_path_factory) -> tuple[str, ...]:
    root = write_tiny_bop(tmp_path_factory.mktemp("bop") / "tiny")
    return "plan=true", "dataset=bop", "dataset.name=tiny", f"dataset.root={root}", "store=memory", "extract=hog"


@pytest.fixture
def trap(tmp_path: Path, monkeypatch) -> Path:
    """A module that writes a file when it is imported."""
    (tmp_path / "trap.py").write_text(TRAP.format(str(tmp_path / "sprung")))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path / "sprung"


@pytest.mark.parametrize(
    "override",
    [
        "match._target_=trap.Trap",
        "+match.x._target_=trap.Trap",
        "+x={_target_:trap.Trap}",
        "dataset._target_=trap.Trap",
        "++store={_target_:trap.Trap}",
        "match={_target_:os.system,command:id}",
        "match._target_=builtins.eval",
        "match._target_=pipeline.../trap.Trap",
    ],
)
def test_override_cannot_import_a_module(capsys, monkeypatch, chosen, trap: Path, override: str):
    ran = run_dzop(capsys, monkeypatch, *chosen, override)
    assert not trap.exists()
    assert "Traceback" not in ran.err
    if not override.startswith("+x"):  # an unused field
        assert ran.status == 1
        assert ran.err.startswith("error: ")


@pytest.mark.parametrize("name", ["pipeline.store.Store", "pipeline.bop.dataset.Dataset", "pipeline.errors.BadInput"])
def test_class_that_is_not_a_spec_is_rejected(capsys, monkeypatch, chosen, name: str):
    ran = run_dzop(capsys, monkeypatch, *chosen, f"match._target_={name}")
    assert f"match._target_: found '{name}', needs a class made with @spec" in ran.err


def test_own_yaml_may_name_an_own_class_but_an_override_may_not(capsys, monkeypatch, chosen, trap: Path):
    folder = trap.parent / "conf" / "match"
    folder.mkdir(parents=True)
    (folder / "mine.yaml").write_text("_target_: trap.Trap\n")
    own = ("--config-dir", str(folder.parent))
    refused = run_dzop(capsys, monkeypatch, *own, *chosen, "match._target_=trap.Trap")
    assert "needs a class of pipeline" in refused.err
    assert not trap.exists()
    named = run_dzop(capsys, monkeypatch, *own, *chosen, "match=mine")
    assert "found 'trap.Trap', needs a class made with @spec" in named.err
    assert trap.exists()


def test_a_yaml_in_a_dataset_or_the_working_folder_is_not_read(capsys, monkeypatch, chosen, trap: Path, tmp_path: Path):
    root = Path(next(o for o in chosen if o.startswith("dataset.root=")).split("=")[1])
    for folder in (root, tmp_path):
        for name in ("config.yaml", "conf/config.yaml", "conf/match/masked_cosine.yaml", ".hydra/config.yaml"):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text("_target_: trap.Trap\nmatch: {_target_: trap.Trap}\n")
    ran = run_dzop(capsys, monkeypatch, *chosen)
    assert ran.status == 0, ran.err
    assert not trap.exists()


@pytest.mark.parametrize(
    "override", ["match=0", "match.layer=[[[", "match.layer=${x}", "=", "a=b", "match.layer='", "~match", "~out"]
)
def test_broken_override_is_reported_in_one_line(capsys, monkeypatch, chosen, tmp_path: Path, override: str):
    monkeypatch.chdir(tmp_path)
    ran = run_dzop(capsys, monkeypatch, *chosen, override)
    assert ran.status == 1
    assert ran.err.startswith("error: ")
    assert len(ran.err.splitlines()) == 1


KEYS = [
    "match.layer",
    "match",
    "extract",
    "render.count",
    "dataset.root",
    "dataset.name",
    "dataset.split",
    "out",
    "step",
]
KEYS += ["detect", "select.objects", "threads", "store", "store.root", "evaluate.theta_max", "fuse.layers", "method"]
KEYS += [
    "+x",
    "++match.layer",
    "~match",
    "dataset",
    "runtime.batch",
    "crop.size",
    "plan",
    "sweep",
    "cluster.count",
    "fallback",
    "second_look",
    "second_look.hypotheses",
]
WORDS = [
    "0",
    "-1",
    "1e400",
    "nan",
    "null",
    "[]",
    "{}",
    "[[[[",
    "'",
    "${match}",
    "${oc.env:HOME}",
    "${x",
    "a: b",
    "true",
    "",
]
WORDS += [
    "hog",
    "../../etc",
    "/dev/null",
    "\u00e9",
    "[1,2",
    "{a:1}",
    "9" * 30,
    "a=b",
    "x" * 300,
    "${oc.decode:'1+1'}",
    "range(3)",
]


@fuzz_settings(5)
@given(
    overrides=st.lists(
        st.tuples(st.sampled_from(KEYS), st.sampled_from(WORDS) | st.text(max_size=6)).map("=".join),
        min_size=1,
        max_size=2,
    )
)
def test_override_is_accepted_or_rejected_in_one_line(chosen, overrides, tmp_path_factory):
    folder = tmp_path_factory.getbasetemp() / "overrides"
    folder.mkdir(exist_ok=True)
    overrides = [o for o in overrides if "\0" not in o and o.isprintable()]  # what a shell can pass
    capture = pytest.MonkeyPatch()
    capture.chdir(folder)
    try:
        status = _run_main(capture, [*chosen, *overrides, "plan=true", "out=results"])
    finally:
        capture.undo()
    assert status is None or isinstance(status, int) or status.startswith("error: "), status
    assert not isinstance(status, str) or "\n" not in status


def _run_main(patch: pytest.MonkeyPatch, arguments: list[str]) -> object:
    from pipeline.__main__ import main

    patch.setattr(sys, "argv", ["dzop", *arguments])
    patch.setenv("HYDRA_FULL_ERROR", "1")
    try:
        main()
    except SystemExit as stop:
        return stop.code
    return None


WATCHED = """
import socket, sys
seen = []
def hook(event, arguments):
    if event in ("socket.bind", "socket.connect", "socket.getaddrinfo", "os.system", "pickle.find_class"):
        seen.append((event, str(arguments[-1])[:80]))
sys.addaudithook(hook)
import psutil
from pipeline.__main__ import main
try:
    main()
finally:
    ports = [c for c in psutil.Process().net_connections("inet")]
    print("SEEN", seen, ports)
"""


def test_run_opens_no_port_makes_no_connection_and_unpickles_nothing(tmp_path: Path, chosen):
    arguments = ["render.count=8", "render.viewpoints=fibonacci", "render.size=64", "evaluate.vsd=false", "gallery=0"]
    arguments += [*chosen[1:], "threads=1", f"out={tmp_path / 'results'}"]
    done = subprocess.run(
        [sys.executable, "-c", WATCHED, *arguments],
        cwd=tmp_path, capture_output=True, text=True, timeout=300,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    assert "SEEN [] []" in done.stdout
    assert list(tmp_path.glob("results/*/*/poses.json"))
