"""obj, glTF, stl and off files: every geometry at its place in the file's scene, as one mesh."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import BadInput
from pipeline.io.files import IMAGE_FORMATS
from pipeline.io.meshes.atlas import join_meshes
from pipeline.io.meshes.checks import check_indices
from pipeline.io.meshes.companions import Companions
from pipeline.io.meshes.corners import split_face_colours
from pipeline.items.objects import Mesh

if TYPE_CHECKING:
    from trimesh import Scene, Trimesh

_MAX_FACES = 20_000_000
_MAX_UNSTORED = 1_000_000  # elements of a glTF accessor without a buffer: they take memory but no bytes in the file


def parse_scene(path: Path, data: bytes, companions: Companions) -> Mesh:
    """All geometries in the file's bytes as one mesh, in the scene's frame; not checked yet. Raises BadInput."""
    import trimesh

    if path.suffix.lower() in (".gltf", ".glb"):
        _check_accessors(path, data)
    resolver: Any = companions  # trimesh only calls get()
    scene = trimesh.load_scene(
        io.BytesIO(data),
        file_type=path.suffix.lower().removeprefix("."),
        resolver=resolver,
        process=False,  # nor maintain_order: it gives a vertex on a seam any one of its texture coordinates
    )
    parts = _place_parts(path, scene)
    if not parts:
        raise BadInput(path, found="0 faces", needed="a mesh with vertices and faces")
    return parts[0] if len(parts) == 1 else join_meshes(path, parts)


def _place_parts(path: Path, scene: Scene) -> list[Mesh]:
    """The triangle meshes of all nodes, transformed to the scene's frame."""
    import trimesh

    nodes = scene.graph.nodes_geometry
    faces = sum(len(getattr(scene.geometry[scene.graph[node][1]], "faces", ())) for node in nodes)
    if faces > _MAX_FACES:
        raise BadInput(path, found=f"{faces} faces, instances included", needed=f"at most {_MAX_FACES}")
    parts = []
    for node in nodes:
        T_scene_part, name = scene.graph[node]
        geometry = scene.geometry[name]
        if isinstance(geometry, trimesh.Trimesh) and len(geometry.faces):
            part = _convert(path, geometry)
            parts.append(replace(part, vertices=part.vertices @ T_scene_part[:3, :3].T + T_scene_part[:3, 3]))
    return parts


def _check_accessors(path: Path, data: bytes) -> None:
    """Raise BadInput for a glTF accessor without a buffer that would allocate too much memory."""
    text = data[20 : 20 + int.from_bytes(data[12:16], "little")] if data[:4] == b"glTF" else data
    for accessor in json.loads(text).get("accessors", []):
        if "bufferView" not in accessor and accessor["count"] > _MAX_UNSTORED:
            found = f"an accessor of {accessor['count']} elements without a buffer"
            raise BadInput(path, found=found, needed=f"at most {_MAX_UNSTORED}")


def _convert(path: Path, geometry: Trimesh) -> Mesh:
    """One geometry with its texture, or else its colours, or else its material's colour, or else none."""
    mesh = Mesh(np.asarray(geometry.vertices, dtype=float), np.asarray(geometry.faces, dtype=np.int64))
    check_indices(path, mesh)
    visual: Any = geometry.visual
    if visual.kind == "vertex":
        return replace(mesh, colours=np.asarray(visual.vertex_colors[:, :3], dtype=np.uint8))
    if visual.kind == "face":
        return split_face_colours(mesh, np.asarray(visual.face_colors[:, :3], dtype=np.uint8))
    if visual.kind != "texture":
        return mesh
    material = visual.material
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if image is not None and visual.uv is not None:
        if image.format not in (None, "MPO", *IMAGE_FORMATS):  # None: made by trimesh; MPO: a kind of JPEG
            raise BadInput(path, found=f"a texture in {image.format}", needed=f"one of {', '.join(IMAGE_FORMATS)}")
        texture = np.asarray(image.convert("RGB"))
        factor = getattr(material, "baseColorFactor", None)
        if factor is not None:
            texture = np.rint(texture * (np.asarray(factor[:3]) / 255)).astype(np.uint8)
        return replace(mesh, uv=np.asarray(visual.uv, dtype=float), texture=texture)
    colour = np.asarray(material.main_color[:3], dtype=np.uint8)
    return replace(mesh, colours=np.tile(colour, (len(mesh.vertices), 1)))
