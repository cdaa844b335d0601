import numpy as np

from pipeline.functional.shading import Mipmap, corner_normals, mip_levels, shade, texel_density, texture_colour
from pipeline.functional.viewpoints import icosphere_mesh

CUBE = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
CUBE_FACES = np.array(
    [
        [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5]],
        [[0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6]],
        [[0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]],
    ]
).reshape(-1, 3)


def test_sphere_is_smooth_and_cube_has_sharp_edges():
    points, faces = icosphere_mesh(2)
    smooth = corner_normals(points, faces, crease_deg=40.0)
    # faces around a vertex are not quite regular: about half a degree
    assert ((smooth * points[faces]).sum(-1) > np.cos(np.radians(1.0))).all()
    normals = corner_normals(CUBE, CUBE_FACES, crease_deg=40.0)
    np.testing.assert_allclose(np.abs(normals).max(axis=-1), 1)


def test_copies_of_a_vertex_on_a_seam_share_its_normal():
    points, faces = icosphere_mesh(1)
    torn = corner_normals(points[faces].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3), crease_deg=40.0)
    np.testing.assert_allclose(
        torn, corner_normals(points, faces, crease_deg=40.0), atol=1e-12
    )  # different order of summation


def test_shading_is_two_sided_and_ignores_vector_lengths():
    albedo = np.full((3, 3), 100.0)
    normal, light = np.array([[0, 0, 2.0], [0, 0, -5], [1, 0, 0]]), np.array([0, 0, -3.0])
    colour = shade(albedo, normal, np.broadcast_to(light, (3, 3)), ambient=0.4, diffuse=0.5)
    np.testing.assert_allclose(colour[:, 0], [90, 90, 40])


def test_fine_stripes_are_grey_from_a_distance():
    stripes = np.zeros((64, 64, 3), np.uint8)
    stripes[:, ::2] = 200
    uv = np.random.default_rng(0).uniform(size=(500, 2))
    near = texture_colour(Mipmap.of(mip_levels(stripes)), uv, np.ones(500))
    far = texture_colour(Mipmap.of(mip_levels(stripes)), uv, np.full(500, 4.0))
    assert near.std() > 50
    np.testing.assert_allclose(far, 100, rtol=1e-6)  # float32


def test_texel_density_counts_texels_per_mm():
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=float)
    square = np.array([[0, 0, 0], [50, 0, 0], [50, 50, 0], [0, 50, 0]], dtype=float)
    density = texel_density(square, np.array([[0, 1, 2], [0, 2, 3], [1, 1, 2]]), uv, (100, 100))
    np.testing.assert_allclose(density, [2, 2, 0])
