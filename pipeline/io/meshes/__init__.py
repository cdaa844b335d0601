"""Mesh files -> meshes in millimetres. The only package that uses trimesh's loaders.

Coordinates are taken as millimetres, whatever unit a format prescribes. Materials and textures must lie in the mesh's
folder or below it, symbolic links resolved; nothing outside is opened, downloaded or unpickled. What a file states is
in the mesh, or the file is refused by name, or ``Mesh.warnings`` says what is missing.
"""

from pipeline.io.meshes.diameter import diameter_mm
from pipeline.io.meshes.ply import write_ply
from pipeline.io.meshes.prepare import prepare_mesh, prepared_digest
from pipeline.io.meshes.reading import SUFFIXES, identify_mesh, read_mesh

__all__ = ["SUFFIXES", "diameter_mm", "identify_mesh", "prepare_mesh", "prepared_digest", "read_mesh", "write_ply"]
