"""Plans estimate what a run takes, and runs stay within their budgets."""

import gc
import json
import re
import subprocess
import sys
import weakref
from pathlib import Path

import psutil
import pytest
import torch
from command import CommandResult, run_dzop
from huggingface_hub.errors import LocalEntryNotFoundError
from make_sd15 import write_folder
from make_vit import write_vit

from pipeline.backbones.batching import Footprint, compute_batch_size
from pipeline.errors import BadInput
from pipeline.graph import Graph, Memory
from pipeline.graph.plan import Node
from pipeline.spec import Runtime
from pipeline.store import LocalStoreConfig, Store
from pipeline.synthetic.scenes import write_dataset

SMALL = ("render.count=6", "render.size=64", "method=dzop", "extract=hog", "match=words", "match.count=8")
QUIET = ("overlays=false", "gallery=0", "runtime.progress=false", "runtime.device=cpu", "step=estimate")


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("budgets") / "scene"
    write_dataset(root, objects=2, images=1, seed=3, size_hw=(120, 160), per_image=2, progress=False)
    return root


@pytest.fixture
def dzop(capsys, monkeypatch, tmp_path, scene):
    monkeypatch.chdir(tmp_path)

    def run(*arguments: str) -> CommandResult:
        dataset = ("dataset=bop", "dataset.name=toy", f"dataset.root={scene}", "evaluate.vsd=false")
        return run_dzop(capsys, monkeypatch, *dataset, *SMALL, *QUIET, *arguments)

    return run


def planned(dzop, monkeypatch: pytest.MonkeyPatch, *arguments: str) -> tuple[list[Node], str]:
    nodes: list[Node] = []
    with monkeypatch.context() as patch:
        patch.setattr("pipeline.run.plan_table", lambda found: nodes.extend(found) or "")
        ran = dzop("plan=true", *arguments)
    assert ran.status == 0, ran.err
    return nodes, ran.out


def test_a_run_writes_the_bytes_and_makes_the_passes_of_its_plan(dzop, monkeypatch):
    nodes, printed = planned(dzop, monkeypatch)
    assert {node.state for node in nodes} == {"missing"}
    made = dzop().counts()[0]
    assert sum(node.passes for node in nodes) == made["template features"][0] + made["query features"][0] == 14
    assert "passes  14 images through the backbone" in printed
    store = Store(LocalStoreConfig(root="cache"))
    fits = [node for node in nodes if node.step == "fits"]
    assert len(fits) == 4
    for node in nodes:
        written = store.size(node.ref)
        assert written is not None
        if node in fits:
            assert 0 < written <= node.nbytes
        elif node.sized:
            assert written == node.nbytes
    features = [node for node in nodes if "features" in node.step and node.nbytes > 500_000]
    assert features
    for node in features:  # checksums and metadata beside the values
        assert store.stored_bytes(node.ref.path) == pytest.approx(node.nbytes, rel=0.01)


def test_time_is_estimated_only_from_timings_of_the_same_work(dzop, monkeypatch):
    assert "time    unknown for templates, template crops" in planned(dzop, monkeypatch)[1]
    dzop("select.objects=[1]")
    nodes, printed = planned(dzop, monkeypatch, "select.objects=[2]")
    seconds = [node.seconds for node in nodes if node.step in ("templates", "template features", "fits", "poses")]
    assert all(s is not None for s in seconds)
    assert sum(seconds) > 0
    assert re.search(r"time +\d+\.\d s \(templates \d+\.\d s, template crops .*poses \d+\.\d s\)", printed)
    assert "unknown for poses:" in planned(dzop, monkeypatch, "cluster.count=3")[1]
    assert "unknown for templates, " in planned(dzop, monkeypatch, "render.size=80")[1]
    (timings,) = Path("cache/.rates").glob("*.json")
    timings.write_text(json.dumps([1, 2]))
    assert "unknown for templates, " in planned(dzop, monkeypatch, "select.objects=[2]")[1]


@pytest.mark.parametrize("size", ["8 gigs", "0GiB", "-1GB", "8", "GiB", "8iB", "[8]", "nan"])
@pytest.mark.parametrize("field", ["max_memory", "max_vram"])
def test_an_invalid_size_is_refused_in_one_line(dzop, field, size):
    ran = dzop(f"runtime.{field}={size}", "step=detect")
    assert ran.status == 1
    assert ran.err.strip().startswith(f"error: runtime.{field}: found ")
    assert ran.err.strip().endswith("needs a size with a unit, such as 8GiB or 500MB, or null")
    assert len(ran.err.strip().splitlines()) == 1


def test_sizes_are_read_with_their_units():
    asked = {"8GiB": 8 << 30, "500MB": 500_000_000, "1.5 gib": 3 << 29, "12B": 12, None: None}
    for text, size in asked.items():
        assert Runtime(max_memory=text).memory_bytes == Runtime(max_vram=text).vram_bytes == size


def test_a_run_that_exceeds_its_budget_is_refused_before_it_computes_anything(dzop):
    ran = dzop("runtime.max_memory=50MB")
    assert ran.status == 1
    (line,) = ran.err.strip().splitlines()
    assert line.startswith("error: runtime.max_memory: found 50MB, needs ")
    assert "the process" in line
    assert "what would help: " in line
    assert not list(Path("cache").glob("*/*/zarr.json"))
    bank = Memory({"the process": 10, "weights": 0}, {"one object's templates": 100, "a batch of 1": 20})
    with pytest.raises(BadInput, match=r"a coarser match\.layer or fewer templates"):
        bank.check(100, "runtime.max_memory", "100B")
    bank.check(200, "runtime.max_memory", "200B")


