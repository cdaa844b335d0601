"""glTF materials: base colour and texture, with texture coordinates in the convention of ``Mesh``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from pipeline.errors import BadInput
from pipeline.io.meshes.companions import Companions
from pipeline.io.meshes.gltf_file import REMEDY, GltfFile

_REPEAT, _MIRROR = 10497, 33648  # WebGL constants; the third is CLAMP_TO_EDGE
_GLOSS = "KHR_materials_pbrSpecularGlossiness"


@dataclass(frozen=True)
class Surface:
    """Base colour of a material. ``factor``: 0..1, None if not stated; ``info``: the texture's reference, if any."""

    factor: tuple[float, ...] | None
    info: dict[str, Any] | None
    warnings: tuple[str, ...]

    @property
    def uv_name(self) -> str:
        """The attribute with the texture's coordinates."""
        assert self.info is not None
        transform = self.info.get("extensions", {}).get("KHR_texture_transform", {})
        return f"TEXCOORD_{transform.get('texCoord', self.info.get('texCoord', 0))}"


def read_surface(gltf: GltfFile, index: int | None) -> Surface:
    """The base colour of a material; of the default one without an index."""
    material = {} if index is None else gltf.list("materials")[index]
    gloss = material.get("extensions", {}).get(_GLOSS)
    base = gloss if gloss is not None else material.get("pbrMetallicRoughness", {})
    factor = base.get("diffuseFactor" if gloss is not None else "baseColorFactor")
    info = base.get("diffuseTexture" if gloss is not None else "baseColorTexture")
    warnings: tuple[str, ...] = ()
    if info is None and material.get("emissiveTexture") is not None:
        warnings = ("its material has a texture that glows (emissiveTexture), which is not read as its colour",)
    return Surface(None if factor is None else tuple(float(x) for x in factor[:3]), info, warnings)


class Textures:
    """Textures of a glTF file: each image is decoded once, and multiplied once by each factor."""

    def __init__(self, gltf: GltfFile, companions: Companions) -> None:
        self._gltf, self._companions = gltf, companions
        self._images: dict[int, UInt8[np.ndarray, "H W 3"]] = {}
        self._made: dict[Any, UInt8[np.ndarray, "H W 3"]] = {}

    def make(
        self, surface: Surface, uv: Float[np.ndarray, "v 2"], factor: tuple[float, ...]
    ) -> tuple[UInt8[np.ndarray, "H W 3"], Float[np.ndarray, "v 2"], tuple[str, ...]]:
        """The texture times ``factor``, its coordinates (origin at the lower left) and warnings."""
        assert surface.info is not None
        texture = self._gltf.list("textures")[surface.info["index"]]
        uv = _transform(uv, surface.info.get("extensions", {}).get("KHR_texture_transform", {}))
        sampler = self._gltf.list("samplers")[texture["sampler"]] if "sampler" in texture else {}
        wraps = (sampler.get("wrapS", _REPEAT), sampler.get("wrapT", _REPEAT))
        warnings: tuple[str, ...] = ()
        mirrored = []
        for axis, wrap in enumerate(wraps):
            outside = uv[:, axis].min() < -1e-3 or uv[:, axis].max() > 1 + 1e-3
            mirrored.append(bool(outside and wrap == _MIRROR))
            if outside and wrap not in (_REPEAT, _MIRROR):
                warnings = ("its texture is repeated where the file clamps it (CLAMP_TO_EDGE)",)
        key = (self._source(texture), tuple(mirrored), factor)
        if key not in self._made:
            image = self._image(key[0])
            if any(mirrored) or factor != (1.0, 1.0, 1.0):
                self._companions.reserve(self._gltf.path, image.shape[0] * image.shape[1] * 2 ** sum(mirrored))
            self._made[key] = _multiply(_unfold(image, *mirrored), factor)
        uv = uv / np.where(mirrored, 2, 1)
        return self._made[key], np.stack([uv[:, 0], 1 - uv[:, 1]], axis=-1), warnings

    def _source(self, texture: dict[str, Any]) -> int:
        extensions = texture.get("extensions", {})
        if "EXT_texture_webp" in extensions:
            return int(extensions["EXT_texture_webp"]["source"])
        if "source" not in texture:
            found = f"a texture in {', '.join(extensions) or 'no image'}"
            raise BadInput(self._gltf.path, found=found, needed=f"png, jpeg or webp; {REMEDY}")
        return int(texture["source"])

    def _image(self, index: int) -> UInt8[np.ndarray, "H W 3"]:
        if index not in self._images:
            image = self._gltf.list("images")[index]
            uri = image.get("uri", "")
            if uri and not uri.startswith("data:"):
                self._images[index] = self._companions.texture(uri)
            else:
                data = self._gltf.resource(uri) if uri else self._gltf.view(image["bufferView"])
                self._images[index] = self._companions.decode(f"{self._gltf.path}, image {index}", data)
        return self._images[index]


def _transform(uv: Float[np.ndarray, "v 2"], transform: dict[str, Any]) -> Float[np.ndarray, "v 2"]:
    """Apply KHR_texture_transform; rotates in the same direction as Khronos' sample viewer and three.js."""
    angle = float(transform.get("rotation", 0))
    rotation = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    scale, offset = np.reshape(transform.get("scale", (1, 1)), 2), np.reshape(transform.get("offset", (0, 0)), 2)
    return (uv * scale) @ rotation.T + offset if transform else uv


def _unfold(image: UInt8[np.ndarray, "h w 3"], mirror_x: bool, mirror_y: bool) -> UInt8[np.ndarray, "H W 3"]:
    """The image next to its mirror image, so that repeating it looks like a mirrored repeat."""
    if mirror_x:
        image = np.concatenate([image, image[:, ::-1]], axis=1)
    return np.concatenate([image, image[::-1]], axis=0) if mirror_y else image


def _multiply(image: UInt8[np.ndarray, "H W 3"], factor: tuple[float, ...]) -> UInt8[np.ndarray, "H W 3"]:
    if all(value == 1 for value in factor):
        return image
    levels = np.rint(np.clip(np.arange(256)[:, None] * np.array(factor), 0, 255)).astype(np.uint8)
    return np.stack([levels[:, k][image[..., k]] for k in range(3)], axis=-1)
