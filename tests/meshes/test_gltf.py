import base64
import json

import numpy as np
import pytest
from mesh_files import (
    CORNER_COLOURS,
    SQUARE,
    SQUARE_FACES,
    UV,
    Gltf,
    area,
    assert_corner_colours,
    flipped,
    normals,
    texture,
)
from mesh_files import png as to_png
from PIL import Image

from pipeline.errors import BadInput
from pipeline.io.meshes import read_mesh


@pytest.fixture
def path(tmp_path):
    return tmp_path / "a.glb"


def test_texture_and_positions_arrive(path):
    gltf = Gltf()
    gltf.square()
    mesh = read_mesh(gltf.write(path))
    np.testing.assert_array_equal(mesh.vertices, SQUARE)
    assert_corner_colours(mesh, CORNER_COLOURS)
    assert mesh.warnings == ()


@pytest.mark.parametrize("dtype", [np.int8, np.uint8, np.int16, np.uint16])
@pytest.mark.parametrize("normalized", [True, False])
def test_quantised_positions_are_decoded(dtype, normalized, path):
    """KHR_mesh_quantization: integers, normalized or not, and a node that scales them back."""
    gltf, top = Gltf(), np.iinfo(dtype).max if normalized else 100
    stored = np.rint(SQUARE / 10 * top).astype(dtype)
    gltf.primitive({"POSITION": gltf.positions(stored, normalized=normalized)})
    gltf.document["nodes"][0]["scale"] = [10 if normalized else 0.1] * 3
    gltf.document["extensionsRequired"] = ["KHR_mesh_quantization"]
    np.testing.assert_allclose(read_mesh(gltf.write(path)).vertices, SQUARE, atol=1e-6)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_quantised_texture_coordinates_are_decoded(dtype, path):
    gltf = Gltf()
    uv = np.rint(flipped(UV) * np.iinfo(dtype).max).astype(dtype)
    attributes = {
        "POSITION": gltf.positions(SQUARE.astype(np.float32)),
        "TEXCOORD_0": gltf.accessor(uv, normalized=True),
    }
    gltf.primitive(attributes, material=gltf.material(texture()))
    assert_corner_colours(read_mesh(gltf.write(path)), CORNER_COLOURS)


def test_second_set_of_texture_coordinates_is_used(path):
    gltf = Gltf()
    attributes = {
        "POSITION": gltf.positions(SQUARE.astype(np.float32)),
        "TEXCOORD_0": gltf.accessor(flipped(UV) * 0),
        "TEXCOORD_1": gltf.accessor(flipped(UV)),
    }
    gltf.primitive(attributes, material=gltf.material(texture(), {"texCoord": 1}))
    assert_corner_colours(read_mesh(gltf.write(path)), CORNER_COLOURS)


TRANSFORMS = {
    "offset and scale": ({"offset": [0.5, 0.25], "scale": [0.5, 0.5]}, np.array([[0.5, 0], [0, 0.5]]), [0.5, 0.25]),
    "a quarter turn": ({"rotation": np.pi / 2, "offset": [0, 1]}, np.array([[0, 1], [-1, 0]]), [0, 1]),
    "all": (
        {"rotation": -np.pi / 2, "scale": [0.5, 1], "offset": [1, 0.25]},
        np.array([[0, -1], [0.5, 0]]),
        [1, 0.25],
    ),
    "another set": ({"texCoord": 1}, np.eye(2), [0, 0]),
}


@pytest.mark.parametrize("name", TRANSFORMS)
def test_texture_transform_is_applied(name, path):
    """Stored coordinates are those that the transform takes to the right place."""
    stated, matrix, offset = TRANSFORMS[name]
    gltf = Gltf()
    stored = (np.linalg.inv(matrix) @ (flipped(UV) - offset).T).T.astype(np.float32)
    attributes = {
        "POSITION": gltf.positions(SQUARE.astype(np.float32)),
        f"TEXCOORD_{stated.get('texCoord', 0)}": gltf.accessor(stored),
    }
    info = {"extensions": {"KHR_texture_transform": stated}}
    gltf.primitive(attributes, material=gltf.material(texture(), info))
    gltf.document["extensionsRequired"] = ["KHR_texture_transform"]
    assert_corner_colours(read_mesh(gltf.write(path)), CORNER_COLOURS)


