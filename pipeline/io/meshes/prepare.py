"""Mesh file -> the mesh that templates are rendered from: scaled and, if requested, simplified."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from pipeline.functional.plausibility import diagnose_shape
from pipeline.io.meshes.diameter import diameter_mm
from pipeline.io.meshes.reading import identify_mesh, read_mesh
from pipeline.io.meshes.simplify import SIMPLIFY_VERSION, simplify_mesh
from pipeline.io.meshes.stray import describe_stray_faces
from pipeline.items.objects import Mesh, MeshFacts
from pipeline.spec import digest

NO_COLOURS = "it has no colours, so templates are grey and poses less accurate; use a textured or coloured mesh"


def prepare_mesh(path: Path, *, scale: float = 1.0, simplify: int | None = None) -> tuple[Mesh, MeshFacts]:
    """The mesh of a file times ``scale``, with at most ``simplify`` faces (None: all), and its facts.

    The diameter is measured before simplification. Raises BadInput as ``read_mesh`` does.
    """
    mesh = read_mesh(path)
    if scale != 1.0:
        mesh = replace(mesh, vertices=mesh.vertices * scale)
    mesh = replace(mesh, digest=_derive_digest(mesh.digest, len(mesh.faces), scale, simplify))
    diameter, diagonal = diameter_mm(mesh), float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    warnings = mesh.warnings
    if mesh.colours is None and mesh.texture is None:
        warnings += (NO_COLOURS,)
    if problem := diagnose_shape(mesh.vertices[np.bincount(mesh.faces.reshape(-1), minlength=len(mesh.vertices)) > 0]):
        warnings += (problem,)
    warnings += describe_stray_faces(mesh)
    if simplify is not None and len(mesh.faces) > simplify:
        mesh, note = simplify_mesh(mesh, simplify, diameter)
        warnings += (note,)
    return mesh, MeshFacts(diameter, diagonal, len(mesh.faces), warnings)


def prepared_digest(path: Path, *, scale: float = 1.0, simplify: int | None = None) -> str:
    """Digest of the result of ``prepare_mesh``, without computing it. Raises BadInput."""
    identity = identify_mesh(path)
    return _derive_digest(identity.digest, identity.faces, scale, simplify)


def _derive_digest(of_file: str, faces: int, scale: float, simplify: int | None) -> str:
    scaled = of_file if scale == 1.0 else digest([of_file, scale])
    if simplify is None or faces <= simplify:
        return scaled
    return digest([scaled, "simplified", simplify, SIMPLIFY_VERSION])
