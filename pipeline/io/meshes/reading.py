"""Mesh files -> meshes, by format; and digests of the files that a mesh is read from."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path

from pipeline.errors import BadInput, DzopError
from pipeline.io.files import describe_irregular
from pipeline.io.meshes.checks import check_mesh
from pipeline.io.meshes.companions import Companions
from pipeline.io.meshes.gltf import parse_gltf
from pipeline.io.meshes.obj import parse_obj
from pipeline.io.meshes.off import parse_off
from pipeline.io.meshes.ply import parse_ply, read_surface
from pipeline.io.meshes.stl import parse_stl
from pipeline.items.objects import Mesh

SUFFIXES = (".ply", ".obj", ".glb", ".gltf", ".stl", ".off")
READER_VERSIONS = dict.fromkeys(SUFFIXES, 2) | {".ply": 1, ".stl": 1}
"""Raise a format's version if its reader returns another mesh for the same file. Part of the digest from 2 on."""
_REVISED = 2  # version of a ply or stl that version 1 read differently


def read_mesh(path: Path) -> Mesh:
    """The triangles of a .ply, .obj, .glb, .gltf, .stl or .off file; several geometries become one mesh.

    A ply's vertices keep their order; a vertex with several texture coordinates or colours gets copies after the last
    vertex. obj files keep the vertices that faces use, copies included. Raises BadInput for a file, material or texture
    that is missing or broken, for unsupported contents, and for a mesh without extent.
    """
    path = _check_path(path)
    companions = Companions(path)
    with _one_line(path):
        mesh, revised = _parse(path, companions.read_mesh(), companions)
    check_mesh(path, mesh)
    return replace(mesh, digest=_digest(path, companions, revised))


@dataclass(frozen=True)
class MeshIdentity:
    """Digest and number of faces of ``read_mesh(path)``."""

    digest: str
    faces: int


def identify_mesh(path: Path) -> MeshIdentity:
    """Digest and faces of a mesh; no texture of a ply is decoded. Raises BadInput as ``read_mesh`` does."""
    path = _check_path(path)
    if path.suffix.lower() != ".ply":
        mesh = read_mesh(path)  # only parsing the mesh shows which files belong to it
        return MeshIdentity(mesh.digest, len(mesh.faces))
    companions = Companions(path)
    with _one_line(path):
        surface = read_surface(path, companions.read_mesh())
    for name in surface.header.textures:
        companions.read(name)
    return MeshIdentity(_digest(path, companions, surface.revised), len(surface.mesh.faces))


def _digest(path: Path, companions: Companions, revised: bool) -> str:
    """Digest of the files that were read, and of the reader's version."""
    version, files = READER_VERSIONS[path.suffix.lower()], companions.digest()
    version = max(version, _REVISED) if revised else version
    return files if version == 1 else sha256(f"{files}, reader {version}".encode()).hexdigest()


def _check_path(path: Path) -> Path:
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise BadInput(path, found=f"suffix {path.suffix!r}", needed=f"a mesh: {', '.join(SUFFIXES)}")
    if not path.is_file():
        found = describe_irregular(path) if path.exists() else "no such file"
        raise BadInput(path, found=found, needed="a mesh file")
    return path


def _parse(path: Path, data: bytes, companions: Companions) -> tuple[Mesh, bool]:
    """The mesh, and whether version 1 of the ply or stl reader returned another one."""
    suffix = path.suffix.lower()
    if suffix == ".ply":
        return parse_ply(path, data, companions)
    if suffix == ".stl":
        return parse_stl(path, data)
    if suffix == ".off":
        return parse_off(path, data), False
    return (parse_obj if suffix == ".obj" else parse_gltf)(path, data, companions), False


@contextmanager
def _one_line(path: Path) -> Iterator[None]:
    """Turn parser errors on broken bytes into BadInput, and disable trimesh's log, which prints tracebacks."""
    logger = logging.getLogger("trimesh")
    before, logger.disabled = logger.disabled, True
    try:
        yield
    except DzopError:
        raise
    except Exception as error:
        reason = (str(error).splitlines() or [""])[0][:120]
        found = f"unreadable content ({type(error).__name__}: {reason})"
        raise BadInput(path, found=found, needed=f"a complete {path.suffix.lower()} file") from None
    finally:
        logger.disabled = before