HALF_TURN = float(np.pi / 2)
WORKED = {  # stated transform, stored (u, v), where the texture is looked up; v downwards, worked out by hand
    # the specification's first example: the lower left quarter of the image, rotated clockwise by 90 degrees
    "upper left": ({"offset": [0, 1], "rotation": HALF_TURN, "scale": [0.5, 0.5]}, (0, 0), (0, 1)),
    "upper right": ({"offset": [0, 1], "rotation": HALF_TURN, "scale": [0.5, 0.5]}, (1, 0), (0, 0.5)),
    "lower right": ({"offset": [0, 1], "rotation": HALF_TURN, "scale": [0.5, 0.5]}, (1, 1), (0.5, 0.5)),
    "lower left": ({"offset": [0, 1], "rotation": HALF_TURN, "scale": [0.5, 0.5]}, (0, 1), (0.5, 1)),
    # its second example turns the vertical axis over
    "flip": ({"offset": [0, 1], "scale": [1, -1]}, (0.25, 0.75), (0.25, 0.25)),
    # translation * rotation * scale: (0.3, 0.4) is scaled to (0.6, 0.2), turned to (0.2, -0.6), moved
    "order": ({"offset": [0.1, 0.2], "rotation": HALF_TURN, "scale": [2, 0.5]}, (0.3, 0.4), (0.3, -0.4)),
    # counter-clockwise where v points down: from the right upwards
    "sense": ({"rotation": float(np.pi / 6)}, (1, 0), (3**0.5 / 2, -0.5)),
}


@pytest.mark.parametrize("coordinate_set", [0, 1])
@pytest.mark.parametrize("name", WORKED)
def test_texture_transform_gives_the_numbers_of_its_specification(name, coordinate_set, path):
    """Khronos, KHR_texture_transform; its matrix's sign as corrected in github.com/KhronosGroup/glTF/issues/1563."""
    stated, stored, expected = WORKED[name]
    gltf = Gltf()
    attributes = {"POSITION": gltf.positions(SQUARE.astype(np.float32))}
    attributes["TEXCOORD_0"] = gltf.accessor(np.full((4, 2), 0.9, np.float32))
    attributes[f"TEXCOORD_{coordinate_set}"] = gltf.accessor(np.tile(stored, (4, 1)).astype(np.float32))
    # the extension's texCoord replaces that of the texture's reference
    override = {"texCoord": coordinate_set} if coordinate_set else {}
    info = {"texCoord": 0, "extensions": {"KHR_texture_transform": stated | override}}
    gltf.primitive(attributes, material=gltf.material(texture(), info))
    u, v = read_mesh(gltf.write(path)).uv.T
    np.testing.assert_allclose(np.stack([u, 1 - v], axis=-1), np.tile(expected, (4, 1)), atol=1e-6)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("with_material", [True, False])
@pytest.mark.parametrize("width", [3, 4])
def test_vertex_colours_arrive_with_and_without_a_material(dtype, with_material, width, path):
    gltf = Gltf()
    top = 1 if dtype == np.float32 else np.iinfo(dtype).max
    colours = np.pad(CORNER_COLOURS / 255, ((0, 0), (0, width - 3)), constant_values=1)
    attributes = {
        "POSITION": gltf.positions(SQUARE.astype(np.float32)),
        "COLOR_0": gltf.accessor(
            np.rint(colours * top).astype(dtype) if top > 1 else colours.astype(dtype), normalized=top > 1
        ),
    }
    more = {"material": gltf.material(baseColorFactor=[1, 0.5, 1, 1])} if with_material else {}
    gltf.primitive(attributes, **more)
    assert_corner_colours(read_mesh(gltf.write(path)), CORNER_COLOURS * ([1, 0.5, 1] if with_material else 1))


def test_material_colour_and_factor_of_a_texture_arrive(path):
    gltf = Gltf()
    position = {"POSITION": gltf.positions(SQUARE.astype(np.float32))}
    gltf.primitive(position, material=gltf.material(baseColorFactor=[0.2, 0.4, 0.6, 1]))
    np.testing.assert_array_equal(read_mesh(gltf.write(path)).colours, np.tile([51, 102, 153], (4, 1)))
    gltf = Gltf()
    attributes = {"POSITION": gltf.positions(SQUARE.astype(np.float32)), "TEXCOORD_0": gltf.accessor(flipped(UV))}
    gltf.primitive(attributes, material=gltf.material(texture(), baseColorFactor=[0.5, 1, 0.2, 1]))
    assert_corner_colours(read_mesh(gltf.write(path)), CORNER_COLOURS * [0.5, 1, 0.2])


