"""On the CPU, the bytes of every entry depend neither on the batch, nor on threads, nor on the number of processes."""

import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from markupsafe import escape

from pipeline.items.views import Crops, Geometry
from pipeline.machine import describe_machine, machine_text
from pipeline.parallel import one_thread_per_kernel, ordered_map, use_threads, worker_count
from pipeline.report.run_records import read_run_records
from pipeline.spec import Runtime
from pipeline.store import LocalStoreConfig, Store, make_ref
from pipeline.store.admin import list_entries
from tests.command import run_dzop
from tests.same_bytes import contents, poses
from tests.test_pins import toy_crops, variant

ROOT = Path(__file__).parents[1]
QUIET = ("overlays=false", "gallery=0", "runtime.progress=false", "runtime.device=cpu", "evaluate.vsd=false")
METHODS = {
    "dzop": ("method=dzop", "extract=embedded"),
    "dzop_x": ("method=dzop_x", "extract=embedded"),
    "words": ("method=dzop", "extract=embedded", "match=words", "match.count=200", "match.dim=32"),
}
SETTINGS = [("runtime.batch=1", "threads=2"), ("runtime.batch=4", "threads=1"), ("runtime.batch=16", "threads=2")]
COUNT = 19  # crops: whole batches of 4 and 16, and a rest


@pytest.fixture(autouse=True)
def default_threads():
    yield
    use_threads(0)


@pytest.fixture
def results(capsys, monkeypatch, tmp_path) -> Callable[..., dict[str, object]]:
    """Runs the command in a store of its own; every entry's bytes and the results csv."""

    def run(name: str, *arguments: str) -> dict[str, object]:
        folder = tmp_path / name
        places = (f"store.root={folder}/cache", f"out={folder}/out")
        ran = run_dzop(capsys, monkeypatch, *places, *QUIET, *arguments)
        assert ran.status == 0, ran.err
        return contents(Store(LocalStoreConfig(root=f"{folder}/cache"))) | {"csv": poses(folder / "out")}

    return run


def differences(a: dict[str, object], b: dict[str, object]) -> list[str]:
    return sorted(name for name in a.keys() | b.keys() if a.get(name) != b.get(name))


@pytest.mark.parametrize("method", METHODS)
def test_bytes_of_entries_depend_neither_on_batch_nor_on_threads(results, scene, method):
    data = ("dataset=bop", "dataset.name=toy", f"dataset.root={scene}", "render.count=12", "render.size=96")
    first = results("first", *data, *METHODS[method], "runtime.batch=3", "threads=1")
    again = results("again", *data, *METHODS[method], "runtime.batch=16", "threads=2")
    assert differences(first, again) == []


@pytest.mark.faults
@pytest.mark.timeout(7200)
def test_bytes_on_photographs_depend_neither_on_batch_nor_on_threads_nor_on_processes(
    bop_mini, tmp_path, capsys, monkeypatch, record_property
):
    """The methods of one setting share a store: what they have in common is computed and compared once."""
    data = ("dataset=lmo", f"dataset.root={bop_mini}/lmo", "select.images=[3,61,102]", "render.count=24", *QUIET)

    def places(name: str, method: str) -> tuple[str, ...]:
        return (f"store.root={tmp_path}/{name}/cache", f"out={tmp_path}/{name}/{method}")

    def compute(name: str, *setting: str) -> dict[str, object]:
        found: dict[str, object] = {}
        for method, stages in METHODS.items():
            ran = run_dzop(capsys, monkeypatch, *places(name, method), *data, *stages, *setting)
            assert ran.status == 0, ran.err
            found[method] = poses(tmp_path / name / method)
        found |= contents(Store(LocalStoreConfig(root=f"{tmp_path}/{name}/cache")))
        shutil.rmtree(tmp_path / name / "cache")
        return found

    first = compute("first", "threads=1")
    assert [len(first[method].splitlines()) for method in METHODS] == [25, 25, 25]  # with the head
    for n, setting in enumerate(SETTINGS):
        assert differences(first, compute(str(n), *setting)) == []
    for method, stages in METHODS.items():
        command = [sys.executable, "-m", "pipeline", *data, *stages, "step=estimate", *places("shared", method)]
        started = [subprocess.Popen([*command, f"out={tmp_path}/{n}", f"threads={n}"], cwd=ROOT) for n in (1, 2)]
        assert [process.wait(3000) for process in started] == [0, 0]
    assert differences(first, compute("shared")) == []
    text = f"{len(first)} arrays, documents and results files of 24 targets and {len(METHODS)} methods"
    record_property("summary", f"{text}: equal with {', '.join(map(str, SETTINGS))}, and of two processes")