def test_the_batch_size_follows_the_budget(monkeypatch):
    cpu, footprint = (
        torch.device("cpu"),
        Footprint(weight_bytes=0, bytes_per_pass=5 << 20, bytes_per_crop=10 << 20, max_batch=16, cpu_pass=2),
    )
    taken = psutil.Process().memory_info().rss
    sizes = []
    monkeypatch.setattr("pipeline.backbones.batching.worker_count", lambda: 4)
    for room in (0, 60 << 20, 1 << 40):
        budget = int((taken + room) / 0.9)  # a tenth stays free
        sizes.append(compute_batch_size(footprint, Runtime(max_memory=f"{budget // 1000}kB"), cpu))
    assert sizes[0] == 2 < sizes[1] == 4 < sizes[2] == 8  # whole passes of 2, at most one for each thread
    assert compute_batch_size(footprint, Runtime(), cpu, ahead=1 << 50) == 2
    assert [compute_batch_size(footprint, Runtime(batch=n), cpu) for n in (1, 2, 5)] == [2, 2, 6]


PEAK = """
import sys
import psutil, pipeline.__main__ as command, pipeline.run, pipeline.configuration, pipeline.stages.extract.hog
from benchmarks.measure import peak_bytes
room, *arguments = sys.argv[1:]
budget = psutil.Process().memory_info().rss + int(room)
sys.argv = ["dzop", *arguments, f"runtime.max_memory={budget // 1000}kB"]
command.main()
print("budget", budget, "peak", peak_bytes())
"""


def test_a_run_stays_below_its_budget(tmp_path, scene):
    arguments = ("dataset=bop", "dataset.name=toy", f"dataset.root={scene}", *SMALL[2:4], *QUIET, "threads=1")
    more = (
        "render.count=32",
        "render.size=64",
        "match.layer=11",
        "select.objects=[1]",
    )  # without a budget a batch of 32 takes 360 MB
    command = [sys.executable, "-c", PEAK, "150000000", *arguments, *more]
    ran = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300, check=False)
    assert ran.returncode == 0, ran.stderr
    sizes = re.search(r"budget (\d+) peak (\d+)", ran.stdout)
    assert sizes, ran.stdout
    assert int(sizes[2]) <= int(sizes[1])


def test_only_one_objects_templates_are_in_memory(dzop, monkeypatch):
    graphs: list[Graph] = []

    class Seen(Graph):
        def __init__(self, run):
            super().__init__(run)
            graphs.append(self)

    monkeypatch.setattr("pipeline.run.Graph", Seen)
    dzop()
    bank = graphs[-1].templates.bank(1)
    first = weakref.ref(bank.features)
    del bank
    assert first() is not None
    assert len(graphs[-1].templates.bank(2).features) == 6
    gc.collect()
    assert first() is None


@pytest.mark.parametrize("method", ["dzop_sd", "dzop_x"])
def test_a_plan_downloads_no_weights_and_names_the_missing_ones(dzop, monkeypatch, method):
    asked: list[bool] = []

    def snapshot(*args, local_files_only: bool = False, **kwargs):
        asked.append(local_files_only)
        raise LocalEntryNotFoundError("not here")

    monkeypatch.setattr("huggingface_hub.snapshot_download", snapshot)
    ran = dzop("plan=true", f"method={method}", "extract=stable_diffusion", "weights.stable_diffusion=some/model")
    assert ran.status == 0, ran.err
    assert asked
    assert all(asked)
    assert "template crops: object 2" in ran.out
    last = ran.out.strip().splitlines()[-1]
    assert "extract.weights: found 'some/model'" in last
    assert "its revision is not known offline" in last
    assert dzop(f"method={method}", "extract=stable_diffusion", "weights.stable_diffusion=some/model").status == 1
    assert not asked[-1]


_PASSES = """
import sys
import numpy as np
import psutil
import torch
from benchmarks.measure import peak_bytes
from pipeline.backbones.batching import bytes_of_batch
from pipeline.items.views import Crops
from pipeline.parallel import use_threads
from pipeline.spec import Runtime
from pipeline.stages.extract.dino import Dino
from pipeline.stages.extract.stable_diffusion import StableDiffusion
use_threads(2)
name, weights = sys.argv[1:]
spec = {
    "dino": lambda: Dino(weights=weights, input_size=224),
    "stable_diffusion": lambda: StableDiffusion(weights=weights, input_size=256),
}[name]()
layers = [2, 5, 8, 11]
backbone = spec.load(Runtime(device="cpu"))
n = backbone.passes.size * 2
rgb = np.random.default_rng(0).integers(0, 256, (n, 128, 128, 3), dtype=np.uint8)
crops = Crops(rgb, np.ones((n, 128, 128), bool), np.tile(np.eye(3), (n, 1, 1)))
before = psutil.Process().memory_info().rss
backbone(crops, layers)
print(peak_bytes() - before, bytes_of_batch(spec.footprint(layers, 128), n, torch.device("cpu")))
"""


@pytest.mark.slow
@pytest.mark.parametrize("name", ["dino", "stable_diffusion"])
def test_two_passes_at_the_same_time_take_no_more_than_the_estimate(name: str, tmp_path: Path) -> None:
    weights = {"dino": write_vit, "stable_diffusion": write_folder}[name](tmp_path / "w")
    command = [sys.executable, "-c", _PASSES, name, str(weights)]
    done = subprocess.run(command, cwd=Path(__file__).parents[1], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    peak, estimate = map(int, done.stdout.split()[-2:])
    assert 0.3 * estimate < peak <= estimate