def test_diffuse_texture_of_the_old_glossiness_material_arrives(path):
    gltf = Gltf()
    gltf.square()
    material = gltf.document["materials"][0]
    info = material.pop("pbrMetallicRoughness")["baseColorTexture"]
    material["extensions"] = {"KHR_materials_pbrSpecularGlossiness": {"diffuseTexture": info}}
    gltf.document["extensionsRequired"] = ["KHR_materials_pbrSpecularGlossiness"]
    assert_corner_colours(read_mesh(gltf.write(path)), CORNER_COLOURS)


def test_webp_texture_is_preferred_to_its_fallback(path):
    gltf = Gltf()
    gltf.square()
    gltf.document["images"].append({"bufferView": gltf.view(to_png(Image.new("RGB", (2, 2), (1, 2, 3))))})
    gltf.document["textures"][0]["extensions"] = {"EXT_texture_webp": {"source": 1}}
    assert_corner_colours(read_mesh(gltf.write(path)), np.tile([1, 2, 3], (4, 1)))


def test_mirrored_repeats_of_a_texture_are_mirrored(path):
    gltf = Gltf()
    attributes = {
        "POSITION": gltf.positions(SQUARE.astype(np.float32)),
        "TEXCOORD_0": gltf.accessor((flipped(UV) * [-1, 1] + [2, 0]).astype(np.float32)),  # the second tile, reversed
    }
    gltf.primitive(attributes, material=gltf.material(texture()))
    gltf.document["samplers"] = [{"wrapS": 33648, "wrapT": 33071}]
    gltf.document["textures"][0]["sampler"] = 0
    assert_corner_colours(read_mesh(gltf.write(path)), CORNER_COLOURS)


def test_texture_coordinates_beyond_a_clamped_texture_are_named(path):
    gltf = Gltf()
    attributes = {"POSITION": gltf.positions(SQUARE.astype(np.float32)), "TEXCOORD_0": gltf.accessor(flipped(UV) * 2)}
    gltf.primitive(attributes, material=gltf.material(texture()))
    gltf.document["samplers"] = [{"wrapS": 33071, "wrapT": 33071}]
    gltf.document["textures"][0]["sampler"] = 0
    (warning,) = read_mesh(gltf.write(path)).warnings
    assert "CLAMP_TO_EDGE" in warning


@pytest.mark.parametrize("mirror", [[-1, 1, 1], [1, -1, 1], [-1, -1, -1], [1, 1, 1]])
def test_mirrored_node_keeps_the_outside(mirror, path):
    gltf = Gltf()
    box = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float32)
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    gltf.primitive({"POSITION": gltf.positions(box)}, faces)
    gltf.document["nodes"][0]["scale"] = mirror
    mesh = read_mesh(gltf.write(path))
    outward = (normals(mesh) * mesh.vertices[mesh.faces].mean(axis=1)).sum(-1)
    assert (outward > 0).all()


def test_transforms_of_nested_nodes_are_chained(path):
    """Each node as translation, rotation and scale, or as a matrix."""
    gltf = Gltf()
    gltf.square()
    matrix = np.eye(4)
    matrix[:3, 3] = [0, 0, 7]
    half = 0.5**0.5
    gltf.document["nodes"] = [
        {"children": [1], "translation": [100, 0, 0], "rotation": [0, 0, half, half], "scale": [2, 1, 1]},
        {"children": [2], "matrix": matrix.T.reshape(-1).tolist()},
        {"mesh": 0},
    ]
    mesh = read_mesh(gltf.write(path))
    quarter = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])  # about z
    expected = (SQUARE + np.array([0, 0, 7])) * [2, 1, 1] @ quarter.T + [100, 0, 0]
    np.testing.assert_allclose(mesh.vertices, expected, atol=1e-9)


def test_all_primitives_and_instances_arrive(path):
    """Two primitives of other materials, in two places."""
    gltf = Gltf()
    gltf.square()
    above = {"POSITION": gltf.positions((SQUARE + np.array([0, 0, 5])).astype(np.float32))}
    gltf.primitive(above, material=gltf.material(baseColorFactor=[1, 0, 0, 1]))
    gltf.document["nodes"] = [{"mesh": 0}, {"mesh": 0, "translation": [50, 0, 0]}]
    gltf.document["scenes"] = [{"nodes": [0, 1]}]
    mesh = read_mesh(gltf.write(path))
    assert len(mesh.faces) == 8
    assert area(mesh) == pytest.approx(400)
    for shift in (0, 50):
        assert_corner_colours(mesh, CORNER_COLOURS, SQUARE + np.array([shift, 0, 0]))
        assert_corner_colours(mesh, np.tile([255, 0, 0], (4, 1)), SQUARE + np.array([shift, 0, 5]))


