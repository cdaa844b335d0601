import json
import struct
import time
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.spatial.distance import cdist

from pipeline.errors import BadInput
from pipeline.functional.shading import Mipmap, texture_colour
from pipeline.io.meshes import diameter_mm, identify_mesh, read_mesh, write_ply
from pipeline.items.objects import Mesh

# a unit square in two triangles; the texture has one colour per quarter
SQUARE = np.array([[0, 0, 0], [10, 0, 0], [10, 10, 0], [0, 10, 0]], dtype=float)
SQUARE_FACES = np.array([[0, 1, 2], [0, 2, 3]])
UP = np.array([0.0, 0.0, 5.0])
QUARTERS = {"upper left": (255, 0, 0), "upper right": (0, 255, 0), "lower left": (0, 0, 255), "lower right": (9, 9, 9)}
CORNER_QUARTER = ["lower left", "lower right", "upper right", "upper left"]  # of the square's vertices
UV = np.array([[0.1, 0.1], [0.9, 0.1], [0.9, 0.9], [0.1, 0.9]])

PLY_HEAD = "ply\nformat ascii 1.0\n{comment}element vertex {v}\nproperty float x\nproperty float y\nproperty float z\n"
FACE_HEAD = "element face {f}\nproperty list uchar int vertex_indices\n{extra}end_header\n"


def write_texture(folder: Path, name: str = "skin.png") -> Image.Image:
    pixels = np.zeros((8, 8, 3), np.uint8)
    for quarter, colour in QUARTERS.items():
        rows = slice(0, 4) if "upper" in quarter else slice(4, 8)
        pixels[rows, slice(0, 4) if "left" in quarter else slice(4, 8)] = colour
    image = Image.fromarray(pixels)
    image.save(folder / name)
    return image


def ascii_ply(vertices, faces, *, comment="", vertex_extra="", face_extra="") -> str:
    head = PLY_HEAD.format(comment=comment, v=len(vertices)) + vertex_extra
    head += FACE_HEAD.format(f=len(faces), extra=face_extra)
    rows = [" ".join(str(x) for x in row) for row in vertices] + [" ".join(str(x) for x in row) for row in faces]
    return head + "\n".join(rows) + "\n"


def ply_with_vertex_uv(folder: Path) -> Path:
    write_texture(folder)
    rows = np.concatenate([SQUARE, UV], axis=1)
    text = ascii_ply(
        rows,
        [[3, *face] for face in SQUARE_FACES],
        comment="comment TextureFile skin.png\n",
        vertex_extra="property float texture_u\nproperty float texture_v\n",
    )
    (folder / "a.ply").write_text(text)
    return folder / "a.ply"


def ply_with_corner_uv(folder: Path) -> Path:
    write_texture(folder)
    faces = [[3, *face, 6, *UV[face].reshape(-1)] for face in SQUARE_FACES]
    text = ascii_ply(
        SQUARE, faces, comment="comment TextureFile skin.png\n", face_extra="property list uchar float texcoord\n"
    )
    (folder / "b.ply").write_text(text)
    return folder / "b.ply"


def obj_with_mtl(folder: Path) -> Path:
    write_texture(folder)
    (folder / "c.mtl").write_text("newmtl skin\nKd 1 1 1\nmap_Kd skin.png\n")
    lines = ["mtllib c.mtl", "usemtl skin"]
    lines += [f"v {x} {y} {z}" for x, y, z in SQUARE] + [f"vt {u} {v}" for u, v in UV]
    lines += ["f " + " ".join(f"{k + 1}/{k + 1}" for k in face) for face in SQUARE_FACES]
    (folder / "c.obj").write_text("\n".join(lines))
    return folder / "c.obj"


def glb(folder: Path) -> Path:
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=write_texture(folder))
    visual = trimesh.visual.TextureVisuals(uv=UV, material=material)
    trimesh.Trimesh(SQUARE, SQUARE_FACES, visual=visual, process=False).export(folder / "d.glb")
    return folder / "d.glb"


