"""Materials and textures that a mesh file refers to, read from its own folder only."""

from __future__ import annotations

import io
from hashlib import sha256
from pathlib import Path, PurePosixPath
from urllib.parse import unquote

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from pipeline.errors import BadInput
from pipeline.io.files import IMAGE_FORMATS, read_file

_MAX_NAME = 255  # characters
_MAX_TEXELS = 1 << 28  # of all textures of a mesh: 800 MB
_SIGNATURES = {b"\xabKTX 20": "KTX2 (Basis Universal)", b"DDS ": "DDS", b"\x76\x2f\x31\x01": "OpenEXR"}


class Companions:
    """Reads a mesh file and the files it refers to, once each, and computes the digest of all that was read."""

    def __init__(self, mesh_path: Path) -> None:
        self.mesh_path = mesh_path
        self._digests: dict[str, str] = {}
        self._textures: dict[str, UInt8[np.ndarray, "H W 3"]] = {}
        self._texels = 0

    def read_mesh(self) -> bytes:
        """Bytes of the mesh file. Raises BadInput."""
        data = read_file(self.mesh_path, "a readable mesh file")
        self._digests[self.mesh_path.name] = sha256(data).hexdigest()
        return data

    def read(self, name: str) -> bytes:
        """Bytes of the file ``name``. Raises BadInput."""
        relative = self._resolve(name)
        data = read_file(self.mesh_path.parent / relative, f"the file named in {self.mesh_path.name}")
        self._digests[relative.as_posix()] = sha256(data).hexdigest()
        return data

    def exists(self, name: str) -> bool:
        """Whether the file ``name`` exists. Raises BadInput for a name outside the mesh's folder."""
        return (self.mesh_path.parent / self._resolve(name)).is_file()

    def texture(self, name: str) -> UInt8[np.ndarray, "H W 3"]:
        """The image file ``name``, decoded once. Raises BadInput."""
        if name not in self._textures:
            self._textures[name] = self.decode(self.mesh_path.parent / self._resolve(name), self.read(name))
        return self._textures[name]

    def decode(self, where: object, data: bytes) -> UInt8[np.ndarray, "H W 3"]:
        """An image file's bytes as 8-bit rgb. ``where``: its name in errors. Raises BadInput."""
        for signature, name in _SIGNATURES.items():
            if data.startswith(signature):
                raise BadInput(where, found=f"a texture in {name}", needed=f"one of {', '.join(IMAGE_FORMATS)}")
        try:
            with Image.open(io.BytesIO(data), formats=IMAGE_FORMATS) as image:
                self.reserve(where, image.width * image.height)
                return _to_rgb(image)
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
            found = "not an image" if isinstance(error, Image.UnidentifiedImageError) else str(error)
            raise BadInput(where, found=found, needed="a readable texture image") from None

    def reserve(self, where: object, texels: int) -> None:
        """Count the texels of a texture to be created. Raises BadInput, naming ``where``, above the total limit."""
        self._texels += texels
        if self._texels > _MAX_TEXELS:
            found = f"textures of {self._texels / 1e6:.0f} megapixels in all"
            raise BadInput(where, found=found, needed=f"at most {_MAX_TEXELS / 1e6:.0f}")

    def digest(self) -> str:
        """sha256 (hex) of the bytes and names of the mesh file and of every file read; independent of their folder."""
        lines = "".join(f"{name}\0{digest}\n" for name, digest in sorted(self._digests.items()))
        return sha256(lines.encode()).hexdigest()

    def _resolve(self, name: str) -> PurePosixPath:
        """Path relative to the mesh's folder. Raises BadInput for one that leads out of it."""
        relative = PurePosixPath(name.strip().strip('"').replace("\\", "/"))
        if "\0" in name or len(name) > _MAX_NAME:
            raise BadInput(self.mesh_path, found=f"a reference to {name[:40]!r}...", needed="the name of a file")
        if not (self.mesh_path.parent / relative).is_file():
            relative = PurePosixPath(unquote(str(relative)))  # glTF encodes a blank as %20
        outside = relative.is_absolute() or ".." in relative.parts or ":" in str(relative) or str(relative) == "."
        if outside or self._links_outside(relative):
            raise BadInput(self.mesh_path, found=f"a reference to {name!r}", needed="a file in the mesh's own folder")
        return relative

    def _links_outside(self, relative: PurePosixPath) -> bool:
        folder = self.mesh_path.parent
        return not (folder / relative).resolve().is_relative_to(folder.resolve())


def _to_rgb(image: Image.Image) -> UInt8[np.ndarray, "H W 3"]:
    if image.mode.startswith("I;16"):  # Pillow would clip 16-bit grey at 255
        grey = (np.asarray(image, dtype=np.uint32) * 255 // 65535).astype(np.uint8)
        return np.repeat(grey[..., None], 3, axis=-1)
    return np.asarray(image.convert("RGB"))
