import struct

import numpy as np
import pytest
from mesh_files import BLUE, CORNER_COLOURS, RED, SQUARE, UV, area, assert_corner_colours, texture
from PIL import Image

from pipeline.errors import BadInput
from pipeline.io.meshes import identify_mesh, read_mesh

TRIANGLES = [[0, 1, 2], [0, 2, 3]]
NUMPY = {"uchar": "u1", "ushort": "u2", "int": "i4", "float": "f4", "double": "f8", "char": "i1"}


def write_ply(path, rows, faces, *, vertex=(), face=(), extra=(), comments=(), form="ascii", count="uchar"):
    """``vertex``, ``face``: types and names of properties after x, y, z and the list of indices."""
    head = ["ply", f"format {form} 1.0", *comments, f"element vertex {len(rows)}"]
    head += [f"property float {axis}" for axis in "xyz"] + [f"property {kind} {name}" for kind, name in vertex]
    head += [f"element face {len(faces)}", f"property list {count} int vertex_indices"]
    head += [f"property {kind} {name}" for kind, name in face]
    text = "\n".join([*head, "end_header\n"]).encode()
    order = ">" if "big" in form else "<"
    code = {"uchar": "B", "ushort": "H", "int": "i", "float": "f", "double": "d", "char": "b"}
    body = b""
    extra = extra or [()] * len(faces)
    if form == "ascii":
        lines = [" ".join(f"{x:g}" for x in row) for row in rows]
        lines += [" ".join(f"{x:g}" for x in (len(f), *f, *e)) for f, e in zip(faces, extra, strict=True)]
        body = ("\n".join(lines) + "\n").encode()
    else:
        kinds = ["float"] * 3 + [kind for kind, _ in vertex]
        for row in rows:
            numbers = [x if kind in ("float", "double") else int(x) for kind, x in zip(kinds, row, strict=True)]
            body += struct.pack(order + "".join(code[kind] for kind in kinds), *numbers)
        for f, e in zip(faces, extra, strict=True):
            body += struct.pack(f"{order}{code[count]}{len(f)}i", len(f), *f)
            tail = [word for kind, _ in face for word in ([kind] if "list" not in kind else [])]
            body += b"".join(struct.pack(order + code[k], x) for k, x in zip(tail, e, strict=True))
    path.write_bytes(text + body)
    return path


FORMS = ["ascii", "binary_little_endian", "binary_big_endian"]
NAMES = ["red green blue", "diffuse_red diffuse_green diffuse_blue", "r g b", "Red Green Blue"]
SCALES = [("uchar", 255), ("float", 1), ("float", 255), ("ushort", 65535), ("int", 255), ("double", 1)]


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("names", NAMES)
@pytest.mark.parametrize(("kind", "top"), SCALES)
def test_vertex_colours_of_every_type_scale_and_name_arrive(form, names, kind, top, tmp_path):
    colours = CORNER_COLOURS / 255 * top
    rows = np.concatenate([SQUARE, colours if kind in ("float", "double") else np.rint(colours)], axis=1)
    path = write_ply(tmp_path / "a.ply", rows, TRIANGLES, vertex=[(kind, name) for name in names.split()], form=form)
    mesh = read_mesh(path)
    np.testing.assert_array_equal(mesh.vertices, SQUARE)
    assert_corner_colours(mesh, CORNER_COLOURS)
    assert mesh.digest == identify_mesh(path).digest


def test_surface_colour_is_preferred_to_that_of_reflections(tmp_path):
    names = [f"{kind}_{name}" for kind in ("ambient", "diffuse", "specular") for name in ("red", "green", "blue")]
    rows = np.concatenate([SQUARE, CORNER_COLOURS * 0, CORNER_COLOURS, CORNER_COLOURS * 0 + 255], axis=1)
    mesh = read_mesh(write_ply(tmp_path / "a.ply", rows, TRIANGLES, vertex=[("uchar", name) for name in names]))
    assert_corner_colours(mesh, CORNER_COLOURS)