@pytest.mark.parametrize("mode", [4, 5, 6, "not indexed", "points besides"])
def test_triangles_strips_and_fans_arrive(mode, path):
    gltf = Gltf()
    position = {"POSITION": gltf.positions(SQUARE.astype(np.float32))}
    if mode == "not indexed":
        gltf.primitive({"POSITION": gltf.positions(SQUARE[SQUARE_FACES.reshape(-1)].astype(np.float32))}, None)
    elif mode == "points besides":
        gltf.primitive(position)
        gltf.primitive(position, mode=0)
    else:
        order = {4: SQUARE_FACES, 5: [0, 1, 3, 2], 6: [0, 1, 2, 3]}[mode]
        gltf.primitive(position, order, mode=mode)
    mesh = read_mesh(gltf.write(path))
    assert area(mesh) == pytest.approx(100)
    assert (normals(mesh)[:, 2] > 0).all()


def test_sparse_accessors_replace_some_rows(path):
    gltf = Gltf()
    moved = np.array([[10, 10, 4]], dtype=np.float32)
    index = gltf.accessor(SQUARE.astype(np.float32))
    gltf.document["accessors"][index]["sparse"] = {
        "count": 1,
        "indices": {"bufferView": gltf.view(np.array([2], np.uint16).tobytes()), "componentType": 5123},
        "values": {"bufferView": gltf.view(moved.tobytes())},
    }
    gltf.primitive({"POSITION": index})
    np.testing.assert_array_equal(read_mesh(gltf.write(path)).vertices[2], moved[0])


def test_buffers_and_images_may_be_files_or_data_uris(tmp_path):
    gltf = Gltf()
    gltf.square()
    gltf.write(tmp_path / "a.glb")
    image = gltf.document["images"][0]
    view = gltf.document["bufferViews"][image.pop("bufferView")]
    data = gltf.blob[view["byteOffset"] :][: view["byteLength"]]
    for name, uri in (("b", "a%20b.png"), ("c", "data:image/png;base64," + base64.b64encode(data).decode())):
        (tmp_path / "a b.png").write_bytes(data)
        (tmp_path / "a.bin").write_bytes(gltf.blob)
        gltf.document["buffers"] = [{"byteLength": len(gltf.blob), "uri": "a.bin"}]
        gltf.document["images"] = [{"uri": uri}]
        (tmp_path / f"{name}.gltf").write_text(json.dumps(gltf.document))
        assert_corner_colours(read_mesh(tmp_path / f"{name}.gltf"), CORNER_COLOURS)


