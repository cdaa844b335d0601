"""Untrusted mesh files and the files that they reference."""

import base64
import json
import os
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hostile import fuzz_settings, message_within, outcome, run_within
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from pipeline.errors import BadInput
from pipeline.io.meshes import SUFFIXES, read_mesh

MILLIONS = 50_000_000
PLY = "ply\nformat {} 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n"
PLY += "element face {}\nproperty list uchar int vertex_indices\nend_header\n"
SQUARE = [(0, 0, 0), (10, 0, 0), (10, 10, 0), (0, 10, 0)]


def make_mesh_files(folder: Path) -> dict[str, bytes]:
    """A small mesh in every format, and a textured obj."""
    box, made = trimesh.creation.box((10, 20, 30)), {}
    for suffix in SUFFIXES:
        path = folder / f"box{suffix}"
        if suffix == ".gltf":
            for name, data in trimesh.exchange.gltf.export_gltf(box, embed_buffers=True).items():
                path.write_bytes(data) if name == "model.gltf" else (folder / name).write_bytes(data)
        else:
            box.export(path)
        made[suffix] = path.read_bytes()
    ascii_ply = PLY.format("ascii", 4, 2) + "\n".join(" ".join(map(str, v)) for v in SQUARE) + "\n3 0 1 2\n3 0 2 3\n"
    return made | {" ascii.ply": ascii_ply.encode(), " textured.obj": textured_obj(folder).encode()}


def textured_obj(folder: Path, *, texture: str = "skin.png", material: str = "c.mtl") -> str:
    Image.new("RGB", (4, 4), (200, 30, 30)).save(folder / "skin.png")
    (folder / "c.mtl").write_text(f"newmtl skin\nKd 1 1 1\nmap_Kd {texture}\n")
    lines = [f"mtllib {material}", "usemtl skin", *(f"v {x} {y} {z}" for x, y, z in SQUARE)]
    return "\n".join([*lines, "vt 0 0", "vt 1 0", "vt 1 1", "f 1/1 2/2 3/3", "f 1/1 3/3 4/2"])


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("meshes")


@pytest.fixture(scope="module")
def whole(folder: Path) -> dict[str, bytes]:
    return make_mesh_files(folder)


NUMBERS = ["-1", "0", "3", "255", "4294967295", "99999999999999999999", "1e400", "nan", "-inf", "", "\0", "²", "é"]


@fuzz_settings(120)
@given(data=st.data())
def test_mesh_is_read_or_rejected_in_one_line(folder: Path, whole, data):
    name = data.draw(st.sampled_from(sorted(whole)))
    content = bytearray(whole[name])
    for _ in range(data.draw(st.integers(0, 4))):
        at = data.draw(st.integers(0, max(0, len(content) - 1)))
        what = data.draw(st.sampled_from(["flip", "cut", "number", "repeat"]))
        if what == "flip" and content:
            content[at] = data.draw(st.integers(0, 255))
        elif what == "cut":
            del content[at : at + data.draw(st.integers(1, 40))]
        elif what == "number":
            content[at : at + data.draw(st.integers(0, 3))] = data.draw(st.sampled_from(NUMBERS)).encode()
        else:
            content[at:at] = content[at : at + data.draw(st.integers(1, 200))]
    path = folder / f"fuzz_settings{name.strip() if name.startswith('.') else '.' + name.split('.')[-1]}"
    path.write_bytes(content)
    outcome(lambda: read_mesh(path))


def gltf(count: int, *, sparse: bool = False, **more) -> bytes:
    accessor = {"componentType": 5126, "count": count, "type": "VEC3"}
    if sparse:
        accessor["sparse"] = {
            "count": 1,
            "indices": {"bufferView": 0, "componentType": 5125},
            "values": {"bufferView": 0},
        }
    else:
        accessor["bufferView"] = 0
    tree = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "buffers": [{"uri": "data:application/octet-stream;base64,AAAAAAAAAAAAAAAA", "byteLength": 12}],
        "bufferViews": [{"buffer": 0, "byteLength": 12}],
        "accessors": [accessor],
    }
    return json.dumps(tree | more).encode()


def glb(document: bytes, chunk: int | None = None) -> bytes:
    document += b" " * (-len(document) % 4)
    length = len(document) if chunk is None else chunk
    return struct.pack("<4sIIII", b"glTF", 2, 20 + length, length, 0x4E4F534A) + document


