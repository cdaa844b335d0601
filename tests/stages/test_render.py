import os
import subprocess
import sys
import textwrap
from dataclasses import fields, replace
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
import yaml

from pipeline.errors import BadInput
from pipeline.functional.camera import project, unproject
from pipeline.functional.rigid import inverse, look_at, transform
from pipeline.functional.viewpoints import icosphere_mesh
from pipeline.io.meshes import diameter_mm, read_mesh
from pipeline.items.objects import Mesh
from pipeline.spec import build
from pipeline.stages.render.auto import Auto
from pipeline.stages.render.pyrender import Pyrender
from pipeline.stages.render.ray_mesh import get_caster
from pipeline.stages.render.raycast import Raycast, render_depth, surface_points
from pipeline.synthetic.objects import make_object

VARIANTS = {"raycast": Raycast, "pyrender": Pyrender, "auto": Auto}
CONF = Path(str(files("pipeline"))).parent / "conf" / "render"
both = pytest.mark.parametrize("renderer", [Raycast, pytest.param(Pyrender, marks=pytest.mark.gl)])


def ball(radius_mm: float, centre=(0.0, 0.0, 0.0), level: int = 3) -> Mesh:
    points, faces = icosphere_mesh(level)
    return Mesh(points * radius_mm + np.array(centre), faces)


def quad(z_mm: float, half_mm: float = 100.0, **skin) -> Mesh:
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * half_mm + [0, 0, z_mm]
    return Mesh(corners.astype(float), np.array([[0, 1, 2], [0, 2, 3]]), **skin)


@pytest.mark.parametrize("name", VARIANTS)
def test_yaml_lists_the_defaults_of_its_class(name):
    values = yaml.safe_load((CONF / f"{name}.yaml").read_text())
    assert values.pop("_target_") == f"pipeline.stages.render.{name}.{VARIANTS[name].__name__}"
    assert list(values) == [f.name for f in fields(VARIANTS[name])]
    assert build(VARIANTS[name], values, where="render") == VARIANTS[name]()
    assert VARIANTS[name].kind == f"render.{name}"


@both
def test_a_scaled_object_gives_equal_images_and_scaled_depth(renderer):
    mesh = make_object(1)
    spec = renderer(size=64, count=3)
    K, T, hw = spec.cameras(mesh)
    rgb, depth = spec.render(mesh, K, T, hw)
    large = replace(mesh, vertices=mesh.vertices * 10)
    K_large, T_large, _ = spec.cameras(large)
    rgb_large, depth_large = spec.render(large, K_large, T_large, hw)
    np.testing.assert_allclose(K, K_large)
    np.testing.assert_allclose(depth * 10, depth_large, rtol=1e-5)  # float32
    assert (rgb != rgb_large).any(-1).mean() < 1e-3  # a rounding apart at most


@both
@pytest.mark.parametrize("viewpoints", ["icosphere_upper", "icosphere", "fibonacci", "superfibonacci"])
def test_an_object_away_from_its_origin_is_inside_every_template(renderer, viewpoints):
    mesh = make_object(2)
    away = replace(mesh, vertices=mesh.vertices + np.array([500.0, -300.0, 80.0]))
    few = renderer(size=48, count=8, viewpoints=viewpoints, supersample=1)
    K, T, hw = few.cameras(away)
    px = project(K, np.stack([transform(pose, away.vertices) for pose in T]))
    assert px.min() > -0.5
    assert px.max() < 47.5
    _, depth = few.render(away, K, T[::40], hw)
    border = depth.copy()
    border[:, 1:-1, 1:-1] = 0
    assert not border.any()
    assert ((depth > 0).sum((1, 2)) > 48).all()


@both
def test_views_do_not_depend_on_each_other(renderer):
    mesh = make_object(4)
    spec = renderer(size=48, count=5)
    K, T, hw = spec.cameras(mesh)
    rgb, depth = spec.render(mesh, K, T, hw)
    again_rgb, again_depth = spec.render(mesh, K, T[[3, 1]], hw)
    np.testing.assert_array_equal(rgb[[3, 1]], again_rgb)
    np.testing.assert_array_equal(depth[[3, 1]], again_depth)


