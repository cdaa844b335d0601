"""Values at face corners -> values at vertices."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from pipeline.functional.arrays import rank_rows
from pipeline.items.objects import Mesh


def split_vertices(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], corners: Float[np.ndarray, "f 3 k"]
) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "f 3"], Float[np.ndarray, "w k"]]:
    """Vertices, faces and values by vertex, from ``corners``: the k values at each corner of each face.

    A vertex whose corners have different values gets a copy for each further value, after the last vertex. Invalid
    face indices are kept, with values of 0, for ``check_indices`` to report.
    """
    if faces.min() < 0 or faces.max() >= len(vertices):
        return vertices, faces, np.zeros((len(vertices), corners.shape[-1]))
    flat = corners.reshape(len(faces) * 3, -1)
    key = rank_rows([faces.reshape(-1), *flat.T])
    _, row, inverse = np.unique(key, return_index=True, return_inverse=True)
    vertex = faces.reshape(-1)[row]
    is_copy = np.concatenate([[False], vertex[1:] == vertex[:-1]])
    index = np.where(is_copy, len(vertices) + np.cumsum(is_copy) - 1, vertex)
    values = np.zeros((len(vertices) + int(is_copy.sum()), corners.shape[-1]))
    values[index] = flat[row]
    return np.concatenate([vertices, vertices[vertex[is_copy]]]), index[inverse.reshape(faces.shape)], values


def split_face_colours(mesh: Mesh, face_colours: UInt8[np.ndarray, "f 3"]) -> Mesh:
    """The mesh with a colour per vertex; vertices between faces of different colours are split."""
    corners = np.repeat(face_colours[:, None].astype(float), 3, axis=1)
    vertices, faces, colours = split_vertices(mesh.vertices, mesh.faces, corners)
    return Mesh(vertices, faces, colours=colours.astype(np.uint8))


def select_faces(mesh: Mesh, chosen: Int[np.ndarray, " g"]) -> Mesh:
    """Some of the mesh's faces, by their indices, and the vertices they use."""
    used, index = np.unique(mesh.faces[chosen], return_inverse=True)

    def at(values: Any) -> Any:
        return None if values is None else values[used]

    return replace(
        mesh, vertices=mesh.vertices[used], faces=index.reshape(-1, 3), colours=at(mesh.colours), uv=at(mesh.uv)
    )
