import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from pipeline.bop.symmetries import info_record, mesh_symmetries, transforms_of
from pipeline.functional.rigid import rigid, rotation_angle_deg
from pipeline.functional.symmetry import NO_SYMMETRIES, Symmetries, make_canonical
from pipeline.items.objects import Mesh
from pipeline.synthetic.objects import make_object
from pipeline.synthetic.parts import merge, random_rotation, revolve, tube

shapes = trimesh.creation


def turned(mesh: trimesh.Trimesh) -> Mesh:
    """The mesh in a random rotation, away from the origin."""
    rng = np.random.default_rng(3)
    return Mesh(mesh.vertices @ random_rotation(rng).T + rng.normal(0, 20, 3), mesh.faces)


def handled(handles: int) -> Mesh:
    bow = np.linspace(0.15, np.pi - 0.15, 40)
    path = np.stack([0.5 + 0.4 * np.sin(bow), 0 * bow, 0.4 * np.cos(bow)], -1)
    body = revolve(np.full((40, 64), 0.6), np.linspace(-0.8, 0.8, 40))
    vertices, faces = merge([body, *(tube(path * [side, 1, 1], 0.08) for side in (1, -1)[:handles])])
    return Mesh(50 * vertices, faces)


def can(paint) -> Mesh:
    mesh = shapes.cylinder(30, 100).subdivide().subdivide().subdivide()
    red = paint(*mesh.vertices.T)
    return Mesh(mesh.vertices, mesh.faces, np.where(red[:, None], [200, 30, 30], [240, 240, 240]).astype(np.uint8))


KNOWN = {
    "box": (turned(shapes.box((80, 50, 30))), 3, 0),
    "square box": (turned(shapes.box((80, 50, 50))), 7, 0),
    "triangular prism": (turned(shapes.cylinder(40, 60, sections=3)), 5, 0),
    "cylinder": (turned(shapes.cylinder(30, 100)), 1, 1),
    "cone": (turned(shapes.cone(30, 100)), 0, 1),
    "ball": (turned(shapes.icosphere(subdivisions=3, radius=40)), 0, 3),
    "mug": (handled(1), 1, 0),
    "pot with two handles": (handled(2), 3, 0),
    "procedural object": (make_object(777_000), 0, 0),
}


@pytest.mark.parametrize("name", KNOWN)
def test_symmetries_of_known_shapes(name: str):
    mesh, discrete, continuous = KNOWN[name]
    geometric, visible = mesh_symmetries(mesh)
    assert (len(geometric.discrete), len(geometric.axes)) == (discrete, continuous), geometric.text
    assert visible.text == geometric.text


@pytest.mark.parametrize(
    ("paint", "left"),
    [
        (lambda x, y, z: np.arctan2(y, x) > 0, "none"),
        (lambda x, y, z: z > 0, "any angle about (0 0 1)"),
        (lambda x, y, z: np.sin(2 * np.arctan2(y, x)) > 0, "3 or more"),
    ],
    ids=["label", "lid", "checks"],
)
def test_colours_break_symmetries_of_the_shape(paint, left: str):
    geometric, visible = mesh_symmetries(can(paint))
    assert (len(geometric.discrete), len(geometric.axes)) == (1, 1)
    if left == "3 or more":
        assert len(visible.discrete) in (1, 3)
        assert not len(visible.axes)
    else:
        assert visible.text.replace("-", "") == left


def test_symmetries_of_the_samples_objects(bop_mini):
    import json

    from pipeline.io.meshes import prepare_mesh

    for data in ("lmo", "ycbv"):
        info = json.loads((bop_mini / data / "models" / "models_info.json").read_text())
        for obj_id, record in info.items():
            mesh, facts = prepare_mesh(bop_mini / data / "models" / f"obj_{int(obj_id):06d}.ply")
            _, visible = mesh_symmetries(mesh, facts.diameter_mm)
            known = [np.reshape(T, (4, 4)) for T in record.get("symmetries_discrete", [])]
            assert len(visible.discrete) == len(known), (data, obj_id, visible.text)
            for ours, theirs in zip(visible.discrete, known, strict=True):
                assert rotation_angle_deg(ours[:3, :3], theirs[:3, :3]) < 3


def test_record_is_an_entry_of_models_info():
    mesh = can(lambda x, y, z: z > 0)
    record = info_record(mesh, 116.6, mesh_symmetries(mesh)[1])
    (axis,) = record["symmetries_continuous"]
    assert abs(axis["axis"][2]) == pytest.approx(1, abs=1e-3)
    np.testing.assert_allclose(axis["offset"], 0, atol=1.0)
    assert record["size_z"] == pytest.approx(100)
    assert "symmetries_discrete" not in info_record(mesh, 116.6, NO_SYMMETRIES)


def test_copies_have_one_canonical_pose():
    axis = np.array([[0.0, 0, 1]])
    flip = rigid(np.diag([1.0, -1, -1]), np.zeros(3))
    symmetries = transforms_of(Symmetries(flip[None], axis, np.zeros((1, 3))))
    T = rigid(Rotation.from_euler("xyz", [20, 30, 40], degrees=True).as_matrix(), np.array([1.0, 2, 500]))
    once = make_canonical(T, symmetries)
    for copy in symmetries[::37]:
        again = make_canonical(T @ copy, symmetries)
        assert rotation_angle_deg(again[:3, :3], once[:3, :3]) < 1.2  # the discretised axis has steps of 1.14 degrees
        np.testing.assert_allclose(again[:3, 3], T[:3, 3])