@both
def test_a_ball_has_the_depth_of_a_ball(renderer):
    radius = 50.0
    spec = renderer(size=101, count=1, distance=4.0, fill=0.8)
    mesh = ball(radius, centre=(7, 8, 9), level=4)
    K, T, hw = spec.cameras(mesh)
    _, depth = spec.render(mesh, K, T, hw)
    assert depth[0, 50, 50] == pytest.approx(4 * 2 * radius - radius, abs=0.1)  # facets lie 0.03 mm below the sphere
    y, x = np.nonzero(depth[0])
    points = transform(inverse(T[0]), unproject(K, np.stack([x, y], -1).astype(float), depth[0][y, x].astype(float)))
    np.testing.assert_allclose(np.linalg.norm(points - [7, 8, 9], axis=-1), radius, atol=0.1)
    outline = np.ptp(x) + 1, np.ptp(y) + 1
    np.testing.assert_allclose(outline, 0.8 * 101, atol=1.5)  # a pixel at either side may be missed


@both
def test_pixel_centres_are_integers(renderer):
    """The edge x = 0 of a plane at depth f is at pixel cx: plane just left of cx, background just right of it."""
    mesh = Mesh(
        np.array([[-90, -90, 0], [0, -90, 0], [0, 90, 0], [-90, 90, 0]], dtype=float), np.array([[0, 1, 2], [0, 2, 3]])
    )
    T = np.eye(4)[None].copy()
    T[0, 2, 3] = 100.0
    for cx, last in ((20.01, 20), (19.99, 19), (20.51, 20)):
        K = np.array([[100.0, 0, cx], [0, 100.0, 16.0], [0, 0, 1]])
        _, depth = renderer(supersample=1).render(mesh, K, T, (33, 41))
        columns = np.flatnonzero(depth[0].any(axis=0))
        assert columns[-1] == last
        np.testing.assert_allclose(depth[0][depth[0] > 0], 100.0, rtol=1e-4)  # GL: 24 bits between near and far


@both
def test_colours_texture_and_grey_are_reproduced(renderer):
    colours = np.array([[255, 0, 0], [255, 0, 0], [0, 0, 255], [0, 0, 255]], np.uint8)
    texture = np.zeros((64, 64, 3), np.uint8)
    texture[:32] = (10, 200, 30)  # upper half of the image, v > 0.5
    texture[32:] = (200, 20, 90)
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=float)
    spec = renderer(size=33, ambient=1.0, diffuse=0.0)
    T = np.eye(4)[None].copy()
    T[0, 2, 3] = 500.0
    K = np.array([[80.0, 0, 16], [0, 80.0, 16], [0, 0, 1]])
    red_to_blue = spec.render(quad(0, colours=colours), K, T, (33, 33))[0][0]
    # y is down in the camera: vertices 0 and 1 (red), v = 0, are at the top
    np.testing.assert_allclose(red_to_blue[1, 16], [247, 0, 8], atol=2)  # the quad spans rows 0 to 32: 255 / 32 a row
    np.testing.assert_allclose(red_to_blue[31, 16], [8, 0, 247], atol=2)
    textured = spec.render(quad(0, uv=uv, texture=texture), K, T, (33, 33))[0][0]
    np.testing.assert_allclose(textured[8, 8], [200, 20, 90], atol=1)
    np.testing.assert_allclose(textured[24, 24], [10, 200, 30], atol=1)
    grey = spec.render(quad(0), K, T, (33, 33))[0][0]
    np.testing.assert_allclose(grey[16, 16], 178, atol=1)


