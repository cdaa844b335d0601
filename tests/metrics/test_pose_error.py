import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from pipeline.functional.rigid import nearest_rotation, rigid
from pipeline.metrics.pose_error import (
    add,
    adi,
    hull_vertices,
    mspd,
    mssd,
    rotation_error_deg,
    translation_error_mm,
)

K = np.array([[572.4, 0, 325.3], [0, 573.6, 242.0], [0, 0, 1]])
NONE = np.eye(4)[None]


def pose(seed: int) -> np.ndarray:
    return rigid(Rotation.random(random_state=seed).as_matrix(), np.array([20.0, -30.0, 700.0 + seed]))


def cloud(seed: int, n: int = 40) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(n, 3)) * 40


@pytest.mark.parametrize("seed", range(3))
def test_errors_are_zero_for_the_same_pose(seed: int):
    T, vertices = pose(seed), cloud(seed)
    errors = [mssd(T, T, vertices, NONE), mspd(T, T, K, vertices, NONE), add(T, T, vertices), adi(T, T, vertices)]
    assert errors == [0.0] * 4
    assert rotation_error_deg(T, T) < 1e-5  # sine of two equal float64 rotations is below 1e-7
    assert translation_error_mm(T, T) == 0.0


def test_errors_do_not_depend_on_the_order_of_vertices_and_symmetries():
    T_est, T_gt, vertices = pose(1), pose(2), cloud(0)
    turns = rigid(Rotation.from_rotvec(np.arange(7)[:, None] * 2 * np.pi / 7 * [0, 0, 1]).as_matrix(), np.zeros((7, 3)))
    shuffled = np.random.default_rng(0).permutation(len(vertices))
    # sums in another order differ in the last bits of lengths of some 100 mm
    assert mssd(T_est, T_gt, vertices, turns) == pytest.approx(
        mssd(T_est, T_gt, vertices[shuffled], turns[::-1]), rel=1e-12
    )
    assert mspd(T_est, T_gt, K, vertices, turns) == pytest.approx(
        mspd(T_est, T_gt, K, vertices[shuffled], turns[::-1]), rel=1e-12
    )


def test_distances_are_invariant_to_a_common_rigid_motion():
    T_est, T_gt, vertices, move = pose(1), pose(2), cloud(0), pose(3)
    for error in (add, adi):
        # rounding of coordinates of some 1000 mm
        assert error(move @ T_est, move @ T_gt, vertices) == pytest.approx(error(T_est, T_gt, vertices), rel=1e-10)
    assert rotation_error_deg(move @ T_est, move @ T_gt) == pytest.approx(rotation_error_deg(T_est, T_gt), rel=1e-10)


def test_symmetric_pose_has_no_error():
    T, vertices = pose(4), cloud(1)
    half_turn = rigid(np.diag([-1.0, -1.0, 1.0]), np.array([3.0, 4.0, 0.0]))
    symmetries = np.stack([np.eye(4), half_turn])
    # both sides compute T @ half_turn once
    assert mssd(T @ half_turn, T, vertices, symmetries) < 1e-9
    assert mspd(T @ half_turn, T, K, vertices, symmetries) < 1e-9
    assert mssd(T @ half_turn, T, vertices, NONE) > 10


def test_blocks_of_symmetries_equal_a_plain_loop():
    T_est, T_gt, vertices = pose(1), pose(2), cloud(0, n=60_000)  # 23 symmetries fit into a block
    angles = np.arange(50)[:, None] * 2 * np.pi / 50
    turns = rigid(Rotation.from_rotvec(angles * [1, 0, 0]).as_matrix(), np.ones((50, 3)))
    loop = []
    for S in turns:
        moved = vertices @ (T_gt @ S)[:3, :3].T + (T_gt @ S)[:3, 3]
        loop.append(np.linalg.norm(vertices @ T_est[:3, :3].T + T_est[:3, 3] - moved, axis=1).max())
    assert mssd(T_est, T_gt, vertices, turns) == pytest.approx(min(loop), rel=1e-12)  # same sums in another order


def test_probes_skip_symmetries_without_changing_the_value():
    T_est, T_gt, vertices = pose(1), pose(2), cloud(0, n=500)
    turns = rigid(
        Rotation.from_rotvec(np.arange(315)[:, None] * 2 * np.pi / 315 * [0, 0, 1]).as_matrix(), np.zeros((315, 3))
    )
    everything = mspd(T_est, T_gt, K, vertices, turns)
    for probes in (vertices[:1], vertices[:40], hull_vertices(vertices), vertices):
        assert mspd(T_est, T_gt, K, vertices, turns, probes=probes) == pytest.approx(everything, rel=1e-12)


def test_flat_object_keeps_all_vertices_as_hull():
    flat = cloud(0) * [1, 1, 0]
    assert len(hull_vertices(flat)) == len(flat)
    assert len(hull_vertices(cloud(0, n=500))) < 250


def test_vertex_in_the_camera_plane_has_infinite_error():
    T, vertices = rigid(np.eye(3), np.array([0.0, 0.0, 10.0])), np.array([[1.0, 1.0, -10.0], [0.0, 0.0, 5.0]])
    with np.errstate(divide="ignore", invalid="ignore"):
        assert mspd(T, pose(1), K, vertices, NONE) == np.inf


def test_known_translation_and_rotation():
    T = rigid(np.eye(3), np.array([0.0, 0.0, 500.0]))
    shifted = rigid(np.eye(3), np.array([3.0, 0.0, 504.0]))
    vertices = np.array([[0.0, 0, 0], [10, 0, 0]])
    assert translation_error_mm(shifted, T) == add(shifted, T, vertices) == mssd(shifted, T, vertices, NONE) == 5.0
    turned = rigid(Rotation.from_euler("y", 30, degrees=True).as_matrix(), T[:3, 3])
    assert rotation_error_deg(turned, T) == pytest.approx(30.0, abs=1e-10)  # float64


def test_projection_error_is_in_pixels_of_k():
    T = rigid(np.eye(3), np.array([0.0, 0.0, 500.0]))
    right = rigid(np.eye(3), np.array([5.0, 0.0, 500.0]))
    assert mspd(right, T, K, np.zeros((1, 3)), NONE) == pytest.approx(572.4 * 5 / 500, rel=1e-12)  # float64


def test_published_rotations_give_no_spurious_angle():
    R = np.array(
        [
            [0.87547542, 0.47867615, -0.06858282],
            [0.3746311, -0.76110463, -0.52974822],
            [-0.30574968, 0.43803819, -0.84552592],
        ]
    )
    published = rigid(R, np.zeros(3))  # LM-O, image 3, object 1: orthonormal to 1e-2 only
    # the nearest rotation differs by the skew part of the published error, far less than its arc cosine
    assert rotation_error_deg(rigid(nearest_rotation(R), np.zeros(3)), published) < 0.01


@pytest.mark.timeout(60)
def test_hull_of_finely_divided_caps_is_found_without_merging_their_facets():
    """Qhull merges coplanar facets in quadratic time: minutes for this cylinder."""
    vertices = np.asarray(trimesh.creation.cylinder(radius=30, height=120, sections=20_000).vertices)
    directions = np.random.default_rng(0).normal(size=(100, 3))
    hull = hull_vertices(vertices)
    assert len(hull) <= len(vertices)
    assert np.allclose((hull @ directions.T).max(axis=0), (vertices @ directions.T).max(axis=0), rtol=0, atol=1e-9)
