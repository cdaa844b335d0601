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
from pipeline.store.leases import live_leases
from tests.command import run_dzop, run_dzop_for_module, toy_arguments
from tests.same_bytes import contents, poses

ROOT = Path(__file__).parents[1]
SMALL_NODE = {"num_cpus": 1, "include_dashboard": False, "object_store_memory": 80_000_000}


def arguments(scene: Path, folder: Path, *overrides: str) -> list[str]:
    return toy_arguments(scene, folder, "render.count=60", *overrides)


@pytest.fixture(scope="module")
def local(scene, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("local")
    assert run_dzop_for_module(*arguments(scene, folder)).status == 0
    return folder


class TwoNodes:
    """A cluster of two nodes on this machine, with one core each."""

    def __init__(self, cluster_type: type) -> None:
        self.cluster = cluster_type(initialize_head=True, head_node_args=SMALL_NODE)
        self.second = self.cluster.add_node(**SMALL_NODE)

    def repair(self) -> None:
        """Replace the second node where a test removed it."""
        if self.second not in self.cluster.list_all_nodes():
            self.second = self.cluster.add_node(**SMALL_NODE)

    def busy_worker(self) -> psutil.Process | None:
        """A worker of the second node that is computing an item."""
        raylet = psutil.Process(self.second.all_processes["raylet"][0].process.pid)
        for process in raylet.children():
            if "ray::Worker.do" in " ".join(process.cmdline()):
                return process
        return None


@pytest.fixture(scope="module")
def started() -> Iterator[TwoNodes]:
    utils = pytest.importorskip("ray.cluster_utils", reason="needs Ray: pip install --editable '.[ray]'")
    nodes = _start(utils.Cluster)
    yield nodes
    nodes.cluster.shutdown()


@pytest.fixture
def nodes(started: TwoNodes) -> TwoNodes:
    started.repair()
    return started


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
    command = [sys.executable, "-m", "pipeline", *arguments(scene, tmp_path, *where)]
    run = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
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
    assert not live_leases(Store(LocalStoreConfig(root=f"{tmp_path}/cache")).backend.zarr)
    (again,) = run_dzop_for_module(*arguments(scene, tmp_path)).counts()
    assert {computed for computed, _ in again.values()} == {0}


def test_without_ray_the_message_says_how_to_install_it(scene, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("pipeline.ray_workers.ray", None)
    ran = run_dzop(capsys, monkeypatch, *arguments(scene, tmp_path, "runtime=ray"))
    assert (ran.status, ran.err) == (
        1,
        "error: runtime: found ray, which is not installed, needs pip install --editable '.[ray]'",
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
    pytest.importorskip("ray", reason="needs Ray: pip install --editable '.[ray]'")
    unwanted = "store.root" if "store=memory" in overrides else "nothing"
    given = [word for word in arguments(scene, tmp_path, "runtime=ray") if unwanted not in word]
    ran = run_dzop(capsys, monkeypatch, *given, *overrides)
    assert ran.status == 1
    assert ran.err.startswith(f"error: {message}")
    assert len(ran.err.splitlines()) == 1


@pytest.mark.parametrize("mode", [0o644, 0o640, 0o666])
def test_rays_token_is_made_private(tmp_path, monkeypatch, mode):
    ray_workers = pytest.importorskip("pipeline.ray_workers", reason="needs Ray: pip install --editable '.[ray]'")
    token = tmp_path / "auth_token"
    token.write_text("secret")
    token.chmod(mode)
    monkeypatch.setenv("RAY_AUTH_TOKEN_PATH", str(token))
    ray_workers.protect_auth_token()
    assert token.stat().st_mode & 0o777 == 0o600
