"""Materials and textures that a mesh file names, read from its own folder only."""

from __future__ import annotations

import io
from pathlib import Path, PurePosixPath
from urllib.parse import unquote

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from pipeline.errors import BadInput
from pipeline.io.digests import files_digest
from pipeline.io.files import IMAGE_FORMATS, read_file

_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".tga", ".webp", ".gif", ".ppm")
_MAX_NAME = 255  # characters


class Companions:
    """Reads the files named inside a mesh file and records them for the digest. Serves as trimesh's resolver.

    trimesh swallows exceptions raised by its resolver, so the first one is kept in ``failure``.
    """

    def __init__(self, mesh_path: Path) -> None:
        self.mesh_path = mesh_path
        self.file_name = mesh_path.name
        self.opened: dict[str, Path] = {}
        self.failure: BadInput | None = None

    def get(self, name: str) -> bytes:
        """Bytes of the file ``name``. Raises BadInput and keeps it in ``failure``."""
        try:
            path, data = self.read(name)
            if path.suffix.lower() in _IMAGE_SUFFIXES:
                decode_texture(path, data)
        except BadInput as error:
            self.failure = self.failure or error
            raise
        return data

    __getitem__ = get

    def read(self, name: str) -> tuple[Path, bytes]:
        """Path and bytes of the file ``name``, without decoding it. Raises BadInput."""
        relative = self._resolve(name)
        path = self.mesh_path.parent / relative
        data = read_file(path, f"the file named in {self.mesh_path.name}")
        self.opened[relative.as_posix()] = path
        return path, data

    def digest(self) -> str:
        """sha256 (hex) of the mesh file and of every file read through this object."""
        return files_digest({self.mesh_path.name: self.mesh_path} | self.opened)

    def _resolve(self, name: str) -> PurePosixPath:
        """Path relative to the mesh's folder. Raises BadInput for one that leads out of it."""
        relative = PurePosixPath(name.strip().strip('"').replace("\\", "/"))
        if "\0" in name or len(name) > _MAX_NAME:
            raise BadInput(self.mesh_path, found=f"a reference to {name[:40]!r}...", needed="the name of a file")
        if not (self.mesh_path.parent / relative).is_file():
            relative = PurePosixPath(unquote(str(relative)))  # glTF writes a blank as %20
        outside = relative.is_absolute() or ".." in relative.parts or ":" in str(relative) or str(relative) == "."
        if outside or self._links_outside(relative):
            raise BadInput(self.mesh_path, found=f"a reference to {name!r}", needed="a file in the mesh's own folder")
        return relative

    def _links_outside(self, relative: PurePosixPath) -> bool:
        folder = self.mesh_path.parent
        return not (folder / relative).resolve().is_relative_to(folder.resolve())


def decode_texture(path: Path, data: bytes) -> UInt8[np.ndarray, "H W 3"]:
    """An image file's bytes as 8-bit rgb. Raises BadInput."""
    try:
        with Image.open(io.BytesIO(data), formats=IMAGE_FORMATS) as image:
            return np.asarray(image.convert("RGB"))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        found = "not an image" if isinstance(error, Image.UnidentifiedImageError) else error
        raise BadInput(path, found=found, needed="a readable texture image") from None