@pytest.mark.parametrize(("kind", "value"), [("float", -0.5), ("float", float("nan")), ("float", 1e6), ("int", -3)])
def test_impossible_colour_is_refused(kind, value, tmp_path):
    rows = np.concatenate([SQUARE, np.full((4, 3), value)], axis=1)
    vertex = [(kind, name) for name in ("red", "green", "blue")]
    with pytest.raises(BadInput, match=r"a\.ply: found a colour"):
        read_mesh(write_ply(tmp_path / "a.ply", rows, TRIANGLES, vertex=vertex))


@pytest.mark.parametrize(
    "names", [("intensity",), ("rgb",), ("red", "green"), ("specular_red", "specular_green", "specular_blue")]
)
def test_colours_that_are_not_read_are_a_warning(names, tmp_path):
    rows = np.concatenate([SQUARE, np.ones((4, len(names)))], axis=1)
    mesh = read_mesh(write_ply(tmp_path / "a.ply", rows, TRIANGLES, vertex=[("uchar", name) for name in names]))
    assert mesh.colours is None
    assert mesh.warnings == (f"its properties {', '.join(names)} are not read as colours; red, green and blue are",)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("count", ["uchar", "ushort", "int"])
def test_triangles_quads_and_polygons_may_mix(form, count, tmp_path):
    ring = [(0, 0), (9, 0), (9, 9), (6, 9), (6, 3), (3, 3), (3, 9), (0, 9)]  # concave, area 63
    vertices = np.concatenate([SQUARE, SQUARE + np.array([0, 0, 5]), [(x, y, 10) for x, y in ring]])
    faces = [[0, 1, 2, 3], [4, 5, 6], list(range(8, 16)), [4, 6, 7]]
    mesh = read_mesh(write_ply(tmp_path / "a.ply", vertices, faces, form=form, count=count))
    assert len(mesh.faces) == 2 + 2 + 6
    assert area(mesh) == pytest.approx(263)


@pytest.mark.parametrize("form", FORMS)
def test_face_colours_of_quads_and_triangles_arrive(form, tmp_path):
    vertices = np.concatenate([SQUARE, SQUARE + np.array([0, 0, 5])])
    face = [("uchar", name) for name in ("red", "green", "blue")]
    faces, extra = [[0, 1, 2, 3], [4, 5, 6], [4, 6, 7]], [RED, BLUE, BLUE]
    mesh = read_mesh(write_ply(tmp_path / "a.ply", vertices, faces, face=face, extra=extra, form=form))
    assert_corner_colours(mesh, np.tile(RED, (4, 1)))
    assert_corner_colours(mesh, np.tile(BLUE, (4, 1)), SQUARE + np.array([0, 0, 5]))


@pytest.mark.parametrize("flip", [False, True])
def test_concave_quad_is_cut_inside(flip, tmp_path):
    arrow = np.array([(0, 0, 0), (10, 10, 0), (0, 4, 0), (-10, 10, 0)], dtype=float)
    mesh = read_mesh(write_ply(tmp_path / "a.ply", arrow, [[1, 2, 3, 0] if flip else [0, 1, 2, 3]]))
    assert area(mesh) == pytest.approx(40)


def corner_row(face, number=None):
    values = [*UV[face].reshape(-1)]
    return (len(values), *values) if number is None else (len(values), *values, number)


def test_several_textures_arrive_by_their_numbers(tmp_path):
    """As MeshLab writes them; faces with the number -1 have none."""
    texture().save(tmp_path / "t0.png")
    Image.new("RGB", (4, 4), (1, 2, 3)).save(tmp_path / "t1.png")
    vertices = np.concatenate([SQUARE, SQUARE + np.array([0, 0, 5]), SQUARE + np.array([0, 0, 10])])
    faces = [[*(k + 4 * layer for k in face)] for layer in range(3) for face in TRIANGLES]
    extra = [corner_row(face, number) for number in (0, 1, -1) for face in TRIANGLES]
    face = [("list uchar float", "texcoord"), ("int", "texnumber")]
    comments = ["comment TextureFile t0.png", "comment TextureFile t1.png"]
    path = write_ply(tmp_path / "a.ply", vertices, faces, face=face, extra=extra, comments=comments)
    mesh = read_mesh(path)
    assert_corner_colours(mesh, CORNER_COLOURS)
    assert_corner_colours(mesh, np.tile([1, 2, 3], (4, 1)), SQUARE + np.array([0, 0, 5]))
    assert area(mesh) == pytest.approx(300)
    assert mesh.digest == identify_mesh(path).digest
    (tmp_path / "t1.png").unlink()
    with pytest.raises(BadInput, match=r"t1\.png: found no such file"):
        identify_mesh(path)


