"""Meshes that nodes share: the ones their keys were made from, and no more in memory than necessary."""

from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.presets import PAPER
from pipeline.bop.dataset import open_dataset
from pipeline.graph import Context, Graph
from pipeline.io.digests import FileChanged, track_files
from pipeline.spec import Runtime
from pipeline.stages.render.raycast import Raycast
from pipeline.store import MemoryStoreConfig, Store
from pipeline.synthetic.scenes import write_dataset


@pytest.fixture
def context(tmp_path: Path) -> Context:
    write_dataset(tmp_path, objects=2, images=1, seed=3, size_hw=(120, 160), per_image=2, progress=False)
    data, stages = open_dataset(tmp_path, name="toy"), replace(PAPER, render=Raycast(count=4, size=64))
    return Context(stages, data, data.targets, Store(MemoryStoreConfig()), Runtime(device="cpu", progress=False))


def test_a_mesh_that_changes_during_a_run_is_refused(context: Context):
    path = context.dataset.model_path(1)
    with track_files():
        first, content = context.mesh_digest(1), path.read_bytes()
        path.write_bytes(content.replace(b"end_header", b"comment another\nend_header"))
        with pytest.raises(FileChanged, match=r"obj_000001\.ply: found a file that changed during the run"):
            context.model(1)
        path.write_bytes(content)
        assert context.model(1).mesh.digest == first


def test_a_mesh_leaves_memory_once_its_templates_are_made(context: Context):
    graph = Graph(context)
    graph.onboard()
    assert graph.templates.read_views(1).rgb.any()
    assert not context.models.values
