"""Own meshes: symmetries are found, and of a pose's copies always the same one is given."""

import numpy as np
import trimesh
from graph.test_keys import photo, write_dataset
from scipy.spatial.transform import Rotation

from pipeline.functional.rigid import rigid, rotation_angle_deg
from pipeline.io.meshes import write_ply
from pipeline.items.objects import Mesh


def test_symmetric_copies_of_an_own_object_have_one_pose(tmp_path):
    root = write_dataset(tmp_path / "data")
    can = trimesh.creation.cylinder(15, 50).subdivide().subdivide()
    write_ply(tmp_path / "can.ply", Mesh(can.vertices, can.faces))
    run = photo(root, mesh=str(tmp_path / "can.ply"), scale=1.0)
    poses = run.graph()[0].poses
    T = rigid(Rotation.from_euler("xyz", [70, 20, 10], degrees=True).as_matrix(), np.array([5.0, 2, 400]))
    about_axis = rigid(Rotation.from_euler("z", 117, degrees=True).as_matrix(), np.zeros(3))
    upside_down = rigid(np.diag([1.0, -1, -1]), np.zeros(3))
    once = poses._canonical(T, 1)
    for copy in (about_axis, upside_down, about_axis @ upside_down):
        again = poses._canonical(T @ copy, 1)
        assert rotation_angle_deg(again[:3, :3], once[:3, :3]) < 3
        assert np.linalg.norm(again[:3, 3] - once[:3, 3]) < 1.5
    assert len(poses.templates.extents.read(1).symmetries) == 2 * 315


def test_poses_of_a_dataset_stay_as_they_were_estimated(tmp_path):
    from graph.test_keys import bop, stages_of

    root = write_dataset(tmp_path / "data")
    poses = bop(root, stages_of("masks", root)).graph()[0].poses
    T = rigid(np.diag([1.0, -1, -1]), np.array([0.0, 0, 400]))
    assert poses._canonical(T, 1) is T
