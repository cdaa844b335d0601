import numpy as np
import pytest
from mesh_files import CORNER_COLOURS, SQUARE, SQUARE_FACES, UV, area, assert_corner_colours, normals, texture
from PIL import Image

from pipeline.errors import BadInput
from pipeline.functional.shading import DEFAULT_GREY
from pipeline.io.meshes import read_mesh

VERTICES = [f"v {x:g} {y:g} {z:g}" for x, y, z in SQUARE]
COORDINATES = [f"vt {u} {v}" for u, v in UV]
FACES = ["f " + " ".join(f"{k + 1}/{k + 1}" for k in face) for face in SQUARE_FACES]
PLAIN_FACES = ["f " + " ".join(f"{k + 1}" for k in face) for face in SQUARE_FACES]
TEXTURED = ["mtllib a.mtl", "usemtl skin", *VERTICES, *COORDINATES, *FACES]


@pytest.fixture
def write(tmp_path):
    """Write lines as a.obj, beside a.mtl and skin.png."""

    def write(lines, mtl="newmtl skin\nKd 1 1 1\nmap_Kd skin.png\n", name="a.obj"):
        texture().save(tmp_path / "skin.png")
        (tmp_path / "a.mtl").write_text(mtl)
        (tmp_path / name).write_bytes("\n".join(lines).encode())
        return tmp_path / name

    return write


MAPS = {
    "plain": "map_Kd skin.png",
    "scale": "map_Kd -s 1 1 1 skin.png",
    "offset and clamp": "map_Kd -o 0 0 0 -clamp on skin.png",
    "many": "map_Kd -blendu on -blendv off -cc off -mm 0 1 -texres 512 -t 0 0 -bm 1.0 -imfchan l skin.png",
    "case": "Map_kd skin.png",
    "folder": "map_Kd ./skin.png",
    "tab": "map_Kd\tskin.png",
}


@pytest.mark.parametrize("name", MAPS)
def test_options_before_a_textures_name_are_understood(name, write):
    mesh = read_mesh(write(TEXTURED, f"newmtl skin\n{MAPS[name]}\n"))
    assert_corner_colours(mesh, CORNER_COLOURS)
    assert mesh.warnings == ()


def test_scale_and_offset_of_a_texture_are_applied(write):
    stored = [f"vt {u / 2} {(v - 1) / 4}" for u, v in UV]
    lines = ["mtllib a.mtl", "usemtl skin", *VERTICES, *stored, *FACES]
    mesh = read_mesh(write(lines, "newmtl skin\nmap_Kd -s 2 4 1 -o 0 1 0 skin.png\n"))
    assert_corner_colours(mesh, CORNER_COLOURS)


@pytest.mark.parametrize("name", ["a b.png", "a  b-s 1.png", "-s.png"])
def test_texture_names_may_contain_blanks_and_dashes(name, write, tmp_path):
    texture().save(tmp_path / name)
    for option in ("", "-s 1 1 1 "):
        mesh = read_mesh(write(TEXTURED, f"newmtl skin\nmap_Kd {option}{name}\n"))
        assert_corner_colours(mesh, CORNER_COLOURS)


def test_option_that_changes_colours_is_refused(write):
    with pytest.raises(BadInput, match=r"a\.mtl: found map_Kd with -mm 0\.2 1\.5"):
        read_mesh(write(TEXTURED, "newmtl skin\nmap_Kd -mm 0.2 1.5 skin.png\n"))


@pytest.mark.parametrize("scale", [1, 255, 65535])
@pytest.mark.parametrize("mtl", ["newmtl skin\nKd 1 1 1\n", "newmtl skin\nKd 0.5 0 0\n", "newmtl skin\n", None])
def test_vertex_colours_arrive_whatever_the_material_and_scale(scale, mtl, write):
    number = "{:.4f}" if scale == 1 else "{:.0f}"
    colours = [" ".join(number.format(c / 255 * scale) for c in colour) for colour in CORNER_COLOURS]
    lines = [f"{v} {c}" for v, c in zip(VERTICES, colours, strict=True)] + ["usemtl skin", *PLAIN_FACES]
    mesh = read_mesh(write(lines if mtl is None else ["mtllib a.mtl", *lines], mtl or ""))
    assert_corner_colours(mesh, CORNER_COLOURS)
    assert mesh.warnings == (("its material 'skin' is in no material file",) if mtl is None else ())


def test_vertices_without_a_colour_are_grey(write):
    lines = [VERTICES[0] + " 1 0 0", *VERTICES[1:3], VERTICES[3] + " 0 0 1 1", *PLAIN_FACES]
    grey = [DEFAULT_GREY] * 3
    assert_corner_colours(read_mesh(write(lines)), np.array([[255, 0, 0], grey, grey, [0, 0, 255]]))


def test_fourth_number_of_a_vertex_is_no_colour(write):
    mesh = read_mesh(write([v + " 1.0" for v in VERTICES] + PLAIN_FACES))
    np.testing.assert_array_equal(mesh.vertices, SQUARE)
    assert mesh.colours is None


