"""Mesh files -> meshes in millimetres. The only package that uses trimesh's loaders.

Coordinates are taken as millimetres, whatever unit a format prescribes. Materials and textures must lie in the mesh's
folder or below it, symbolic links resolved; nothing outside is opened, downloaded or unpickled.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

from pipeline.errors import BadInput
from pipeline.io.files import read_file
from pipeline.io.meshes.checks import check_mesh
from pipeline.io.meshes.companions import Companions
from pipeline.io.meshes.diameter import diameter_mm
from pipeline.io.meshes.ply import parse_ply, read_header, texture_name, write_ply
from pipeline.io.meshes.scene import parse_scene
from pipeline.items.objects import Mesh

__all__ = ["SUFFIXES", "diameter_mm", "mesh_digest", "read_mesh", "write_ply"]

SUFFIXES = (".ply", ".obj", ".glb", ".gltf", ".stl", ".off")
READER_VERSIONS = dict.fromkeys(SUFFIXES, 1)
"""Raise the number of a format when the same file gives another mesh. It is part of the mesh's digest from 2 on."""
_READABLE = "a readable mesh file"


def read_mesh(path: Path) -> Mesh:
    """The triangles of a .ply, .obj, .glb, .gltf, .stl or .off file; several geometries become one mesh.

    A ply's vertices keep their order; a vertex with several texture coordinates or colours gets copies after the last
    vertex. Other formats keep the vertices that faces use, copies included. Raises BadInput for a file, material or
    texture that is missing or broken, and for a mesh without extent.
    """
    path = _check_path(path)
    companions = Companions(path)
    mesh = _parse(path, companions)
    check_mesh(path, mesh)
    return replace(mesh, digest=_digest(path, companions))


def mesh_digest(path: Path) -> str:
    """``read_mesh(path).digest``; of a ply only the header is read. Raises BadInput as ``read_mesh`` does."""
    path = _check_path(path)
    if path.suffix.lower() != ".ply":
        return read_mesh(path).digest  # only parsing the mesh shows which files belong to it
    companions = Companions(path)
    name = texture_name(read_header(path, read_file(path, _READABLE)))
    if name is not None:
        companions.read(name)
    return _digest(path, companions)


def _digest(path: Path, companions: Companions) -> str:
    """Digest of the files that were read, and of the reader's version."""
    version, files = READER_VERSIONS[path.suffix.lower()], companions.digest()
    return files if version == 1 else sha256(f"{files}, reader {version}".encode()).hexdigest()


def _check_path(path: Path) -> Path:
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise BadInput(path, found=f"suffix {path.suffix!r}", needed=f"a mesh: {', '.join(SUFFIXES)}")
    if not path.is_file():
        raise BadInput(path, found="no such file", needed="a mesh file")
    return path


def _parse(path: Path, companions: Companions) -> Mesh:
    data = read_file(path, _READABLE)
    parse = parse_ply if path.suffix.lower() == ".ply" else parse_scene
    try:
        with _silence_trimesh():
            mesh = parse(path, data, companions)
    except BadInput:
        raise
    except Exception as error:  # trimesh's parsers raise whatever numpy, struct or json does on broken bytes
        if companions.failure is None:
            reason = (str(error).splitlines() or [""])[0][:120]
            found = f"unreadable content ({type(error).__name__}: {reason})"
            raise BadInput(path, found=found, needed=f"a complete {path.suffix.lower()} file") from None
    if companions.failure is not None:
        raise companions.failure
    return mesh


@contextmanager
def _silence_trimesh() -> Iterator[None]:
    """Disable trimesh's log, which prints tracebacks for broken files; a BadInput reports them instead."""
    logger = logging.getLogger("trimesh")
    before, logger.disabled = logger.disabled, True
    try:
        yield
    finally:
        logger.disabled = before
