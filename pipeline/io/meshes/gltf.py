"""glTF and glb files: all primitives, transformed by their nodes, as one mesh.

Colours are taken as sRGB: the format prescribes linear factors and vertex colours, but few exporters comply.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Integer

from pipeline.errors import BadInput
from pipeline.io.meshes.atlas import join_meshes
from pipeline.io.meshes.checks import check_bounds, check_count, check_indices
from pipeline.io.meshes.colours import unit_to_uint8
from pipeline.io.meshes.companions import Companions
from pipeline.io.meshes.gltf_file import REMEDY, GltfFile, normalize
from pipeline.io.meshes.gltf_material import Surface, Textures, read_surface
from pipeline.items.objects import Mesh

_TRIANGLES, _STRIP, _FAN = 4, 5, 6  # WebGL constants; 0 to 3 are points and lines
_DRACO = "KHR_draco_mesh_compression"
_MAX_FACES = 20_000_000
_WHITE = (1.0, 1.0, 1.0)


def parse_gltf(path: Path, data: bytes, companions: Companions) -> Mesh:
    """All primitives of the file's scene as one mesh, in the scene's frame; not checked yet. Raises BadInput."""
    gltf = GltfFile(path, data, companions)
    reader, parts, faces = _Primitives(gltf, Textures(gltf, companions)), [], 0
    for index, T_scene_node, notes in _walk_nodes(gltf):
        for part in reader.read(index):
            faces += len(part.faces)
            if faces > _MAX_FACES:
                raise BadInput(path, found=f"over {_MAX_FACES} faces, instances included", needed="fewer")
            parts.append(_place(part, T_scene_node, notes))
    if not parts:
        raise BadInput(path, found="0 faces", needed="a mesh with vertices and faces")
    return join_meshes(path, parts)


def _walk_nodes(gltf: GltfFile) -> Iterator[tuple[int, Float[np.ndarray, "4 4"], tuple[str, ...]]]:
    """Index of the mesh, transform to the scene and warnings of each node that has a mesh, parents first."""
    nodes, scenes = gltf.list("nodes"), gltf.list("scenes")
    roots = scenes[gltf.document.get("scene", 0)].get("nodes", []) if scenes else _find_roots(nodes)
    todo, seen = [(index, np.eye(4)) for index in reversed(roots)], set()
    while todo:
        index, T_scene_parent = todo.pop()
        if index in seen:
            raise BadInput(gltf.path, found=f"node {index} in two places of the scene", needed="nodes that form a tree")
        seen.add(index)
        node = nodes[index]
        T_scene_node = T_scene_parent @ _node_transform(node)
        todo += [(child, T_scene_node) for child in reversed(node.get("children", []))]
        if "mesh" in node:
            yield node["mesh"], T_scene_node, _check_node(gltf, node)


def _find_roots(nodes: list[dict[str, Any]]) -> list[int]:
    children = {child for node in nodes for child in node.get("children", [])}
    return [index for index in range(len(nodes)) if index not in children]


def _check_node(gltf: GltfFile, node: dict[str, Any]) -> tuple[str, ...]:
    """Warnings about extensions, skins and morph targets, which would move vertices but are not applied."""
    for name in node.get("extensions", {}):
        if "instancing" in name:
            raise BadInput(gltf.path, found=f"copies of a mesh by {name}", needed=REMEDY)
    weights = node.get("weights", gltf.list("meshes")[node["mesh"]].get("weights", []))
    notes = ["it has a skeleton (skin); its vertices are taken as stored, without a pose"] if "skin" in node else []
    return tuple(notes + (["its morph targets are ignored"] if any(weights) else []))


def _node_transform(node: dict[str, Any]) -> Float[np.ndarray, "4 4"]:
    if "matrix" in node:
        return np.array(node["matrix"], dtype=float).reshape(4, 4).T
    T = np.eye(4)
    x, y, z, w = (float(value) for value in node.get("rotation", (0, 0, 0, 1)))
    norm = x * x + y * y + z * z + w * w
    if norm > 0:
        outer = np.array([[x * x, x * y, x * z], [x * y, y * y, y * z], [x * z, y * z, z * z]])
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        T[:3, :3] += 2 * (outer + w * cross - (x * x + y * y + z * z) * np.eye(3)) / norm
    T[:3, :3] *= np.reshape(node.get("scale", (1, 1, 1)), 3)
    T[:3, 3] = np.reshape(node.get("translation", (0, 0, 0)), 3)
    return T


def _place(part: Mesh, T: Float[np.ndarray, "4 4"], notes: tuple[str, ...]) -> Mesh:
    """The part in the scene's frame. Faces are flipped if the transform mirrors, so that the outside stays outside."""
    faces = part.faces[:, ::-1] if np.linalg.det(T[:3, :3]) < 0 else part.faces
    vertices = part.vertices if np.array_equal(T, np.eye(4)) else part.vertices @ T[:3, :3].T + T[:3, 3]
    return replace(part, vertices=vertices, faces=faces, warnings=part.warnings + notes)


