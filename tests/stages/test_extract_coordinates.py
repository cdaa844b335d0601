"""The oracle's features depend on the object point and not on the view."""

import numpy as np
import pytest
import torch

from pipeline.errors import BadInput
from pipeline.functional import camera, rigid
from pipeline.items.views import Crops, Geometry
from pipeline.spec import Runtime, build
from pipeline.stages.extract.coordinates import Coordinates, cell_points

CPU = Runtime(device="cpu")
LAYERS = (2, 5, 8, 11)
K = np.array([[600.0, 0.0, 320.0], [0.0, 600.0, 240.0], [0.0, 0.0, 1.0]])


def plane_view(T_cam_obj: np.ndarray, *, padding_ratio: float = 1.2, size: int = 128) -> Crops:
    """A square plate, 100 mm a side in the object's x and y, its exact depth and its crop."""
    y, x = np.mgrid[:480, :640].astype(float)
    rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(K).T
    normal, origin = T_cam_obj[:3, 2], T_cam_obj[:3, 3]
    depth = (normal @ origin) / (rays @ normal)
    points = rigid.transform(rigid.inverse(T_cam_obj), rays * depth[..., None])
    mask = np.abs(points[..., :2]).max(-1) < 50
    box = camera.mask_bbox(mask)
    A = camera.square_crop(box, size=size, padding_ratio=padding_ratio)
    grid = np.stack(np.meshgrid(np.arange(size), np.arange(size)), -1).reshape(-1, 2).astype(float)
    px = np.rint(camera.apply_homography(np.linalg.inv(A), grid)).astype(int)
    inside = (px >= 0).all(1) & (px < (640, 480)).all(1)
    crop = np.zeros(size * size, bool)
    crop[inside] = mask[px[inside, 1], px[inside, 0]]
    geometry = Geometry([np.where(mask, depth, 0).astype(np.float32)], K[None], T_cam_obj[None])
    return Crops(np.zeros((1, size, size, 3), np.uint8), crop.reshape(1, size, size), A[None], geometry)


def pose(tilt_deg: float, *, distance_mm: float = 500.0) -> np.ndarray:
    a = np.radians(tilt_deg)
    R = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    return rigid.rigid(R, np.array([5.0, -8.0, distance_mm]))


def test_points_are_the_object_points_under_the_cell_centres() -> None:
    T = pose(0)
    crops = plane_view(T)
    for cells in (8, 16, 32, 64):
        points, seen = cell_points(crops, 0, cells=cells)
        px = camera.project(K, rigid.transform(T, points[seen]))
        grid = np.stack(np.meshgrid(np.arange(cells), np.arange(cells)), -1).reshape(-1, 2)[seen]
        centres = camera.cell_to_px(torch.from_numpy(grid).double(), size=128, cells=cells).numpy()
        # float64 throughout; only depth is float32
        np.testing.assert_allclose(px, camera.apply_homography(np.linalg.inv(crops.A_crop_img[0]), centres), atol=1e-8)
        np.testing.assert_allclose(points[seen, 2], 0, atol=1e-4)
        assert seen.sum() > 0.5 * cells * cells


def test_two_views_of_a_point_have_the_same_feature() -> None:
    spec = Coordinates(bandwidth_mm=10.0)
    near, far = plane_view(pose(0)), plane_view(pose(35, distance_mm=800.0), padding_ratio=1.5)
    a, b = (spec.load(CPU)(crops, [11])[11][0].flatten(1).T for crops in (near, far))
    (p, p_seen), (q, q_seen) = (cell_points(crops, 0, cells=64) for crops in (near, far))
    best = (a[p_seen] @ b[q_seen].T).argmax(1).numpy()
    error_mm = np.linalg.norm(p[p_seen] - q[q_seen][best], axis=1)
    # cells of the far view are 2.4 mm wide, foreshortened to 3
    assert np.median(error_mm) < 1.5
    assert error_mm.max() < 4


def test_cosine_is_a_gaussian_of_the_distance() -> None:
    spec = Coordinates(bandwidth_mm=20.0, channels=4096)
    crops = plane_view(pose(0))
    features = spec.load(CPU)(crops, [8])[8][0].flatten(1).T
    points, seen = cell_points(crops, 0, cells=64)
    seen[np.arange(len(seen)) % 7 > 0] = False
    distance = np.linalg.norm(points[seen][:, None] - points[seen][None], axis=-1)
    cosine = (features[seen] @ features[seen].T).numpy()
    # 2048 random frequencies: standard error 1/sqrt(2 x 2048) = 0.016, the largest of some 10^5 pairs 5 of them
    assert np.abs(cosine - np.exp(-(distance**2) / (2 * 20.0**2))).max() < 0.08


def test_foreground_has_unit_length_and_background_is_zero() -> None:
    crops = plane_view(pose(20))
    for layer, features in Coordinates().load(CPU)(crops, LAYERS).items():
        assert tuple(features.shape[1:]) == Coordinates().feature_shape(layer)
        length = features[0].norm(dim=0).flatten()
        _, seen = cell_points(crops, 0, cells=features.shape[-1])
        torch.testing.assert_close(length, torch.from_numpy(seen).float())
        assert 0 < seen.sum() < len(seen)


def test_occluders_and_points_outside_the_image_are_background() -> None:
    crops = plane_view(pose(0))
    crops.mask[0, :64] = False  # hidden by something nearer, whose depth the map may hold
    _, seen = cell_points(crops, 0, cells=64)
    assert not seen.reshape(64, 64)[:32].any()
    shifted = Crops(
        crops.rgb, crops.mask, camera.square_crop((-900.0, 0.0, -800.0, 100.0), size=128, padding_ratio=1.0)[None]
    )
    shifted = Crops(shifted.rgb, shifted.mask, shifted.A_crop_img, crops.geometry)
    assert not cell_points(shifted, 0, cells=64)[1].any()


def test_features_depend_on_the_seed_alone() -> None:
    crops = plane_view(pose(10))
    first, again, other = (Coordinates(seed=s).load(CPU)(crops, [2])[2] for s in (0, 0, 1))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_crops_without_geometry_and_odd_channels_are_refused() -> None:
    crops = plane_view(pose(0))
    with pytest.raises(BadInput, match="extract=coordinates: found crops without geometry"):
        Coordinates().load(CPU)(Crops(crops.rgb, crops.mask, crops.A_crop_img), [2])
    with pytest.raises(BadInput, match=r"extract\.channels"):
        build(Coordinates, {"channels": 7}, where="extract")
    with pytest.raises(BadInput, match="extract layer: found 12"):
        Coordinates().feature_shape(12)
