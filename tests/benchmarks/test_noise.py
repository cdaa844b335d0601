"""The benchmark of the noise of diffusion features: its truth, and that shared noise shows."""

import numpy as np
import torch

from benchmarks import noise
from pipeline.items.features import CropFeatures
from pipeline.spec import Runtime
from pipeline.stages.extract.coordinates import Coordinates
from pipeline.stages.extract.random_sd import RandomSD


def test_object_coordinates_as_features_match_right():
    crops = noise.render_pairs(seed=700, pairs=1)
    maps = Coordinates().load(Runtime(device="cpu"))(crops, (2, 5, 8, 11))
    seen = crops.geometry
    query, template = (
        noise.Described(
            CropFeatures({k: m[i] for k, m in maps.items()}, torch.from_numpy(crops.mask[i])),
            crops.A_crop_img[i], seen.depth_mm[i], seen.K[i], seen.T_cam_obj[i],
        )
        for i in (0, 1)
    )  # fmt: skip
    turn = np.trace(seen.T_cam_obj[0][:3, :3].T @ seen.T_cam_obj[1][:3, :3])
    np.testing.assert_allclose((turn - 1) / 2, np.cos(np.radians(noise.TURN_DEG)), atol=1e-9)
    right, same = noise.score(query, template)
    assert right > 0.9  # what one view hides has no match in the other
    assert same < 0.5
    right, same = noise.score(query, query)
    assert (right, same > 0.95) == (1.0, True)  # neighbouring cells may have equal features


def test_shared_noise_matches_itself(monkeypatch):
    small = RandomSD(channels=(8, 8, 8, 8), vae_channels=(8, 8, 8), input_size=64, timestep=600)
    monkeypatch.setattr(noise, "BACKBONES", {"small": small})
    monkeypatch.setattr(noise, "NOISES", (("shared", 1), ("none", 1)))
    shared, none = (
        [float(cell) for cell in line.split("|")[3:6]] for line in noise.compare([700, 701], pairs=1).splitlines()[2:]
    )
    assert shared[1] > 2 * none[1]
    assert shared[2] > none[2]
