"""Mesh files -> meshes in millimetres. The only package that uses trimesh's loaders.

Coordinates are taken as millimetres, whatever unit a format prescribes. Materials and textures must be in the mesh's
folder or below it after resolving symbolic links; nothing outside is opened, downloaded or unpickled. Everything in a
file ends up in the mesh, or raises an error, or is listed in ``Mesh.warnings`` as missing.
"""

from pipeline.io.meshes.diameter import diameter_mm
from pipeline.io.meshes.ply import write_ply
from pipeline.io.meshes.prepare import prepare_mesh, prepared_digest
from pipeline.io.meshes.reading import SUFFIXES, identify_mesh, read_mesh

__all__ = ["SUFFIXES", "diameter_mm", "identify_mesh", "prepare_mesh", "prepared_digest", "read_mesh", "write_ply"]