@pytest.mark.parametrize("write", [ply_with_vertex_uv, ply_with_corner_uv, obj_with_mtl, glb])
def test_every_format_maps_the_same_texel_to_the_same_corner(write, tmp_path):
    mesh = read_mesh(write(tmp_path))
    for corner, quarter in zip(SQUARE, CORNER_QUARTER, strict=True):
        at = np.flatnonzero((mesh.vertices == corner).all(axis=1))
        colour = texture_colour(Mipmap.of([mesh.texture]), mesh.uv[at], np.ones(len(at)))
        np.testing.assert_array_equal(colour, np.tile(QUARTERS[quarter], (len(at), 1)))


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".glb", ".gltf", ".stl", ".off"])
def test_every_format_gives_the_same_surface(suffix, tmp_path):
    box = trimesh.creation.box((10, 20, 30))
    if suffix == ".gltf":
        for name, data in trimesh.exchange.gltf.export_gltf(box).items():
            (tmp_path / name).write_bytes(data)
        path = tmp_path / "model.gltf"
    else:
        path = tmp_path / f"box{suffix}"
        box.export(path)
    mesh = read_mesh(path)
    assert len(mesh.faces) == 12
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), [10, 20, 30])
    assert diameter_mm(mesh) == pytest.approx(1400**0.5)


def test_vertices_keep_their_order_and_copies_follow(tmp_path):
    write_texture(tmp_path)
    own = np.array([[[0, 0], [1, 0], [1, 1]], [[0.5, 0], [0.5, 1], [0, 1]]])  # corners 0 and 2 differ between faces
    faces = [[3, *face, 6, *uv.reshape(-1)] for face, uv in zip(SQUARE_FACES, own, strict=True)]
    text = ascii_ply(
        SQUARE, faces, comment="comment TextureFile skin.png\n", face_extra="property list uchar float texcoord\n"
    )
    (tmp_path / "seam.ply").write_text(text)
    mesh = read_mesh(tmp_path / "seam.ply")
    np.testing.assert_array_equal(mesh.vertices[:4], SQUARE)
    assert len(mesh.vertices) == 6
    np.testing.assert_array_equal(mesh.vertices[mesh.faces], SQUARE[SQUARE_FACES])
    np.testing.assert_array_equal(mesh.uv[mesh.faces], own)


def test_seam_of_an_obj_keeps_both_texture_coordinates(tmp_path):
    path = obj_with_mtl(tmp_path)
    lines = path.read_text().replace("f 1/1 3/3 4/4", "vt 0.5 0.4\nvt 0.3 0.2\nf 1/5 3/6 4/4").splitlines()
    path.write_text("\n".join(lines))
    mesh = read_mesh(path)
    expected = np.array([UV[[0, 1, 2]], [[0.5, 0.4], [0.3, 0.2], UV[3]]])
    corners = np.concatenate([mesh.vertices[mesh.faces], mesh.uv[mesh.faces]], axis=-1)
    wanted = np.concatenate([SQUARE[SQUARE_FACES], expected], axis=-1)
    assert {tuple(row) for row in corners.reshape(-1, 5)} == {tuple(row) for row in wanted.reshape(-1, 5)}


def test_digest_depends_on_contents_not_locations(tmp_path):
    first, second = tmp_path / "first", tmp_path / "second"
    for folder in (first, second):
        folder.mkdir()
        obj_with_mtl(folder)
    assert read_mesh(first / "c.obj").digest == read_mesh(second / "c.obj").digest
    Image.new("RGB", (8, 8)).save(second / "skin.png")
    assert read_mesh(first / "c.obj").digest != read_mesh(second / "c.obj").digest
    obj_with_mtl(second)
    (second / "c.mtl").write_text("newmtl skin\nKd 1 1 1\nmap_Kd skin.png\n# edited\n")
    assert read_mesh(first / "c.obj").digest != read_mesh(second / "c.obj").digest


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".glb", ".stl"])
def test_mesh_digest_equals_that_of_the_mesh_read(suffix, tmp_path):
    path = tmp_path / f"a{suffix}"
    trimesh.Trimesh(SQUARE, SQUARE_FACES, process=False).export(path)
    assert identify_mesh(path).digest == read_mesh(path).digest


def test_digest_of_a_ply_includes_its_texture_without_parsing(tmp_path, monkeypatch):
    path = ply_with_vertex_uv(tmp_path)
    whole = read_mesh(path).digest
    monkeypatch.setattr("pipeline.io.meshes.read_mesh", None)
    assert identify_mesh(path).digest == whole
    Image.new("RGB", (8, 8)).save(tmp_path / "skin.png")
    assert identify_mesh(path).digest != whole
    (tmp_path / "skin.png").unlink()
    with pytest.raises(BadInput, match=r"skin\.png.*no such file"):
        identify_mesh(path)