REFUSED = {
    "meshopt": (["EXT_meshopt_compression"], "EXT_meshopt_compression"),
    "basisu": (["KHR_texture_basisu"], "KHR_texture_basisu"),
    "unknown": (["ACME_curved_space"], "ACME_curved_space"),
    "instancing": (["EXT_mesh_gpu_instancing"], "EXT_mesh_gpu_instancing"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_required_extension_that_is_not_read_is_refused_by_name(case, path):
    gltf = Gltf()
    gltf.square()
    gltf.document["extensionsRequired"], name = REFUSED[case]
    with pytest.raises(BadInput, match=rf"a\.glb: found the required extension {name}, needs a file without it"):
        read_mesh(gltf.write(path))


def test_harmless_required_extension_is_read(path):
    gltf = Gltf()
    gltf.square()
    gltf.document["extensionsRequired"] = ["KHR_materials_unlit", "KHR_lights_punctual"]
    assert_corner_colours(read_mesh(gltf.write(path)), CORNER_COLOURS)


def used_meshopt(gltf):
    gltf.document["bufferViews"][0]["extensions"] = {"EXT_meshopt_compression": {"buffer": 0}}


def used_basisu(gltf):
    gltf.document["textures"][0] = {"extensions": {"KHR_texture_basisu": {"source": 0}}}


def used_instancing(gltf):
    gltf.document["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": {}}}


def ktx_image(gltf):
    image = gltf.document["images"][0]
    image["bufferView"] = gltf.view(b"\xabKTX 20\xbb\r\n\x1a\n" + b"\0" * 60)


@pytest.mark.parametrize(
    ("use", "name"),
    [
        (used_meshopt, "EXT_meshopt_compression"),
        (used_basisu, "KHR_texture_basisu"),
        (used_instancing, "EXT_mesh_gpu_instancing"),
        (ktx_image, "KTX2"),
    ],
)
def test_extension_that_is_used_without_being_required_is_refused_by_name(use, name, path):
    gltf = Gltf()
    gltf.square()
    use(gltf)
    with pytest.raises(BadInput, match=name):
        read_mesh(gltf.write(path))


def test_positions_outside_the_stated_bounds_are_refused(path):
    """What a compressor leaves when a reader misses its extension."""
    gltf = Gltf()
    gltf.square()
    gltf.document["accessors"][0]["max"] = [0.01, 0.01, 0]
    with pytest.raises(BadInput, match=r"vertices from \(0, 0, 0\) to \(10, 10, 0\), needs those from"):
        read_mesh(gltf.write(path))


def skin(gltf):
    gltf.document["nodes"][0]["skin"] = 0


def morph(gltf):
    gltf.document["meshes"][0]["weights"] = [0.5]


def vertex_colours_on_texture(gltf):
    colours = gltf.accessor(CORNER_COLOURS.astype(np.uint8), normalized=True)
    gltf.document["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"] = colours


def no_coordinates(gltf):
    del gltf.document["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"]


def glowing(gltf):
    base = gltf.document["materials"][0].pop("pbrMetallicRoughness")
    gltf.document["materials"][0]["emissiveTexture"] = base["baseColorTexture"]


@pytest.mark.parametrize(
    ("edit", "word"),
    [
        (skin, "skeleton"),
        (morph, "morph"),
        (vertex_colours_on_texture, "COLOR_0"),
        (no_coordinates, "TEXCOORD_0"),
        (glowing, "emissiveTexture"),
    ],
)
def test_what_is_stated_but_not_shown_is_a_warning(edit, word, path):
    gltf = Gltf()
    gltf.square()
    edit(gltf)
    (warning,) = read_mesh(gltf.write(path)).warnings
    assert word in warning


def draco_square(gltf, encoded, attributes):
    """Positions and indices without buffers, as Draco leaves them."""
    draco_view = gltf.view(encoded)
    gltf.square()
    document = gltf.document
    primitive = document["meshes"][0]["primitives"][0]
    for index in (*primitive["attributes"].values(), primitive["indices"]):
        del document["accessors"][index]["bufferView"]
    extension = {"bufferView": draco_view, "attributes": attributes}
    primitive["extensions"] = {"KHR_draco_mesh_compression": extension}
    document["extensionsRequired"] = ["KHR_draco_mesh_compression"]


def test_draco_is_decoded(path):
    draco = pytest.importorskip("DracoPy")
    encoded = draco.encode(
        SQUARE, SQUARE_FACES, tex_coord=flipped(UV).astype(float), preserve_order=True, quantization_bits=14
    )
    ids = {int(a["attribute_type"]): a["unique_id"] for a in draco.decode(encoded).attributes}
    kinds = draco.AttributeType
    gltf = Gltf()
    draco_square(gltf, encoded, {"POSITION": ids[int(kinds.POSITION)], "TEXCOORD_0": ids[int(kinds.TEX_COORD)]})
    mesh = read_mesh(gltf.write(path))
    np.testing.assert_allclose(mesh.vertices, SQUARE, atol=10 / 2**13)  # half a step of 14 bits
    assert_corner_colours(mesh, CORNER_COLOURS)
    assert area(mesh) == pytest.approx(100, rel=1e-3)


def test_broken_or_missing_draco_is_named(path, monkeypatch):
    pytest.importorskip("DracoPy")
    gltf = Gltf()
    draco_square(gltf, b"DRACO" + b"\0" * 40, {"POSITION": 0})
    with pytest.raises(BadInput, match=r"a\.glb: found Draco data that cannot be decoded"):
        read_mesh(gltf.write(path))
    monkeypatch.setitem(__import__("sys").modules, "DracoPy", None)
    with pytest.raises(BadInput, match=r"a mesh compressed by Draco .* needs pip install --editable '\.\[draco\]'"):
        read_mesh(path)
