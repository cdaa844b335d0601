"""Simplified meshes: how far the surface moves, what it shows, and keys."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from mesh_files import area

from benchmarks.meshes import make_scan, pattern, write_scan
from pipeline.functional.surface import spread_points, surface_distance
from pipeline.io.meshes import bake, prepare_mesh, prepared_digest, read_mesh, simplify, write_ply
from pipeline.io.meshes.simplify import simplify_mesh
from pipeline.items.objects import Mesh
from pipeline.stages.render.raycast import Raycast

TRIANGLE = np.array([[0, 0, 0], [4, 0, 0], [0, 3, 0]], float)


@pytest.fixture(autouse=True)
def _few_samples(monkeypatch):
    monkeypatch.setattr(bake, "_SAMPLES", 60_000)
    monkeypatch.setattr(bake, "_TEXELS", 60_000)
    monkeypatch.setattr(simplify, "_MEASURED", 4000)


@pytest.mark.parametrize(
    ("point", "distance"),
    [
        ((1, 1, 2), 2),  # above the inside
        ((2, -3, 4), 5),  # beside a side
        ((-3, -4, 0), 5),  # beyond a corner
        ((4, 3, 0), 2.4),  # beyond the longest side: the height of a triangle of sides 3, 4, 5
        ((1, 1, 0), 0),
    ],
)
def test_distance_to_a_triangle(point, distance):
    faces = np.array([[0, 1, 2]])
    found = surface_distance(np.array([point], float), TRIANGLE, faces, spread_points(TRIANGLE, faces, 16))
    assert found == pytest.approx(distance)


def test_points_are_spread_by_area():
    vertices = np.concatenate([TRIANGLE, 2 * TRIANGLE + 10])
    points = spread_points(vertices, np.array([[0, 1, 2], [3, 4, 5]]), 1000)
    assert np.bincount(points.face).tolist() == [200, 800]
    assert points.weight.min() >= 0
    np.testing.assert_allclose(points.weight.sum(axis=1), 1)


def test_distance_of_a_ball_is_that_of_its_radius():
    ball = trimesh.creation.icosphere(4, radius=50)
    smaller = trimesh.creation.icosphere(4, radius=48)
    mesh, other = (Mesh(np.array(m.vertices), np.array(m.faces)) for m in (ball, smaller))
    assert simplify._measure_distance(mesh, other) == pytest.approx(2, abs=0.15)


@pytest.mark.parametrize("suffix", [".ply", ".glb", ".obj"])
def test_a_simplified_scan_looks_like_the_scan(suffix, tmp_path):
    path = write_scan(tmp_path, 14_000, suffix)
    before, (after, facts) = read_mesh(path), prepare_mesh(path, simplify=3000)
    assert len(after.faces) <= 3000 < len(before.faces)
    assert after.texture is not None
    assert_alike(before, after, colour=6)
    assert area(after) == pytest.approx(area(before), rel=0.06)  # its finest bumps are smaller than the faces
    (note,) = facts.warnings
    assert f"simplified from {len(before.faces)} to {len(after.faces)} faces (dataset.simplify=3000)" in note
    assert f"its {'texture' if suffix == '.obj' else 'colours'} became a texture of 4096 x " in note
    assert facts.diameter_mm == prepare_mesh(path)[1].diameter_mm


def test_colours_of_flat_surfaces_survive():
    """Without care all their vertices would go, and the picture with them."""
    x, y = np.meshgrid(np.linspace(0, 100, 81), np.linspace(0, 100, 81))
    front = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=-1)
    corner = (np.arange(80)[:, None] * 81 + np.arange(80)).reshape(-1)
    faces = np.stack([corner, corner + 1, corner + 82, corner, corner + 82, corner + 81], axis=-1).reshape(-1, 3)
    picture = pattern(front[:, :2] / 100)
    # two sides of a thin plate, so that the nearest point may be on the other one
    plate = Mesh(
        np.concatenate([front, front - np.array([0, 0, 0.2])]),
        np.concatenate([faces, faces[:, ::-1] + len(front)]),
        colours=np.concatenate([picture, 255 - picture]),
    )
    after, note = simplify_mesh(plate, 1500, 140.0)
    assert len(after.faces) <= 1500
    assert_alike(plate, after, colour=8)
    assert "which moves its surface by up to" in note


def test_colours_of_a_few_faces_are_those_of_the_nearest_surface():
    """Far from the samples a thinned set of them is searched; near them, all."""
    ball = trimesh.creation.icosphere(4, 50.0)
    side = (ball.vertices[:, 0] > 0).astype(np.uint8) * np.uint8(200)
    colours = np.stack([side, 200 - side, side * 0], axis=-1)
    look = bake._Colours(Mesh(ball.vertices, ball.faces, colours=colours))
    normals = np.random.default_rng(0).normal(size=(500, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals[np.abs(normals[:, 0]) > 0.15]  # the colours blend along the seam
    for radius in (20.0, 45.0, 50.0, 70.0):
        found = look(radius * normals, normals)
        assert ((found[:, 0] > found[:, 1]) == (normals[:, 0] > 0)).mean() > 0.99
    near = look._join(50.0 * normals, normals)
    assert np.array_equal(look(50.0 * normals, normals), look._colours[look._tree.query(near)[1]])


def test_seams_do_not_open():
    """Copies of a vertex, on seams or between facets as in stl files, are one vertex when edges collapse."""
    ball = trimesh.creation.icosphere(4, radius=50)
    soup = Mesh(np.array(ball.vertices[ball.faces.reshape(-1)]), np.arange(ball.faces.size).reshape(-1, 3))
    after, _ = simplify_mesh(soup, 1000, 100.0)
    assert after.texture is None
    assert trimesh.Trimesh(after.vertices, after.faces, process=False).is_watertight
    assert area(after) == pytest.approx(area(soup), rel=0.02)


def test_digest_says_whether_a_mesh_was_simplified(tmp_path):
    path = tmp_path / "scan.ply"
    scan = make_scan(20)
    write_ply(path, replace(scan, uv=None, colours=None))
    chosen = [{}, {"simplify": 400}, {"simplify": 500}, {"simplify": 400, "scale": 2.0}, {"scale": 2.0}]
    digests = [prepared_digest(path, **options) for options in chosen]
    assert len(set(digests)) == len(digests)
    assert digests == [prepare_mesh(path, **options)[0].digest for options in chosen]
    assert prepared_digest(path, simplify=len(scan.faces)) == digests[0]


def assert_alike(before: Mesh, after: Mesh, *, colour: float) -> None:
    """Rendered views agree, but for the outline, in depth and colour."""
    renderer = Raycast(count=4, size=96, supersample=2)
    K, T_cam_obj, size_hw = renderer.cameras(before)
    (rgb, depth), (other_rgb, other_depth) = (renderer.render(m, K, T_cam_obj, size_hw) for m in (before, after))
    both = (depth > 0) & (other_depth > 0)
    assert both.sum() > 0.98 * (depth > 0).sum()
    assert np.abs(rgb[both].astype(int) - other_rgb[both]).mean() < colour
    assert np.median(np.abs(depth - other_depth)[both]) < 0.5  # of 200 mm


def test_scores_use_the_mesh_as_it_is(tmp_path: Path):
    from tiny_bop import write_tiny_bop

    from pipeline.bop.dataset import DatasetConfig

    root = write_tiny_bop(tmp_path / "tiny")
    data = DatasetConfig(name="tiny", root=str(root), simplify=8).open()
    assert len(data.object_model(1).mesh.faces) <= 8
    assert len(data.object_model(1, folder="models").mesh.faces) == 12
    assert data.mesh_digest(1) == data.object_model(1).mesh.digest