TRIANGLE = struct.pack("<9f", 0, 0, 0, 10, 0, 0, 10, 10, 0)
CLAIMS = {
    "little endian.ply": PLY.format("binary_little_endian", MILLIONS, MILLIONS).encode() + TRIANGLE,
    "faces alone.ply": PLY.format("binary_little_endian", 3, MILLIONS).encode() + TRIANGLE + b"\x03" + b"\0" * 12,
    "text.ply": PLY.format("ascii", 3, MILLIONS).encode() + b"0 0 0\n10 0 0\n10 10 0\n3 0 1 2\n",
    "endless.ply": PLY.format("ascii", 10**18, 10**18).encode() + b"0 0 0\n",
    "long list.ply": PLY.format("binary_little_endian", 3, 1).replace("uchar", "uint").encode()
    + TRIANGLE
    + struct.pack("<I", 4_000_000_000),
    "binary.stl": b"\0" * 80 + struct.pack("<I", MILLIONS) + b"\0" * 50,
    "text.off": f"OFF\n{MILLIONS} {MILLIONS} 0\n0 0 0\n".encode(),
    "accessor.gltf": gltf(MILLIONS),
    "sparse accessor.gltf": gltf(MILLIONS * 20, sparse=True),
    "no buffer.gltf": gltf(MILLIONS * 20, bufferViews=[]),
    "long buffer.gltf": gltf(MILLIONS, buffers=[{"byteLength": 1 << 40}]),
    "chunk.glb": glb(gltf(3), chunk=0xFFFFFF00),
    "deep.gltf": b'{"asset": ' + b"[" * 100_000,
    "indices.obj": b"v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 4000000000\n",
    "a node in itself.gltf": gltf(1, nodes=[{"mesh": 0, "children": [0]}]),
    "two nodes in a ring.gltf": gltf(1, nodes=[{"mesh": 0, "children": [1]}, {"children": [0]}]),
}


@pytest.mark.parametrize("name", CLAIMS)
def test_claimed_mesh_size_costs_neither_time_nor_memory(tmp_path: Path, name: str):
    path = tmp_path / name
    path.write_bytes(CLAIMS[name])
    assert name in message_within(lambda: read_mesh(path), seconds=5, megabytes=512)


def test_nested_instances_are_not_expanded(tmp_path: Path):
    """Twenty levels of ten references to the same node: 10^20 copies."""
    nodes = [{"children": [level + 1] * 10} for level in range(20)] + [{"mesh": 0}]
    points = "data:;base64,AAAAAAAAAAAAAAAAAAAgQQAAAAAAAAAAAAAgQQAAIEEAAAAA"
    stored = {"buffers": [{"uri": points, "byteLength": 36}], "bufferViews": [{"buffer": 0, "byteLength": 36}]}
    document = gltf(3, nodes=nodes, **stored)
    (tmp_path / "copies.gltf").write_bytes(document)
    run_within(lambda: read_mesh(tmp_path / "copies.gltf"), seconds=5, megabytes=512)


def test_chained_nodes_take_linear_time(tmp_path: Path):
    """3,000 nodes, each inside the one before; trimesh's scene took 104 s."""
    nodes = [{"children": [level + 1], "translation": [1, 0, 0]} for level in range(3000)] + [{"mesh": 0}]
    points = "data:;base64," + base64.b64encode(TRIANGLE).decode()
    stored = {"buffers": [{"uri": points, "byteLength": 36}], "bufferViews": [{"buffer": 0, "byteLength": 36}]}
    (tmp_path / "chain.gltf").write_bytes(gltf(3, nodes=nodes, **stored))
    assert run_within(lambda: read_mesh(tmp_path / "chain.gltf"), seconds=2, megabytes=512) == "read"


def write_large_textures(folder: Path, count: int, *, different: bool) -> Path:
    """An obj whose materials name textures of 40 megapixels in files of some kB."""
    corners = "".join(f"v {x} {y} {z}\n" for x, y, z in SQUARE)
    lines, mtl = f"mtllib a.mtl\n{corners}vt 0 0\nvt 1 0\nvt 1 1\n", ""
    for k in range(count):
        name = f"t{k if different else 0}.png"
        mtl += f"newmtl m{k}\nmap_Kd {name}\n"
        lines += f"usemtl m{k}\nf 1/1 2/2 3/3\n"
        if not (folder / name).exists():
            Image.new("RGB", (8000, 5000), (200, 30, 30)).save(folder / name)
    (folder / "a.mtl").write_text(mtl)
    (folder / "a.obj").write_text(lines)
    return folder / "a.obj"


def test_large_texture_of_many_materials_is_held_once(tmp_path: Path):
    """Eight materials with one texture of 167 kB took 13.9 GB."""
    path = write_large_textures(tmp_path, 8, different=False)
    assert run_within(lambda: read_mesh(path), seconds=5, megabytes=1024) == "read"


def test_many_large_textures_are_refused_before_they_fill_the_memory(tmp_path: Path):
    path = write_large_textures(tmp_path, 8, different=True)
    message = message_within(lambda: read_mesh(path), seconds=10, megabytes=2048)
    assert "textures of 280 megapixels in all, needs at most 268" in message


