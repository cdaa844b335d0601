"""What every node needs: meshes that are those of their keys, and no more of them than have to be."""

from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.presets import PAPER
from pipeline.bop.dataset import open_dataset
from pipeline.errors import BadInput
from pipeline.graph import Context, Graph
from pipeline.spec import Runtime
from pipeline.stages.render.raycast import Raycast
from pipeline.store import MemoryStoreConfig, Store
from pipeline.synthetic.scenes import write_dataset


@pytest.fixture
def run(tmp_path: Path) -> Context:
    write_dataset(tmp_path, objects=2, images=1, seed=3, size_hw=(120, 160), per_image=2, progress=False)
    data, stages = open_dataset(tmp_path, name="toy"), replace(PAPER, render=Raycast(count=4, size=64))
    return Context(stages, data, data.targets, Store(MemoryStoreConfig()), Runtime(device="cpu", progress=False))


def test_a_mesh_that_is_written_while_a_run_goes_on_is_never_taken_for_the_one_of_its_key(run: Context):
    path = run.dataset.model_path(1)
    first, content = run.mesh_digest(1), path.read_bytes()
    path.write_bytes(content.replace(b"end_header", b"comment another\nend_header"))
    with pytest.raises(BadInput, match="a file that changed while the run was reading it"):
        run.model(1)
    path.write_bytes(content)
    assert run.model(1).mesh.digest == first


def test_an_objects_mesh_is_let_go_when_its_templates_are_made(run: Context):
    graph = Graph(run)
    graph.onboard()
    assert graph.templates.read_views(1).rgb.any()
    assert not run.models.values
