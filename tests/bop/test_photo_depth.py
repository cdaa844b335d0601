"""dataset.depth: the depth image of an own photograph."""

import json
from dataclasses import replace

import numpy as np
import PIL.Image
import pytest
from graph.test_keys import SCENE, K, photo, write_dataset

from pipeline.bop.photo import PhotoConfig
from pipeline.errors import BadInput


def config(root, **given) -> PhotoConfig:
    scene = root / SCENE
    return PhotoConfig(mesh=str(root / "models" / "obj_000001.ply"), image=str(scene / "rgb" / "000000.png"),
                       mask=str(scene / "mask_visib" / "000000_000000.png"), K=K, **given)  # fmt: skip


def test_depth_of_another_size_or_with_distortion_is_refused(tmp_path):
    root = write_dataset(tmp_path / "data")
    small = tmp_path / "small.png"
    PIL.Image.fromarray(np.zeros((24, 32), np.uint16)).save(small)
    with pytest.raises(BadInput, match=r"small.png: found 32 x 24 pixels, needs those of the photograph, 64 x 48"):
        config(root, depth=str(small)).open()
    with pytest.raises(BadInput, match=r"dataset.depth: found with dataset.distortion"):
        config(root, depth=str(root / SCENE / "depth" / "000000.png"), distortion=(-0.05, 0.0, 0.0, 0.0)).open()
    matrix = [[K[0], 0, K[2]], [0, K[1], K[3]], [0, 0, 1]]
    (tmp_path / "camera.json").write_text(json.dumps({"camera_matrix": matrix, "dist_coeffs": [-0.05, 0, 0, 0]}))
    given = config(root, depth=str(root / SCENE / "depth" / "000000.png"))
    with pytest.raises(BadInput, match=r"dataset.depth: found with a camera file that has distortion"):
        replace(given, K=str(tmp_path / "camera.json")).open()


def test_depth_is_read_in_millimetres_and_used_where_it_is_given(tmp_path):
    root = write_dataset(tmp_path / "data")
    path = root / SCENE / "depth" / "000000.png"
    stored = np.asarray(PIL.Image.open(path))
    data = config(root, depth=str(path), depth_scale=0.5).open()
    np.testing.assert_allclose(data.depth_mm(0, 0), 0.5 * stored)
    assert photo(root, depth=str(path)).graph()[0].poses._uses_depth
    assert not photo(root).graph()[0].poses._uses_depth
    assert "depth" in json.dumps(photo(root, depth=str(path)).graph()[0].context.stages.depth.recipe())