def test_several_textures_without_numbers_are_refused(tmp_path):
    texture().save(tmp_path / "t0.png")
    comments = ["comment TextureFile t0.png"] * 2
    rows = np.concatenate([SQUARE, UV], axis=1)
    vertex = [("float", "texture_u"), ("float", "texture_v")]
    with pytest.raises(BadInput, match="2 textures, and faces without 'texnumber'"):
        read_mesh(write_ply(tmp_path / "a.ply", rows, TRIANGLES, vertex=vertex, comments=comments))


def test_corner_coordinates_of_quads_arrive(tmp_path):
    texture().save(tmp_path / "t0.png")
    path = write_ply(
        tmp_path / "a.ply",
        SQUARE,
        [[0, 1, 2, 3]],
        face=[("list uchar float", "texcoord")],
        extra=[corner_row([0, 1, 2, 3])],
        comments=["comment TextureFile t0.png"],
    )
    assert_corner_colours(read_mesh(path), CORNER_COLOURS)


def test_stray_vertex_keeps_its_place(tmp_path):
    vertices = np.concatenate([[[5000, 0, 0]], SQUARE])
    mesh = read_mesh(write_ply(tmp_path / "a.ply", vertices, [[1, 2, 3], [1, 3, 4]]))
    np.testing.assert_array_equal(mesh.vertices, vertices)


def test_triangle_strips_are_refused_by_name(tmp_path):
    text = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    text += "element tristrips 1\nproperty list int int vertex_indices\nend_header\n"
    (tmp_path / "a.ply").write_text(text + "0 0 0\n1 0 0\n0 1 0\n1 1 0\n4 0 1 2 3\n")
    with pytest.raises(BadInput, match="triangle strips"):
        read_mesh(tmp_path / "a.ply")


CUT = {
    "vertices": lambda data: data[: data.index(b"end_header") + 20],
    "faces": lambda data: data[:-5],
    "list": lambda data: data[:-1],
    "more": lambda data: data + b"\0\0\0\0",
}


@pytest.mark.parametrize("form", FORMS[1:])
@pytest.mark.parametrize("name", CUT)
def test_other_length_than_declared_is_refused(form, name, tmp_path):
    path = write_ply(tmp_path / "a.ply", SQUARE, [[0, 1, 2, 3], [0, 1, 2]], form=form)
    path.write_bytes(CUT[name](path.read_bytes()))
    with pytest.raises(BadInput, match="header declares"):
        read_mesh(path)


def test_digest_changes_only_where_the_mesh_is_read_otherwise_than_before(tmp_path):
    """Digests of files that the first version of the reader read right are those of their bytes."""
    from pipeline.io.digests import files_digest

    colours = np.concatenate([SQUARE, CORNER_COLOURS], axis=1)
    rgb = [("uchar", name) for name in ("red", "green", "blue")]
    old = write_ply(tmp_path / "old.ply", colours, [[0, 1, 2, 3]], vertex=rgb)
    assert read_mesh(old).digest == files_digest({"old.ply": old})
    floats = [("float", name) for name in ("red", "green", "blue")]
    unit = write_ply(tmp_path / "unit.ply", colours / [1, 1, 1, 255, 255, 255], TRIANGLES, vertex=floats)
    assert read_mesh(unit).digest == files_digest({"unit.ply": unit})
    new = [
        write_ply(tmp_path / "a.ply", colours, TRIANGLES, vertex=floats),
        write_ply(tmp_path / "b.ply", SQUARE[[0, 1, 3, 2]] * [1, 1, 0], [[0, 1, 2, 3]]),
        write_ply(tmp_path / "c.ply", colours, TRIANGLES, vertex=[("uchar", f"diffuse_{n}") for _, n in rgb]),
    ]
    for path in new[::2]:
        assert read_mesh(path).digest != files_digest({path.name: path})