def test_binary_ply_round_trip(tmp_path):
    rng = np.random.default_rng(0)
    vertices = rng.normal(size=(50, 3)).astype(np.float32).astype(float) * 64
    mesh = Mesh(vertices, rng.integers(0, 50, (80, 3)), colours=rng.integers(0, 256, (50, 3)).astype(np.uint8))
    write_ply(tmp_path / "m.ply", mesh)
    back = read_mesh(tmp_path / "m.ply")
    for name in ("vertices", "faces", "colours"):
        np.testing.assert_array_equal(getattr(back, name), getattr(mesh, name))
    assert back.texture is None
    assert len(back.digest) == 64


def test_quads_and_triangles_may_mix(tmp_path):
    vertices = np.concatenate([SQUARE, SQUARE + UP])
    (tmp_path / "mixed.ply").write_text(ascii_ply(vertices, [[4, 0, 1, 2, 3], [3, 4, 5, 6], [3, 4, 6, 7]]))
    mesh = read_mesh(tmp_path / "mixed.ply")
    assert len(mesh.faces) == 4
    areas = np.linalg.norm(
        np.cross(*(mesh.vertices[mesh.faces][:, k] - mesh.vertices[mesh.faces][:, 0] for k in (1, 2))), axis=-1
    )
    assert areas.sum() / 2 == 200


def test_face_colours_stay_sharp(tmp_path):
    extra = "property uchar red\nproperty uchar green\nproperty uchar blue\n"
    (tmp_path / "f.ply").write_text(
        ascii_ply(SQUARE, [[3, 0, 1, 2, 255, 0, 0], [3, 0, 2, 3, 0, 0, 255]], face_extra=extra)
    )
    mesh = read_mesh(tmp_path / "f.ply")
    np.testing.assert_array_equal(mesh.vertices[:4], SQUARE)
    np.testing.assert_array_equal(mesh.colours[mesh.faces], [[[255, 0, 0]] * 3, [[0, 0, 255]] * 3])


def test_a_plain_mesh_has_no_colours(tmp_path):
    (tmp_path / "plain.ply").write_text(ascii_ply(SQUARE, [[3, *face] for face in SQUARE_FACES]))
    mesh = read_mesh(tmp_path / "plain.ply")
    assert mesh.colours is None
    assert mesh.texture is None


def test_two_textures_share_an_atlas_with_repeats_written_out(tmp_path):
    write_texture(tmp_path)
    Image.new("RGB", (5, 3), (200, 100, 50)).save(tmp_path / "other.png")
    (tmp_path / "m.mtl").write_text("newmtl a\nmap_Kd skin.png\nnewmtl b\nmap_Kd other.png\nnewmtl c\nKd 0.2 0.4 0.6\n")
    lines = ["mtllib m.mtl"]
    for k, (material, shift) in enumerate((("a", 2.0), ("b", 0.0), ("c", 0.0))):
        lines += [f"v {x} {y} {z + 5 * k}" for x, y, z in SQUARE]
        lines += [f"vt {u + shift if n != 1 else u + shift + 1} {v}" for n, (u, v) in enumerate(UV)]
        lines += [f"usemtl {material}"]
        lines += ["f " + " ".join(f"{4 * k + i + 1}/{4 * k + i + 1}" for i in face) for face in SQUARE_FACES]
    (tmp_path / "m.obj").write_text("\n".join(lines))
    mesh = read_mesh(tmp_path / "m.obj")
    assert len(mesh.faces) == 6

    def at(corner):
        rows = np.flatnonzero((mesh.vertices == corner).all(axis=1))
        return texture_colour(Mipmap.of([mesh.texture]), mesh.uv[rows], np.ones(len(rows)))

    for corner, quarter in zip(SQUARE, CORNER_QUARTER, strict=True):
        for layer, colour in enumerate((QUARTERS[quarter], (200, 100, 50), (51, 102, 153))):
            seen = at(corner + layer * UP)
            # texel centres are off by 1e-15, far below one 8-bit step
            np.testing.assert_allclose(seen, np.tile(colour, (len(seen), 1)), atol=1e-3)