@pytest.mark.parametrize("name", ["hog", "pixels", "coordinates", "random_sd", "embedded", "dino", "dinov2", "fusion"])
def test_features_depend_neither_on_batch_nor_on_threads(name):
    spec, layers = variant(f"extract/{name}"), [2, 11]
    one = toy_crops()
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 256, (COUNT, *one.rgb.shape[1:]), dtype=np.uint8) * one.mask[:, :, :, None]
    views = Geometry(
        one.geometry.depth_mm * COUNT,
        one.geometry.K.repeat(COUNT, axis=0),
        one.geometry.T_cam_obj.repeat(COUNT, axis=0),
    )
    many = Crops(rgb, one.mask.repeat(COUNT, axis=0), one.A_crop_img.repeat(COUNT, axis=0), views)

    def compute(batch: int, threads: int) -> list[bytes]:
        use_threads(threads)
        backbone = spec.load(Runtime(device="cpu", batch=batch))
        size = backbone.passes.batch  # as graph.Context.extract calls it
        maps = [backbone(many[i : i + size], layers) for i in range(0, len(many), size)]
        return [torch.cat([m[layer] for m in maps]).numpy().tobytes() for layer in layers]

    first = compute(1, 1)
    for batch, threads in ((4, 2), (16, 1), (0, 2), (COUNT, 3)):
        assert compute(batch, threads) == first


def test_results_of_parallel_items_come_in_order_and_kernels_run_on_one_thread():
    use_threads(3)
    seen = list(ordered_map(lambda n: (n, torch.get_num_threads(), worker_count()), range(20)))
    assert seen == [(n, 1, 1) for n in range(20)]
    assert worker_count() == 3


def test_the_first_error_of_parallel_items_is_raised():
    def fail(n: int) -> int:
        if n > 4:
            raise ValueError(n)
        return n

    use_threads(2)
    with pytest.raises(ValueError, match="5"):
        list(ordered_map(fail, range(20)))
    assert list(ordered_map(fail, range(4))) == [0, 1, 2, 3]


def test_the_threads_of_libraries_are_restored():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        with one_thread_per_kernel():
            assert torch.get_num_threads() == 1
            with one_thread_per_kernel():
                assert torch.get_num_threads() == 1
            assert torch.get_num_threads() == 1
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize("threads", [2, 3])
def test_sums_over_blocks_do_not_depend_on_threads(threads):
    from pipeline.functional.kmeans import kmeans
    from pipeline.functional.pca import principal_axes_in_blocks, project_onto_axes

    x = torch.from_numpy(np.random.default_rng(0).normal(size=(40_000, 24)).astype(np.float32))

    def compute() -> list[bytes]:
        mean, axes = principal_axes_in_blocks(x, dim=8)
        projected = project_onto_axes(x, mean, axes)
        label, centre = kmeans(projected, count=50, seed=0, iterations=5)
        return [array.numpy().tobytes() for array in (mean, axes, projected, label, centre)]

    use_threads(1)
    serial = compute()
    use_threads(threads)
    assert compute() == serial


def test_entries_record_what_made_them_and_the_report_and_the_command_show_it(
    results, scene, tmp_path, capsys, monkeypatch
):
    small = ("render.count=8", "render.size=64", "method=dzop", "extract=pixels", "threads=1")
    results("run", "dataset=bop", "dataset.name=toy", f"dataset.root={scene}", *small)
    root = f"{tmp_path}/run/cache"
    store = Store(LocalStoreConfig(root=root))
    expected = describe_machine("cpu")
    assert expected["torch"] == torch.__version__
    for entry in list_entries(store):
        assert entry.made_by == expected
    listed = run_dzop(capsys, monkeypatch, "cache", "ls", "--long", "--root", root)
    assert listed.out.count(f"made by {machine_text(expected)}") == len(list_entries(store))
    (record,) = read_run_records(tmp_path / "run" / "out")
    assert record.machines == (machine_text(expected),)
    assert run_dzop(capsys, monkeypatch, "step=report", f"out={tmp_path}/run/out").status == 0
    page = (tmp_path / "run" / "out" / "report" / "index.html").read_text()
    assert f"Computed by {escape(machine_text(expected))}." in page


def test_an_entry_without_this_record_is_still_complete_and_made_by_unknown(tmp_path, capsys, monkeypatch):
    store = Store(LocalStoreConfig(root=f"{tmp_path}/cache"))
    ref = make_ref("poses", {"kind": "poses"}, {})
    store.put_document(ref, {"answers": []}, rows=0)
    assert store.is_complete(ref)
    assert store.maker(ref) == {}
    listed = run_dzop(capsys, monkeypatch, "cache", "ls", "--long", "--root", f"{tmp_path}/cache")
    assert "made by unknown" in listed.out