@both
def test_light_comes_from_the_camera_and_shows_both_sides(renderer):
    spec = renderer(size=32, ambient=0.2, diffuse=0.8)
    T = look_at(np.array([[0, 0, 600.0], [0, 0, -600.0], [0, -600 * 0.5**0.5, 600 * 0.5**0.5]]))
    K = np.array([[60.0, 0, 16], [0, 60.0, 16], [0, 0, 1]])
    rgb, _ = spec.render(quad(0), K, T, (33, 33))
    front, back, oblique = rgb[:, 16, 16, 0].astype(float)
    assert front == back == pytest.approx(178, abs=1)
    assert oblique == pytest.approx(178 * (0.2 + 0.8 * 0.5**0.5), abs=2)  # normals pass through 8 bits in GL


def test_background_is_black_and_the_outline_has_no_dark_rim():
    mesh = ball(50)
    spec = Raycast(size=64, count=2, ambient=1.0, diffuse=0.0)
    rgb, depth = spec.render(mesh, *spec.cameras(mesh))
    assert (rgb[depth == 0] == 0).all()
    assert (rgb[depth > 0] == 178).all()
    assert depth.dtype == np.float32


def test_supersampling_averages_over_the_pixel():
    colours = np.zeros((2 * 400, 3), np.uint8)
    colours[::4] = colours[1::4] = 255
    x = np.repeat(np.arange(400) // 2 * 1.0 + np.arange(400) % 2, 2)  # stripes of 1 mm, black and white
    vertices = np.stack([x - 100, np.tile([-100.0, 100.0], 400), np.zeros(800)], axis=-1)
    first = np.arange(0, 800, 4)
    faces = np.concatenate(
        [np.stack([first, first + 1, first + 2], -1), np.stack([first + 1, first + 3, first + 2], -1)]
    )
    colours = np.where((np.arange(800) // 4 % 2 == 0)[:, None], 255, 0).repeat(3, axis=1).astype(np.uint8)
    mesh = Mesh(vertices, faces, colours=colours)
    T = np.eye(4)[None].copy()
    T[0, 2, 3] = 1000.0
    K = np.array([[500.0, 0, 20.1], [0, 500.0, 16], [0, 0, 1]])  # a pixel is 2 mm wide: a pair of stripes
    spread = {}
    for s in (1, 4):
        rgb, _ = Raycast(supersample=s, ambient=1.0, diffuse=0.0).render(mesh, K, T, (33, 41))
        spread[s] = np.abs(rgb[0, 10:20, 5:35, 0].astype(float) - 127.5).mean()
    assert spread[1] > 120
    assert spread[4] < 25


def test_render_depth_accepts_one_camera_per_pose():
    mesh = make_object(3)
    T = look_at(np.array([[0.0, -600, 100], [500, 200, 300]]))
    K = np.array([[[400.0, 0, 70], [0, 410, 40], [0, 0, 1]], [[300.0, 0, 60], [0, 310, 50], [0, 0, 1]]])
    depth = render_depth(mesh, K, T, (96, 128))
    assert depth.shape == (2, 96, 128)
    assert depth.dtype == np.float32
    for k in range(2):
        np.testing.assert_array_equal(depth[k], render_depth(mesh, K[k], T[k : k + 1], (96, 128))[0])
        px = project(K[k], transform(T[k], mesh.vertices))
        y, x = np.nonzero(depth[k])
        np.testing.assert_allclose(
            [x.min(), x.max(), y.min(), y.max()],
            [px[:, 0].min(), px[:, 0].max(), px[:, 1].min(), px[:, 1].max()],
            atol=1.01,
        )


def test_an_object_outside_the_image_behind_or_around_the_camera_is_no_error():
    mesh = ball(50)
    K = np.array([[100.0, 0, 32], [0, 100.0, 32], [0, 0, 1]])
    T = np.tile(np.eye(4), (4, 1, 1))
    T[:, :3, 3] = [[0, 0, -300], [5000, 0, 300], [0, 0, 0], [40, 0, 30]]
    behind, beside, around, touching = render_depth(mesh, K, T, (64, 64))
    assert not behind.any()
    assert not beside.any()
    assert (around > 0).all()
    assert around.max() <= 50
    assert (touching > 0).any()


@pytest.mark.parametrize("turn_deg", [0, 10, 45, 90])
def test_only_pixels_that_cannot_show_the_mesh_are_left_out(turn_deg):
    """The pixels inside the outline of the bounding box: every ray that hits the mesh, and no whole rectangle."""
    K = np.array([[900.0, 0, 60.3], [0, 880, 41.8], [0, 0, 1]])
    for mesh in (make_object(1), Mesh(np.array([[-9.0, 0, 0], [9, 0, 0], [9, 30, 0]]), np.array([[0, 1, 2]]))):
        caster = get_caster(mesh)
        angle = np.radians(turn_deg)
        T = np.eye(4)
        T[:3, :3] = [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
        T[2, 3] = 10 * caster.radius
        everywhere = np.stack(np.meshgrid(np.arange(130), np.arange(90)), axis=-1).reshape(-1, 2)
        hits = {tuple(px) for px in everywhere[caster.cast(K, T, everywhere).ray]}
        covered = [tuple(px) for px in caster.covered_pixels(K, T, (90, 130))]
        assert hits <= set(covered)
        assert len(covered) == len(set(covered))
        assert covered == sorted(covered, key=lambda px: (px[1], px[0]))


def test_surface_points_face_the_camera_and_agree_with_the_depth_map():
    mesh = make_object(0)
    T = look_at(np.array([[300.0, -600, 200]]))[0]
    K = np.array([[400.0, 0, 64], [0, 400, 48], [0, 0, 1]])
    px, albedo, normal, depth = surface_points(mesh, K, T, (96, 128))
    np.testing.assert_array_equal(render_depth(mesh, K, T[None], (96, 128))[0][px[:, 1], px[:, 0]], depth)
    points = unproject(K, px.astype(float), depth.astype(float))
    # smooth normals turn away a little before the surface does
    assert ((normal * points).sum(-1) <= 1e-6 * depth).all()
    np.testing.assert_allclose(np.linalg.norm(normal, axis=-1), 1, atol=1e-5)
    assert albedo.max() > 50


def test_no_ray_passes_through_an_edge():
    """A camera in the plane of many edges: pixel columns run along meridians of the ball."""
    mesh = ball(50, level=2)
    K = np.array([[300.0, 0, 32], [0, 300.0, 32], [0, 0, 1]])
    depth = render_depth(mesh, K, look_at(np.array([[0.0, -300, 0], [0, 0, 300], [300, 0, 0]])), (65, 65))
    for view in depth > 0:
        rows = np.flatnonzero(view.any(1))
        assert all(np.ptp(np.flatnonzero(view[row])) + 1 == view[row].sum() for row in rows)


@pytest.mark.gl
@pytest.mark.parametrize(
    "rel", ["lmo/models/obj_000001.ply", "lmo/models/obj_000009.ply", "ycbv/models/obj_000014.ply"]
)
def test_both_renderers_agree_on_real_meshes(rel, bop_mini):
    mesh = read_mesh(bop_mini / rel)
    fields_ = {"size": 128, "count": 6}
    spec = Raycast(**fields_)
    cameras = spec.cameras(mesh)
    rgb, depth = spec.render(mesh, *cameras)
    rgb_gl, depth_gl = Pyrender(**fields_).render(mesh, *cameras)
    seen, seen_gl = depth > 0, depth_gl > 0
    inside = np.ones_like(seen)
    for axis in (1, 2):
        for shift in (-1, 1):
            inside &= np.roll(seen, shift, axis) == seen
    assert not ((seen != seen_gl) & inside).any()  # masks differ on the silhouette alone
    assert (seen != seen_gl).sum() / seen.sum() < 2e-4
    apart = np.abs(depth - depth_gl)[seen & seen_gl] / diameter_mm(mesh)
    # at an inner outline the two may see either side of it: fewer than one pixel in 5,000
    assert (apart > 1e-3).mean() < 2e-4
    assert np.quantile(apart, 0.999) < 1e-4
    # GL chooses mip levels by its own footprint and has 8-bit normals
    assert np.abs(rgb.astype(float) - rgb_gl)[seen & seen_gl].mean() < 3


def test_auto_resolves_to_the_ray_caster_with_every_field():
    chosen = Auto(size=64, count=7, viewpoints="superfibonacci").resolve()
    assert chosen == Raycast(size=64, count=7, viewpoints="superfibonacci")
    assert chosen.recipe()["kind"] == "render.raycast"
    mesh = ball(20)
    auto = Auto(size=32, count=2)
    for ours, theirs in zip(
        auto.render(mesh, *auto.cameras(mesh)), auto.resolve().render(mesh, *auto.cameras(mesh)), strict=True
    ):
        np.testing.assert_array_equal(ours, theirs)


def python(code: str, **environment: str) -> str:
    run = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)],
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=True,
    )
    return run.stdout.strip()


def test_auto_falls_back_to_pyrender_without_embree_and_raycast_says_what_to_install():
    out = python("""
        import sys
        sys.modules["embreex"] = None
        sys.modules["embreex.rtcore_scene"] = None
        import numpy as np
        from pipeline.errors import BadInput
        from pipeline.items.objects import Mesh
        from pipeline.stages.render.auto import Auto
        from pipeline.stages.render.raycast import Raycast
        print(type(Auto(count=9).resolve()).__name__, Auto(count=9).resolve().count)
        mesh = Mesh(np.eye(3), np.array([[0, 1, 2]]))
        try:
            Raycast().render(mesh, *Raycast(count=1).cameras(mesh))
        except BadInput as error:
            print(error)
    """)
    first, second = out.splitlines()
    assert first == "Pyrender 9"
    assert "pip install embreex" in second


def test_specs_are_built_and_cameras_placed_without_loading_a_renderer():
    out = python("""
        import sys
        import numpy as np
        from pipeline.items.objects import Mesh
        from pipeline.stages.render.auto import Auto
        from pipeline.stages.render.pyrender import Pyrender
        from pipeline.stages.render.raycast import Raycast
        mesh = Mesh(np.eye(3), np.array([[0, 1, 2]]))
        for spec in (Auto(), Pyrender(), Raycast()):
            spec.cameras(mesh)
        print([name for name in ("pyrender", "embreex", "OpenGL", "trimesh") if name in sys.modules])
    """)
    assert out == "[]"


def test_without_gl_pyrender_says_which_packages_to_install():
    out = python(
        """
        import numpy as np
        from pipeline.errors import BadInput
        from pipeline.items.objects import Mesh
        from pipeline.stages.render.pyrender import Pyrender
        mesh, spec = Mesh(np.eye(3), np.array([[0, 1, 2]])), Pyrender(count=1, size=16)
        try:
            spec.render(mesh, *spec.cameras(mesh))
        except BadInput as error:
            print(error)
        """,
        EGL_DEVICE_ID="99",
    )
    assert out.startswith("render=pyrender: found no OpenGL context")
    assert "apt-get install libegl1 libgl1-mesa-dri" in out
    assert len(out.splitlines()) == 1


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"viewpoints": "cube"}, "render.viewpoints: found 'cube'"),
        ({"count": 0}, "render.count: found 0"),
        ({"distance": 0.5}, "render.distance: found 0.5"),
        ({"fill": 1.2}, "render.fill: found 1.2"),
        ({"size": "256"}, "render.size: found '256'"),
        ({"views": 3}, "render.views: found an unknown field, needs one of: viewpoints, count"),
    ],
)
def test_a_wrong_field_is_one_line(values, message):
    with pytest.raises(BadInput) as error:
        build(Raycast, values, where="render")
    assert str(error.value).startswith(message)