def test_parts_of_a_scene_are_transformed(tmp_path):
    scene = trimesh.Scene()
    for k, colour in enumerate([(255, 0, 0, 255), (0, 255, 0, 255)]):
        ball = trimesh.creation.icosphere(subdivisions=1, radius=5)
        ball.visual.vertex_colors = colour
        scene.add_geometry(ball, transform=trimesh.transformations.translation_matrix([100 * k, 0, 0]))
    scene.export(tmp_path / "two.glb")
    mesh = read_mesh(tmp_path / "two.glb")
    right = mesh.vertices[:, 0] > 50
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), [110, 10, 10], atol=1e-4)  # float32 in the file
    assert (mesh.colours[right] == [0, 255, 0]).all()
    assert (mesh.colours[~right] == [255, 0, 0]).all()


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def mesh_of(vertices: np.ndarray) -> Mesh:
    """A mesh whose faces use all vertices."""
    return Mesh(vertices, np.resize(np.arange(len(vertices)), (-(-len(vertices) // 3), 3)))


@pytest.mark.parametrize("points", ["cloud", "sphere", "flat", "line", "ring", "half ball", "constant width", "two"])
def test_diameter_equals_the_largest_pairwise_distance(points):
    rng = np.random.default_rng(1)
    cloud = rng.normal(size=(3000, 3)) * [3, 1, 0.5] + 1000
    ball = unit(rng.normal(size=(3000, 3)))
    tetrahedron = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / 8**0.5
    along = ball @ tetrahedron.T
    vertices = {
        "cloud": cloud,
        "sphere": ball * 50 + 7,
        "flat": cloud * [1, 1, 0],
        "line": cloud * [1, 0, 0],
        "ring": unit(ball * [1, 1, 0]) * 30,
        "half ball": np.abs(ball),
        # where balls about a tetrahedron's corners meet: nearly all points have a partner at nearly the diameter
        "constant width": ball * np.min(along + (along**2 + 1 - 3 / 8) ** 0.5, axis=1)[:, None],
        "two": cloud[:2],
    }[points]
    brute = cdist(vertices, vertices).max()
    # different order of summation
    assert diameter_mm(mesh_of(vertices)) == pytest.approx(brute, rel=1e-13)


@pytest.mark.parametrize("shape", ["cylinder", "ball", "both"])
def test_diameter_of_a_fine_round_mesh_is_exact_within_seconds(shape):
    """On these, no vertex can be ruled out by its distance from the centre alone."""
    cylinder = trimesh.creation.cylinder(radius=30, height=120, sections=20_000).vertices
    ball = trimesh.creation.uv_sphere(radius=50, count=[200, 200]).vertices
    vertices, expected = {
        "cylinder": (cylinder, 18_000**0.5),
        "ball": (ball, 100),
        "both": (np.concatenate([cylinder, ball]), 18_000**0.5),
    }[shape]
    start = time.process_time()
    assert diameter_mm(mesh_of(np.asarray(vertices))) == pytest.approx(expected, rel=1e-13)
    assert time.process_time() - start < 5


def test_a_vertex_that_no_face_uses_does_not_change_the_diameter():
    vertices = np.concatenate([SQUARE, [[5000, 0, 0]]])
    assert diameter_mm(Mesh(vertices, SQUARE_FACES)) == pytest.approx(200**0.5)


def test_real_textured_and_coloured_meshes_can_be_read(bop_mini):
    mug = read_mesh(bop_mini / "ycbv" / "models" / "obj_000014.ply")
    assert mug.texture.shape == (2048, 2048, 3)
    assert len(mug.uv) == len(mug.vertices) == 10524
    ape = read_mesh(bop_mini / "lmo" / "models" / "obj_000001.ply")
    assert len(ape.vertices) == len(ape.colours) == 5841
    published = json.loads((bop_mini / "lmo" / "models" / "models_info.json").read_text())["1"]["diameter"]
    assert diameter_mm(ape) == pytest.approx(published, rel=1e-5)  # published with six digits


TRIANGLE = [[3, 0, 1, 2]]
BROKEN = {
    "no faces": (ascii_ply(SQUARE, []), "0 elements 'face'"),
    "no vertices": (ascii_ply([], []), "0 elements 'vertex'"),
    "nan": (ascii_ply([[0, 0, 0], [1, "nan", 0], [1, 1, 0]], TRIANGLE), "vertex 1"),
    "infinite": (ascii_ply([[0, 0, 0], [1, "inf", 0], [1, 1, 0]], TRIANGLE), "vertex 1"),
    "index too high": (ascii_ply(SQUARE, [[3, 0, 1, 7]]), "vertex 7"),
    "index negative": (ascii_ply(SQUARE, [[3, 0, 1, -2]]), "vertex -2"),
    "one point": (ascii_ply(np.ones((3, 3)), TRIANGLE), "one point"),
    "fewer faces than declared": (ascii_ply(SQUARE, TRIANGLE).replace("face 1", "face 3"), "header declares"),
    "fewer vertices than declared": (ascii_ply(SQUARE, TRIANGLE).replace("vertex 4", "vertex 9"), ""),
    "no header": ("hello\n", "no ply header"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_broken_ply_is_reported_in_one_line(case, tmp_path):
    text, expected = BROKEN[case]
    (tmp_path / "broken.ply").write_text(text)
    with pytest.raises(BadInput, match=r"broken\.ply") as error:
        read_mesh(tmp_path / "broken.ply")
    assert expected in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".glb", ".gltf", ".stl", ".off"])
@pytest.mark.parametrize("content", [b"", b"\x00\xff\x13garbage" * 40])
def test_garbage_is_rejected_in_every_format(suffix, content, tmp_path, capfd):
    (tmp_path / f"bad{suffix}").write_bytes(content)
    with pytest.raises(BadInput, match="bad") as error:
        read_mesh(tmp_path / f"bad{suffix}")
    assert "\n" not in str(error.value)
    assert "Traceback" not in capfd.readouterr().err


@pytest.mark.parametrize("suffix", [".ply", ".glb", ".stl"])
def test_truncated_file_is_rejected(suffix, tmp_path):
    path = tmp_path / f"cut{suffix}"
    mesh = trimesh.creation.icosphere(subdivisions=2)
    mesh.export(path)
    whole = path.read_bytes()
    for share in (0.05, 0.3, 0.6, 0.9, 0.99):
        path.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(BadInput, match="cut"):
            read_mesh(path)


def test_missing_mesh_and_unknown_suffix_are_reported(tmp_path):
    with pytest.raises(BadInput, match=r"gone\.ply: found no such file"):
        read_mesh(tmp_path / "gone.ply")
    (tmp_path / "part.step").write_text("ISO-10303-21;")
    with pytest.raises(BadInput, match=r"suffix '\.step', needs a mesh: \.ply, \.obj"):
        read_mesh(tmp_path / "part.step")


@pytest.mark.parametrize("write", [ply_with_vertex_uv, obj_with_mtl])
def test_missing_texture_is_reported(write, tmp_path):
    path = write(tmp_path)
    (tmp_path / "skin.png").unlink()
    with pytest.raises(BadInput, match=rf"skin\.png: found no such file, needs the file named in {path.name}"):
        read_mesh(path)


@pytest.mark.parametrize("write", [ply_with_vertex_uv, obj_with_mtl])
def test_truncated_texture_is_reported(write, tmp_path):
    path = write(tmp_path)
    data = (tmp_path / "skin.png").read_bytes()
    (tmp_path / "skin.png").write_bytes(data[: len(data) // 2])
    with pytest.raises(BadInput, match=r"skin\.png: .* needs a readable texture image"):
        read_mesh(path)


def test_missing_material_file_is_reported(tmp_path):
    path = obj_with_mtl(tmp_path)
    (tmp_path / "c.mtl").unlink()
    with pytest.raises(BadInput, match=r"c\.mtl: found no such file"):
        read_mesh(path)


@pytest.mark.parametrize("name", ["../skin.png", "/etc/passwd", "..\\skin.png", "C:/skin.png", "http://host/skin.png"])
def test_files_outside_the_meshs_folder_are_never_opened(name, tmp_path):
    folder = tmp_path / "inside"
    folder.mkdir()
    write_texture(tmp_path)
    ply, obj = ply_with_vertex_uv(folder), obj_with_mtl(folder)
    ply.write_text(ply.read_text().replace("skin.png", name))
    (folder / "c.mtl").write_text(f"newmtl skin\nmap_Kd {name}\n")
    for path in (ply, obj):
        with pytest.raises(BadInput, match="needs a file in the mesh's own folder"):
            read_mesh(path)


def test_a_gltf_buffer_outside_the_folder_is_never_opened(tmp_path):
    (tmp_path / "in").mkdir()
    (tmp_path / "secret.bin").write_bytes(struct.pack("<9f", *SQUARE[:3].reshape(-1)))
    tree = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "buffers": [{"uri": "../secret.bin", "byteLength": 36}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
    }
    (tmp_path / "in" / "a.gltf").write_text(json.dumps(tree))
    with pytest.raises(BadInput, match=r"reference to '\.\./secret\.bin'"):
        read_mesh(tmp_path / "in" / "a.gltf")