def test_factors_of_one_large_texture_are_bounded_in_memory(tmp_path: Path):
    """A glTF with sixteen materials that tint the same image differently needs sixteen images."""
    image = Image.new("RGB", (6000, 6000), (200, 30, 30))
    image.save(tmp_path / "t.png")
    points = TRIANGLE + struct.pack("<6f", 0, 0, 1, 0, 1, 1)
    accessors = [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}]
    accessors += [{"bufferView": 0, "byteOffset": 36, "componentType": 5126, "count": 3, "type": "VEC2"}]
    attributes = {"POSITION": 0, "TEXCOORD_0": 1}
    materials = [
        {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "baseColorFactor": [k / 16, 1, 1, 1]}}
        for k in range(16)
    ]
    document = gltf(
        3,
        meshes=[{"primitives": [{"attributes": attributes, "material": k} for k in range(16)]}],
        accessors=accessors,
        bufferViews=[{"buffer": 0, "byteLength": 60}],
        buffers=[{"uri": "data:;base64," + base64.b64encode(points).decode(), "byteLength": 60}],
        materials=materials,
        textures=[{"source": 0}],
        images=[{"uri": "t.png"}],
    )
    (tmp_path / "a.gltf").write_bytes(document)
    message = message_within(lambda: read_mesh(tmp_path / "a.gltf"), seconds=10, megabytes=2048)
    assert "megapixels in all" in message


def test_texture_with_a_huge_claimed_size_is_rejected(tmp_path: Path):
    path = tmp_path / "c.obj"
    path.write_text(textured_obj(tmp_path))
    data = bytearray((tmp_path / "skin.png").read_bytes())
    data[16:24] = struct.pack(">II", 200_000, 200_000)
    (tmp_path / "skin.png").write_bytes(data)
    assert "skin.png" in message_within(lambda: read_mesh(path), seconds=5, megabytes=512)


POSTSCRIPT = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n(ran) print\n%%EOF\n"


def test_postscript_texture_is_not_run(tmp_path: Path, monkeypatch):
    """Pillow would run PostScript through Ghostscript, whatever the file's suffix."""
    ran = tmp_path / "ran"
    (tmp_path / "gs").write_text(f"#!/bin/sh\ntouch {ran}\n")
    (tmp_path / "gs").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    path = tmp_path / "c.obj"
    path.write_text(textured_obj(tmp_path))
    for name in ("skin.png", "skin.eps"):
        (tmp_path / "c.mtl").write_text(f"newmtl skin\nmap_Kd {name}\n")
        (tmp_path / name).write_bytes(POSTSCRIPT)
        assert "needs a readable texture" in outcome(lambda: read_mesh(path)) or "EPS" in outcome(
            lambda: read_mesh(path)
        )
    embedded = "data:image/png;base64," + base64.b64encode(POSTSCRIPT).decode()
    box = trimesh.creation.box((1, 2, 3))
    visual = trimesh.visual.TextureVisuals(
        uv=np.zeros((len(box.vertices), 2)),
        material=trimesh.visual.material.PBRMaterial(baseColorTexture=Image.new("RGB", (2, 2))),
    )
    exported = trimesh.exchange.gltf.export_gltf(
        trimesh.Trimesh(box.vertices, box.faces, visual=visual, process=False), embed_buffers=True
    )
    tree = json.loads(exported["model.gltf"])
    tree["images"] = [{"uri": embedded}]
    (tmp_path / "d.gltf").write_text(json.dumps(tree))
    assert "d.gltf" in outcome(lambda: read_mesh(tmp_path / "d.gltf"))
    assert not ran.exists()


@pytest.fixture
def inside(tmp_path: Path) -> Path:
    (tmp_path / "inside").mkdir()
    (tmp_path / "secret.png").write_bytes(b"secret")
    return tmp_path / "inside"


def test_link_out_of_the_meshs_folder_is_not_followed(inside: Path):
    path = inside / "c.obj"
    path.write_text(textured_obj(inside))
    (inside / "skin.png").unlink()
    (inside / "skin.png").symlink_to(inside.parent / "secret.png")
    with pytest.raises(BadInput, match="needs a file in the mesh's own folder"):
        read_mesh(path)


def test_link_inside_the_meshs_folder_is_followed(inside: Path, tmp_path: Path):
    path = inside / "c.obj"
    path.write_text(textured_obj(inside))
    (inside / "skin.png").rename(inside / "other.png")
    (inside / "skin.png").symlink_to("other.png")
    (tmp_path / "link").symlink_to(inside)
    assert read_mesh(tmp_path / "link" / "c.obj").digest == read_mesh(path).digest


@pytest.mark.parametrize("name", ["skin\0.png", "a" * 5000 + ".png", ".", "pipe.png", "folder.png", "/dev/zero"])
def test_invalid_companion_name_is_rejected(inside: Path, name: str):
    os.mkfifo(inside / "pipe.png")
    (inside / "folder.png").mkdir()
    ply = PLY.replace("\nelement vertex", f"\ncomment TextureFile {name}\nelement vertex")
    text = ply.format("ascii", 4, 2) + "\n".join(" ".join(map(str, v)) for v in SQUARE) + "\n3 0 1 2\n3 0 2 3\n"
    (inside / "a.ply").write_text(text)
    (inside / "c.obj").write_text(textured_obj(inside, texture=name))
    messages = [outcome(lambda path=path: read_mesh(path)) for path in (inside / "a.ply", inside / "c.obj")]
    (inside / "c.obj").write_text(textured_obj(inside, material=name))
    messages.append(outcome(lambda: read_mesh(inside / "c.obj")))
    assert "read" not in messages