def relative_groups(form):
    """Two squares, each a block of vertices followed by faces that count back."""
    lines = []
    for k in range(2):
        lines += [f"v {x:g} {y:g} {z + 5 * k:g}" for x, y, z in SQUARE] + COORDINATES + ["vn 0 0 1"]
        lines += ["f " + " ".join(form.format(i - 4) for i in face) for face in SQUARE_FACES]
    return lines


@pytest.mark.parametrize("form", ["{0}", "{0}/{0}", "{0}//-1", "{0}/{0}/-1"])
def test_relative_indices_count_back_from_their_line(form, write):
    mesh = read_mesh(write(["mtllib a.mtl", "usemtl skin", *relative_groups(form)]))
    assert area(mesh) == pytest.approx(200)
    corners = mesh.vertices[mesh.faces]
    np.testing.assert_array_equal(corners[..., 2], np.repeat([0, 5], 2)[:, None] * np.ones(3))
    if form.startswith("{0}/{0}"):
        assert_corner_colours(mesh, CORNER_COLOURS)


def test_relative_and_absolute_indices_may_mix_in_a_face(write):
    mesh = read_mesh(write([*VERTICES, "f 1 -3 3", "v 50 50 50", "f 1 3 -2"]))
    np.testing.assert_array_equal(mesh.vertices[mesh.faces], SQUARE[SQUARE_FACES])


WRONG_INDEX = {
    "zero": ("f 0 1 2", "index 0"),
    "too far back": ("f -9 1 2", "index -9"),
    "too high": ("f 1 2 9", "vertex 8"),
    "texture coordinate": ("f 1/1 2/2 3/9", "texture coordinate 9"),
    "texture coordinate zero": ("f 1/0 2/2 3/3", "index 0"),
    "word": ("f 1 2 three", "corners such as"),
}


@pytest.mark.parametrize("case", WRONG_INDEX)
def test_wrong_index_is_named(case, write):
    line, expected = WRONG_INDEX[case]
    with pytest.raises(BadInput, match=expected):
        read_mesh(write([*VERTICES, *COORDINATES, line]))


def test_faces_without_texture_coordinates_leave_the_others_textured(write):
    lines = ["mtllib a.mtl", "usemtl skin", *VERTICES, *COORDINATES, *FACES, "v 0 0 20", "v 10 0 20", "v 0 10 20"]
    for face in ("f 5 6 7", "f 5 6/1 7", "f -3//1 -2//1 -1//1"):
        mesh = read_mesh(write([*lines, "vn 0 0 1", face], "newmtl skin\nKd 0.2 0.4 0.6\nmap_Kd skin.png\n"))
        assert area(mesh) == pytest.approx(150)
        assert_corner_colours(mesh, CORNER_COLOURS)
        assert_corner_colours(mesh, np.array([[51, 102, 153]]), np.array([[0, 0, 20]]))
        assert mesh.warnings == ("1 of its faces have no texture coordinates for 'skin.png'",)


CONCAVE = {
    "bracket": ([(20, 20), (20, 100), (0, 100), (0, 0), (100, 0), (100, 20)], 3600),
    "arrow": ([(0, 0), (10, 10), (0, 4), (-10, 10)], 40),
    "arrow from another corner": ([(10, 10), (0, 4), (-10, 10), (0, 0)], 40),
    "star": (
        [(r * np.cos(a), r * np.sin(a)) for r, a in zip([10, 4] * 5, np.arange(10) * np.pi / 5, strict=True)],
        None,
    ),
    "comb": ([(0, 0), (9, 0), (9, 9), (6, 9), (6, 3), (3, 3), (3, 9), (0, 9)], 63),
    "hexagon": ([(np.cos(a), np.sin(a)) for a in np.arange(6) * np.pi / 3], 1.5 * 3**0.5),
}


@pytest.mark.parametrize("start", range(3))
@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("name", CONCAVE)
def test_concave_polygons_keep_their_area_and_side(name, turned, start, write):
    ring, expected = CONCAVE[name]
    ring = np.roll(np.array(ring, dtype=float), start, axis=0)[:: -1 if turned else 1]
    if expected is None:
        expected = abs((ring[:, 0] * np.roll(ring[:, 1], -1) - ring[:, 1] * np.roll(ring[:, 0], -1)).sum()) / 2
    tilted = np.stack([ring[:, 0], ring[:, 1] * 0.6, ring[:, 1] * 0.8], axis=-1)
    lines = ["v " + " ".join(f"{x:.9f}" for x in point) for point in tilted]
    mesh = read_mesh(write([*lines, "f " + " ".join(str(k + 1) for k in range(len(ring)))]))
    assert len(mesh.faces) == len(ring) - 2
    assert area(mesh) == pytest.approx(expected)
    side = normals(mesh) @ [0, -0.8, 0.6]
    assert (side < 0).all() if turned else (side > 0).all()


