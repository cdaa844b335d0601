"""What every node needs."""

from pathlib import Path
from typing import cast

import pytest

from pipeline.bop.dataset import open_dataset
from pipeline.errors import BadInput
from pipeline.graph import Context
from pipeline.route import Stages
from pipeline.spec import Runtime
from pipeline.store import MemoryStoreConfig, Store
from pipeline.synthetic.scenes import write_dataset


def test_a_mesh_that_is_written_while_a_run_goes_on_is_never_taken_for_the_one_of_its_key(tmp_path: Path):
    write_dataset(tmp_path, objects=1, images=1, seed=3, size_hw=(120, 160), per_image=1, progress=False)
    data, stages = open_dataset(tmp_path, name="toy"), cast(Stages, None)
    run = Context(stages, data, data.targets, Store(MemoryStoreConfig()), Runtime(device="cpu"))
    first = run.mesh_digest(1)
    path = data.model_path(1)
    content = path.read_bytes()
    path.write_bytes(content.replace(b"end_header", b"comment another\nend_header"))
    with pytest.raises(BadInput, match="other bytes than when its key was made"):
        run.model(1)
    path.write_bytes(content)
    assert run.model(1).mesh.digest == first
