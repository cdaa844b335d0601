"""Fixtures every test may use. Shapes in annotations are checked while tests run.

Tests on photographs read BOP datasets (``lmo/`` and ``ycbv/``) below the folder that the environment variable
DZOP_TEST_DATA names; without it, below ``../shared/bop_mini`` beside the checkout. Values of other implementations are
read from the folder ``reference`` next to it. Tests whose data are missing are skipped and say so.
"""

import os
import shutil
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
import torch
import typecheck

os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
typecheck.install(["pipeline"])
torch.set_num_threads(int(os.environ.get("DZOP_TEST_THREADS", "2")))

ROOT = Path(__file__).resolve().parents[1]
MEMORY = Path("/dev/shm")
TEST_DATA = Path(os.environ.get("DZOP_TEST_DATA") or ROOT.parent / "shared" / "bop_mini").absolute()


def pytest_configure(config: pytest.Config) -> None:
    """Put temporary folders in memory where there is plenty: disks are slow to remove thousands of small files.

    PYTEST_DEBUG_TEMPROOT or --basetemp choose another place.
    """
    chosen = config.option.basetemp or "PYTEST_DEBUG_TEMPROOT" in os.environ
    if chosen or not os.access(MEMORY, os.W_OK) or psutil.virtual_memory().available < 8 * 2**30:
        return
    if shutil.disk_usage(MEMORY).free > 6 * 2**30:
        os.environ["PYTEST_DEBUG_TEMPROOT"] = str(MEMORY)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put files with slow tests first, then those with many tests: workers that take file by file end together."""
    tests = Counter(item.path for item in items)
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: (item.path not in slow, -tests[item.path], item.path))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print what tests recorded with ``record_property("summary", ...)``."""
    reports = terminalreporter.getreports("passed")
    summaries = [value for report in reports for name, value in report.user_properties if name == "summary"]
    if summaries:
        terminalreporter.section("counted")
        for line in dict.fromkeys(summaries):
            terminalreporter.write_line(line)


def _existing(path: Path) -> Path:
    if not path.exists():
        pytest.skip(f"no test data: found no folder {path}, needs DZOP_TEST_DATA=path/to/bop_mini")
    return path


@pytest.fixture(scope="session")
def bop_mini() -> Path:
    """Real photographs, meshes and ground truth in BOP format: lmo/ and ycbv/."""
    return _existing(TEST_DATA)


@pytest.fixture(scope="session")
def bop_reference() -> Path:
    """bop_toolkit's own values of the pose errors."""
    return _existing(TEST_DATA.parent / "reference" / "bop_metrics")


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A procedural dataset in BOP format: two images of two objects, 320 x 240 px. Tests change only copies of it."""
    from pipeline.synthetic.scenes import write_dataset  # after the checks above are installed

    root = tmp_path_factory.mktemp("toy") / "scene"
    write_dataset(root, objects=2, images=2, seed=3, size_hw=(240, 320), per_image=2, progress=False)
    return root


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A module's feature store, which goes with it: nothing that tests write takes as much room."""
    folder = tmp_path_factory.mktemp("cache")
    yield folder
    shutil.rmtree(folder)


@pytest.fixture(scope="session")
def s3_server():
    """An S3 server on this machine, with credentials in the environment as users have them."""
    pytest.importorskip("s3fs", reason="needs s3fs: pip install --editable '.[s3]'")
    pytest.importorskip("moto.server", reason="needs moto's server: pip install 'moto[server]'")
    from tests.s3_server import S3Server  # imports pipeline, which must come after the hook above

    with S3Server.running() as server:
        yield server


@pytest.fixture
def s3(s3_server):
    """The server with an empty bucket."""
    return s3_server.emptied()
