import numpy as np
import pytest

from pipeline.errors import BadInput
from pipeline.items.views import Crops
from pipeline.spec import Runtime
from pipeline.stages.extract.pixels import Pixels


def crops(rgb: np.ndarray) -> Crops:
    return Crops(rgb, np.ones(rgb.shape[:3], bool), np.repeat(np.eye(3)[None], len(rgb), 0))


def test_a_cell_holds_its_own_colours():
    rgb = np.zeros((1, 128, 128, 3), np.uint8)
    rgb[0, :, 64:, 0] = 255
    maps = Pixels().load(Runtime(device="cpu"))(crops(rgb), (2, 11))
    assert maps[2].shape == (1, 12, 8, 8)
    assert maps[11].shape == (1, 12, 64, 64)
    assert maps[11][0, :4, 5, 40].tolist() == [1.0] * 4  # red in the right half
    assert maps[11][0, :, 5, 10].tolist() == [-1.0] * 12


def test_maps_have_the_shapes_of_feature_shape():
    for side in (1, 2, 3):
        maps = Pixels(side=side).load(Runtime(device="cpu"))(crops(np.zeros((2, 96, 96, 3), np.uint8)), (5,))
        assert maps[5].shape[1:] == Pixels(side=side).feature_shape(5)
    with pytest.raises(BadInput, match="extract layer"):
        Pixels().feature_shape(3)