def test_texture_coordinates_follow_the_corners_of_a_cut_polygon(write):
    ring = [(0, 0), (9, 0), (9, 9), (6, 9), (6, 3), (3, 3), (3, 9), (0, 9)]
    lines = [f"v {x} {y} 0" for x, y in ring] + [f"vt {x / 9} {y / 9}" for x, y in ring]
    face = "f " + " ".join(f"{k}/{k}" for k in range(1, 9))
    mesh = read_mesh(write(["mtllib a.mtl", "usemtl skin", *lines, face]))
    np.testing.assert_allclose(mesh.uv * 9, mesh.vertices[:, :2], atol=1e-9)


LAYOUTS = {
    "windows line ends": lambda lines: "\r\n".join(lines),
    "old mac line ends": lambda lines: "\r".join(lines),
    "comments": lambda lines: (
        "# a b\n" + "\n".join(f"{line} # {k}" if line[0] in "vf" else line for k, line in enumerate(lines))
    ),
    "indented": lambda lines: "\n".join("  " + line for line in lines),
    "tabs": lambda lines: "\n".join(line.replace(" ", "\t") for line in lines),
    "several blanks": lambda lines: "\n".join(line.replace(" ", "   ") + "  " for line in lines),
    "continued lines": lambda lines: "\n".join(
        line.replace(" ", " \\\n", 2) if line[0] == "f" else line for line in lines
    ),
    "exponents": lambda lines: "\n".join(
        line.replace("10", "1.0e+01") if line.startswith("v ") else line for line in lines
    ),
    "groups": lambda lines: "o thing\ng a\ns 1\n" + "\n".join(lines) + "\ng b\ns off\nl 1 2\np 1\n",
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_layout_of_the_text_does_not_matter(name, write, tmp_path):
    write([])
    (tmp_path / "a.obj").write_bytes(LAYOUTS[name](TEXTURED).encode())
    mesh = read_mesh(tmp_path / "a.obj")
    np.testing.assert_array_equal(mesh.vertices[mesh.faces], SQUARE[SQUARE_FACES])
    assert_corner_colours(mesh, CORNER_COLOURS)


def test_several_material_files_and_names_with_blanks(write, tmp_path):
    Image.new("RGB", (2, 2), (1, 2, 3)).save(tmp_path / "other.png")
    (tmp_path / "b c.mtl").write_text("newmtl other one\nmap_Kd other.png\n")
    high = [f"v {x:g} {y:g} {z + 5:g}" for x, y, z in SQUARE]
    faces = ["f " + " ".join(f"{k + 5}/{k + 1}" for k in face) for face in SQUARE_FACES]
    lines = ["mtllib a.mtl", "mtllib b c.mtl", *TEXTURED[1:], *high, "usemtl other one", *faces]
    mesh = read_mesh(write(lines))
    assert_corner_colours(mesh, CORNER_COLOURS)
    assert_corner_colours(mesh, np.tile([1, 2, 3], (4, 1)), SQUARE + np.array([0, 0, 5]))
    (tmp_path / "c.mtl").write_text("newmtl spare\n")
    assert_corner_colours(read_mesh(write(["mtllib c.mtl a.mtl", *TEXTURED[1:]])), CORNER_COLOURS)


def test_texture_shared_by_materials_is_stored_once(write):
    """Eight materials with one texture once took eight copies of it."""
    texture(512).save(write([]).parent / "skin.png")
    lines, mtl = ["mtllib a.mtl", *COORDINATES], ""
    for k in range(8):
        lines += [f"v {x:g} {y:g} {z + 5 * k:g}" for x, y, z in SQUARE] + [f"usemtl m{k}"]
        lines += ["f " + " ".join(f"{i - 4}/{i + 1}" for i in face) for face in SQUARE_FACES]
        mtl += f"newmtl m{k}\nmap_Kd skin.png\n"
    path = write(lines, mtl)
    texture(512).save(path.parent / "skin.png")
    mesh = read_mesh(path)
    assert max(mesh.texture.shape) < 540
    for k in range(8):
        assert_corner_colours(mesh, CORNER_COLOURS, SQUARE + np.array([0, 0, 5 * k]))


def test_many_large_textures_are_reduced_to_fit_one_image(write, tmp_path, monkeypatch):
    monkeypatch.setattr("pipeline.io.meshes.atlas._MAX_ATLAS_PX", 200_000)
    lines, mtl = ["mtllib a.mtl", *COORDINATES], ""
    for k in range(5):
        lines += [f"v {x:g} {y:g} {z + 5 * k:g}" for x, y, z in SQUARE] + [f"usemtl m{k}"]
        lines += ["f " + " ".join(f"{i - 4}/{i + 1}" for i in face) for face in SQUARE_FACES]
        mtl += f"newmtl m{k}\nmap_Kd t{k}.png\n"
        texture(256).save(tmp_path / f"t{k}.png")
    mesh = read_mesh(write(lines, mtl))
    assert mesh.texture.shape[0] * mesh.texture.shape[1] < 200_000
    assert mesh.warnings == ("its textures are reduced to 1/2 of their size to fit one image",)
    for k in range(5):
        assert_corner_colours(mesh, CORNER_COLOURS, SQUARE + np.array([0, 0, 5 * k]))