class _Primitives:
    """Reads the primitives of meshes, once each."""

    def __init__(self, gltf: GltfFile, textures: Textures) -> None:
        self._gltf, self._textures = gltf, textures
        self._parts: dict[int, list[Mesh]] = {}

    def read(self, index: int) -> list[Mesh]:
        """The triangles of a mesh, one part per primitive."""
        if index not in self._parts:
            primitives = self._gltf.list("meshes")[index]["primitives"]
            parts = [self._read(p) for p in primitives if p.get("mode", _TRIANGLES) >= _TRIANGLES]
            self._parts[index] = [part for part in parts if len(part.faces)]
        return self._parts[index]

    def _read(self, primitive: dict[str, Any]) -> Mesh:
        attributes = _Attributes(self._gltf, primitive)
        vertices = attributes.floats("POSITION")
        indices = attributes.indices()
        indices = np.arange(len(vertices)) if indices is None else indices
        faces = _to_triangles(indices, primitive.get("mode", _TRIANGLES))
        mesh = Mesh(np.ascontiguousarray(vertices[:, :3]), faces)
        if not len(faces):
            return mesh
        check_indices(self._gltf.path, mesh)
        if (stated := self._gltf.bounds(attributes.names["POSITION"])) is not None:
            check_bounds(self._gltf.path, mesh.vertices, stated)
        colours = attributes.floats("COLOR_0")[:, :3] if "COLOR_0" in attributes.names else None
        if colours is not None:
            check_count(self._gltf.path, "colours of vertices", len(colours), len(vertices))
        surface = read_surface(self._gltf, primitive.get("material"))
        mesh = replace(mesh, warnings=surface.warnings)
        if surface.info is not None and surface.uv_name in attributes.names:
            return self._add_texture(mesh, surface, attributes.floats(surface.uv_name), colours)
        return _add_colours(mesh, surface, colours)

    def _add_texture(
        self, mesh: Mesh, surface: Surface, uv: Float[np.ndarray, "v 2"], colours: Float[np.ndarray, "v 3"] | None
    ) -> Mesh:
        """The mesh with its texture, times the factor and, if uniform, the vertex colour."""
        check_count(self._gltf.path, "texture coordinates", len(uv), len(mesh.vertices))
        factor, notes = np.array(surface.factor or _WHITE), mesh.warnings
        if colours is not None:
            if np.ptp(colours, axis=0).max() < 1e-2:
                factor = factor * colours.mean(axis=0)
            else:
                notes += (
                    f"its texture is shown without the colours of its vertices (COLOR_0, {len(colours)} vertices)",
                )
        texture, uv, more = self._textures.make(surface, uv, tuple(factor.tolist()))
        return replace(mesh, uv=uv, texture=texture, warnings=notes + more)


def _add_colours(mesh: Mesh, surface: Surface, colours: Float[np.ndarray, "v 3"] | None) -> Mesh:
    """The mesh with the product of vertex colours and material colour, as far as there are any."""
    if surface.info is not None:
        note = f"its texture has no coordinates {surface.uv_name}"
        mesh = replace(mesh, warnings=(*mesh.warnings, note))
    if colours is None and surface.factor is None:
        return mesh
    colours = np.ones((len(mesh.vertices), 3)) if colours is None else colours
    return replace(mesh, colours=unit_to_uint8(colours * np.array(surface.factor or _WHITE)))


def _to_triangles(indices: Integer[np.ndarray, " n"], mode: int) -> Int[np.ndarray, "f 3"]:
    indices = indices.astype(np.int64)
    if mode == _TRIANGLES:
        return indices[: len(indices) // 3 * 3].reshape(-1, 3)
    if mode == _STRIP:
        faces = np.stack([indices[:-2], indices[1:-1], indices[2:]], axis=-1)
        faces[1::2] = faces[1::2, ::-1]
        return faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 0] != faces[:, 2])]
    return np.stack([np.repeat(indices[:1], max(0, len(indices) - 2)), indices[1:-1], indices[2:]], axis=-1)


class _Attributes:
    """Attributes of a primitive by name, stored plainly or compressed by Draco."""

    def __init__(self, gltf: GltfFile, primitive: dict[str, Any]) -> None:
        self._gltf, self._primitive = gltf, primitive
        self.names: dict[str, int] = primitive["attributes"]
        self._draco: dict[str, np.ndarray] = {}
        draco = primitive.get("extensions", {}).get(_DRACO)
        if draco is not None and "bufferView" not in gltf.list("accessors")[self.names["POSITION"]]:
            self._draco = _decode_draco(gltf.path, gltf.view(draco["bufferView"]), draco["attributes"])

    def floats(self, name: str) -> Float[np.ndarray, "n k"]:
        """An attribute's values; normalized integers become 0..1 or -1..1."""
        index = self.names[name]
        if name not in self._draco:
            return self._gltf.floats(index)
        values, accessor = self._draco[name], self._gltf.list("accessors")[index]
        check_count(self._gltf.path, f"values of {name} in Draco data", len(values), accessor["count"])
        return normalize(values) if accessor.get("normalized") else values.astype(float)

    def indices(self) -> Integer[np.ndarray, " n"] | None:
        """Indices of the vertices of the faces, None without any."""
        if self._draco:
            return self._draco["indices"]
        return self._gltf.accessor(self._primitive["indices"])[:, 0] if "indices" in self._primitive else None


def _decode_draco(path: Path, data: bytes, names: dict[str, int]) -> dict[str, np.ndarray]:
    """Attributes by name, and "indices"."""
    try:
        import DracoPy
    except ImportError:
        found = f"a mesh compressed by Draco ({_DRACO})"
        raise BadInput(
            path, found=found, needed="pip install --editable '.[draco]', or a file without compression"
        ) from None
    try:
        decoded = DracoPy.decode(data)
    except Exception as error:  # DracoPy raises its own types, and ValueError
        found = f"Draco data that cannot be decoded ({str(error)[:80]})"
        raise BadInput(path, found=found, needed="a complete file") from None
    by_id = {attribute["unique_id"]: attribute["data"] for attribute in decoded.attributes}
    missing = [name for name, number in names.items() if number not in by_id]
    if missing:
        raise BadInput(path, found=f"Draco data without {', '.join(missing)}", needed="a complete file")
    indices = np.asarray(decoded.faces, dtype=np.int64).reshape(-1)
    return {name: np.asarray(by_id[number]) for name, number in names.items()} | {"indices": indices}
