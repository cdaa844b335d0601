import struct

import numpy as np
import pytest
import trimesh
from mesh_files import BLUE, CORNER_COLOURS, RED, SQUARE, SQUARE_FACES, area, assert_corner_colours

from pipeline.errors import BadInput
from pipeline.io.digests import files_digest
from pipeline.io.meshes import read_mesh


def off(rows, faces=("3 0 1 2", "3 0 2 3"), header="OFF"):
    lines = [header, f"{len(rows)} {len(faces)} 0", *(" ".join(f"{x:g}" for x in row) for row in rows), *faces]
    return "\n".join(lines) + "\n"


DIALECTS = {
    "rgba": (CORNER_COLOURS, "COFF", [255]),
    "rgb": (CORNER_COLOURS, "COFF", []),
    "floats": (CORNER_COLOURS / 255, "COFF", [1.0]),
    "without the C": (CORNER_COLOURS, "OFF", [255]),
    "header and counts in one line": (CORNER_COLOURS, "COFF ", []),
}


@pytest.mark.parametrize("name", DIALECTS)
def test_colours_of_vertices_arrive(name, tmp_path):
    colours, header, alpha = DIALECTS[name]
    rows = [[*v, *c, *alpha] for v, c in zip(SQUARE, colours, strict=True)]
    text = off(rows, header=header)
    (tmp_path / "a.off").write_text(text.replace(" \n", " ") if header.endswith(" ") else text)
    mesh = read_mesh(tmp_path / "a.off")
    np.testing.assert_array_equal(mesh.vertices, SQUARE)
    assert_corner_colours(mesh, CORNER_COLOURS)


def test_normals_are_no_colours(tmp_path):
    rows = [[*v, 0, 0, 1] for v in SQUARE]
    (tmp_path / "a.off").write_text(off(rows, header="NOFF"))
    assert read_mesh(tmp_path / "a.off").colours is None
    rows = [[*v, 0, 0, 1, *c] for v, c in zip(SQUARE, CORNER_COLOURS, strict=True)]
    (tmp_path / "a.off").write_text(off(rows, header="CNOFF"))
    assert_corner_colours(read_mesh(tmp_path / "a.off"), CORNER_COLOURS)


def test_colours_of_faces_arrive(tmp_path):
    vertices = np.concatenate([SQUARE, SQUARE + np.array([0, 0, 5])])
    (tmp_path / "a.off").write_text(off(vertices, ["4 0 1 2 3 255 0 0", "4 4 5 6 7 0 0 255"]))
    mesh = read_mesh(tmp_path / "a.off")
    assert_corner_colours(mesh, np.tile(RED, (4, 1)))
    assert_corner_colours(mesh, np.tile(BLUE, (4, 1)), SQUARE + np.array([0, 0, 5]))


def test_concave_polygon_of_an_off_file_keeps_its_area(tmp_path):
    ring = [(0, 0), (9, 0), (9, 9), (6, 9), (6, 3), (3, 3), (3, 9), (0, 9)]
    (tmp_path / "a.off").write_text(off([(*p, 0) for p in ring], ["8 0 1 2 3 4 5 6 7 # comment"]))
    assert area(read_mesh(tmp_path / "a.off")) == pytest.approx(63)


@pytest.mark.parametrize(
    "text", ["OFF BINARY\n", "OFF\n4 2\n0 0 0\n", "STL\n", "COFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"]
)
def test_off_file_that_cannot_be_read_is_refused(text, tmp_path):
    (tmp_path / "a.off").write_text(text)
    with pytest.raises(BadInput, match=r"a\.off: found"):
        read_mesh(tmp_path / "a.off")


def stl(header: bytes, spare: list[int]) -> bytes:
    data = header.ljust(80, b" ") + struct.pack("<I", len(SQUARE_FACES))
    for face, word in zip(SQUARE_FACES, spare, strict=True):
        data += struct.pack("<12fH", 0, 0, 1, *SQUARE[face].reshape(-1), word)
    return data


VALID = 0x8000
COLOURED = {
    "VisCAM": (b"", [VALID | 31 << 10, VALID | 31], [(255, 0, 0), (0, 0, 255)]),
    "Magics": (b"COLOR=\x0a\x14\x1e\xff", [31, VALID], [(255, 0, 0), (10, 20, 30)]),
}


@pytest.mark.parametrize("name", COLOURED)
def test_colours_of_binary_stl_arrive(name, tmp_path):
    header, spare, colours = COLOURED[name]
    (tmp_path / "a.stl").write_bytes(stl(header, spare))
    mesh = read_mesh(tmp_path / "a.stl")
    np.testing.assert_array_equal(mesh.colours[mesh.faces], np.repeat(np.array(colours)[:, None], 3, axis=1))
    assert mesh.digest != files_digest({"a.stl": tmp_path / "a.stl"})


@pytest.mark.parametrize("spare", [[0, 0], [7, 9], [VALID, 0]])
def test_spare_bytes_of_other_programs_are_no_colours(spare, tmp_path):
    (tmp_path / "a.stl").write_bytes(stl(b"", spare))
    mesh = read_mesh(tmp_path / "a.stl")
    assert mesh.colours is None
    assert mesh.digest == files_digest({"a.stl": tmp_path / "a.stl"})


def test_text_stl_of_several_solids_is_one_mesh(tmp_path):
    text = "".join(
        trimesh.exchange.stl.export_stl_ascii(trimesh.creation.box((1, 1, 1)).apply_translation([k * 5, 0, 0]))
        for k in range(2)
    )
    (tmp_path / "a.stl").write_text(text)
    mesh = read_mesh(tmp_path / "a.stl")
    assert area(mesh) == pytest.approx(12)
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), [6, 1, 1])
