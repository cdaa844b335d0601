"""A run on a Ray cluster: the same bytes as in one process, even if workers die; setup errors take one line."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from pipeline.store import LocalStoreConfig, Store
from pipeline.synthetic.scenes import write_dataset
from tests.command import run_dzop
from tests.same_bytes import contents, poses

ROOT = Path(__file__).parents[1]
SMALL = ("method=dzop", "extract=pixels", "render.count=60", "render.size=96", "overlays=false", "gallery=0",
         "threads=1", "runtime.progress=false", "evaluate.vsd=false")  # fmt: skip


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("synthetic") / "scene"
    write_dataset(root, objects=2, images=2, seed=3, size_hw=(240, 320), per_image=2, progress=False)
    return root


def command(scene: Path, folder: Path, *overrides: str) -> list[str]:
    places = ("dataset=bop", "dataset.name=toy", f"dataset.root={scene}", f"store.root={folder}/cache")
    return [sys.executable, "-m", "pipeline", *places, f"out={folder}/results", *SMALL, *overrides]


@pytest.fixture(scope="module")
def local(scene, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("local")
    subprocess.run(command(scene, folder), cwd=ROOT, check=True, capture_output=True, timeout=300)
    return folder


class TwoNodes:
    """A cluster of two nodes on this machine, with one core each."""

    def __init__(self, cluster_type: type) -> None:
        small = {"num_cpus": 1, "include_dashboard": False, "object_store_memory": 80_000_000}
        self.cluster = cluster_type(initialize_head=True, head_node_args=small)
        self.second = self.cluster.add_node(**small)

    def busy_worker(self) -> psutil.Process | None:
        """A worker of the second node that is computing an item."""
        raylet = psutil.Process(self.second.all_processes["raylet"][0].process.pid)
        for process in raylet.children():
            if "ray::Worker.do" in " ".join(process.cmdline()):
                return process
        return None


@pytest.fixture
def nodes() -> Iterator[TwoNodes]:
    utils = pytest.importorskip("ray.cluster_utils", reason="needs Ray: pip install 'dzop[ray]'")
    started = _start(utils.Cluster)
    yield started
    started.cluster.shutdown()


def _start(cluster_type: type) -> TwoNodes:
    """Retry: Ray gives a node 30 s to start, which may be too short on a machine that runs other tests."""
    for _ in range(3):
        try:
            return TwoNodes(cluster_type)
        except Exception as error:
            late = error
    raise late


@pytest.mark.slow
@pytest.mark.parametrize("dies", ["worker", "node"])
def test_two_nodes_that_lose_a_worker_write_the_same_bytes_as_one_process(scene, local, tmp_path, nodes, dies):
    where = ("runtime=ray", f"runtime.address={nodes.cluster.address}", "runtime.actors=2")
    run = subprocess.Popen(
        command(scene, tmp_path, *where), cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    limit = time.monotonic() + 120
    while (worker := nodes.busy_worker()) is None and run.poll() is None and time.monotonic() < limit:
        time.sleep(0.01)
    assert worker is not None, run.communicate()
    time.sleep(0.1)
    if dies == "worker":
        os.kill(worker.pid, signal.SIGKILL)
    else:
        nodes.cluster.remove_node(nodes.second, allow_graceful=False)
    _, stderr = run.communicate(timeout=300)
    assert run.returncode == 0, stderr
    assert "its worker was lost; retrying on another" in stderr
    assert poses(tmp_path / "results") == poses(local / "results")
    ours, theirs = (contents(Store(LocalStoreConfig(root=str(folder / "cache")))) for folder in (tmp_path, local))
    assert set(ours) == set(theirs)
    assert [path for path in ours if ours[path] != theirs[path]] == []
    again = subprocess.run(command(scene, tmp_path), cwd=ROOT, capture_output=True, text=True, timeout=300, check=True)
    assert again.stdout.count("computed") == 1
    assert all(line.split()[-3] == "0" for line in _table(again.stdout)), again.stdout


def _table(printed: str) -> list[str]:
    """Lines of the step table, without its header and total."""
    lines = printed.splitlines()
    first = next(n for n, line in enumerate(lines) if line.startswith("step "))
    return [line for line in lines[first + 1 :] if line and not line.startswith("total ")]


def test_without_ray_the_message_says_how_to_install_it(scene, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("pipeline.ray_workers.ray", None)
    ran = run_dzop(capsys, monkeypatch, *command(scene, tmp_path, "runtime=ray")[3:])
    assert (ran.status, ran.err) == (
        1,
        "error: runtime: found ray, which is not installed, needs pip install 'dzop[ray]'",
    )


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (("store=memory",), "store: found memory with runtime=ray, needs a store that workers share"),
        (("runtime.actors=-1",), "runtime.actors: found -1, needs greater than or equal to 0"),
        (("runtime.cpus_per_actor=0",), "runtime.cpus_per_actor: found 0, needs greater than or equal to 1"),
        (("runtime.address=127.0.0.1:1",), "runtime.address: found 127.0.0.1:1 (["),
        (("runtime.device=tpu",), "runtime.device: found 'tpu', needs auto, cpu, cuda or cuda:N"),
    ],
)
def test_impossible_settings_are_reported_before_a_cluster_is_started(
    scene, tmp_path, capsys, monkeypatch, overrides, message
):
    pytest.importorskip("ray", reason="needs Ray: pip install 'dzop[ray]'")
    unwanted = "store.root" if "store=memory" in overrides else "nothing"
    arguments = [word for word in command(scene, tmp_path, "runtime=ray")[3:] if unwanted not in word]
    ran = run_dzop(capsys, monkeypatch, *arguments, *overrides)
    assert ran.status == 1
    assert ran.err.startswith(f"error: {message}")
    assert len(ran.err.splitlines()) == 1


@pytest.mark.parametrize("mode", [0o644, 0o640, 0o666])
def test_rays_token_is_made_private(tmp_path, monkeypatch, mode):
    ray_workers = pytest.importorskip("pipeline.ray_workers", reason="needs Ray: pip install 'dzop[ray]'")
    token = tmp_path / "auth_token"
    token.write_text("secret")
    token.chmod(mode)
    monkeypatch.setenv("RAY_AUTH_TOKEN_PATH", str(token))
    ray_workers.protect_auth_token()
    assert token.stat().st_mode & 0o777 == 0o600
