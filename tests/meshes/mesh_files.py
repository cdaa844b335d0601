"""Writers of small mesh files in every dialect, and what a reader must make of them."""

import io
import json
import struct
from pathlib import Path

import numpy as np
from PIL import Image

from pipeline.functional.shading import Mipmap, texture_colour
from pipeline.items.objects import Mesh

# a square of side 10 in two triangles; the texture has one colour per quarter
SQUARE = np.array([[0, 0, 0], [10, 0, 0], [10, 10, 0], [0, 10, 0]], dtype=float)
SQUARE_FACES = np.array([[0, 1, 2], [0, 2, 3]])
UV = np.array([[0.1, 0.1], [0.9, 0.1], [0.9, 0.9], [0.1, 0.9]])
RED, GREEN, BLUE, GREY = (255, 0, 0), (0, 255, 0), (0, 0, 255), (9, 9, 9)
CORNER_COLOURS = np.array([BLUE, GREY, GREEN, RED])  # of the square's vertices, from the texture


def texture(size: int = 8) -> Image.Image:
    """Red and green above, blue and grey below."""
    pixels = np.zeros((size, size, 3), np.uint8)
    half = size // 2
    pixels[:half, :half], pixels[:half, half:] = RED, GREEN
    pixels[half:, :half], pixels[half:, half:] = BLUE, GREY
    return Image.fromarray(pixels)


def png(image: Image.Image) -> bytes:
    stream = io.BytesIO()
    image.save(stream, "PNG")
    return stream.getvalue()


def area(mesh: Mesh) -> float:
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=-1).sum() / 2)


def normals(mesh: Mesh) -> np.ndarray:
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


def colours_at(mesh: Mesh, point: np.ndarray) -> np.ndarray:
    """Colours (0..255) of all vertices at a point."""
    at = np.flatnonzero(np.abs(mesh.vertices - point).max(axis=-1) < 1e-3)
    assert len(at), point
    if mesh.texture is not None:
        return texture_colour(Mipmap.of([mesh.texture]), mesh.uv[at], np.ones(len(at)))
    assert mesh.colours is not None
    return mesh.colours[at].astype(float)


def assert_corner_colours(mesh: Mesh, colours: np.ndarray, points: np.ndarray = SQUARE, atol: float = 1.01) -> None:
    for point, colour in zip(points, colours, strict=True):
        seen = colours_at(mesh, point)
        np.testing.assert_allclose(seen, np.tile(colour, (len(seen), 1)), atol=atol)


class Gltf:
    """A glTF document in the making, with one binary buffer."""

    def __init__(self) -> None:
        self.blob = b""
        self.document = {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": []}],
            "accessors": [],
            "bufferViews": [],
        }

    def view(self, data: bytes, **more) -> int:
        self.blob += b"\0" * (-len(self.blob) % 4)
        self.document["bufferViews"].append({"buffer": 0, "byteOffset": len(self.blob), "byteLength": len(data)} | more)
        self.blob += data
        return len(self.document["bufferViews"]) - 1

    def accessor(self, values: np.ndarray, **more) -> int:
        """Rows of numbers, padded to four bytes as the format asks."""
        kinds = {"int8": 5120, "uint8": 5121, "int16": 5122, "uint16": 5123, "uint32": 5125, "float32": 5126}
        values = np.asarray(values)
        rows = values.reshape(len(values), -1)
        padding = -rows.shape[1] * rows.itemsize % 4 if values.ndim > 1 else 0
        data = b"".join(row.tobytes() + b"\0" * padding for row in rows)
        stride = {"byteStride": rows.shape[1] * rows.itemsize + padding} if padding else {}
        self.document["accessors"].append(
            {
                "bufferView": self.view(data, **stride),
                "componentType": kinds[str(values.dtype)],
                "count": len(values),
                "type": "SCALAR" if values.ndim == 1 else f"VEC{values.shape[1]}",
            }
            | more
        )
        return len(self.document["accessors"]) - 1

    def positions(self, values: np.ndarray, **more) -> int:
        return self.accessor(values, min=values.min(0).tolist(), max=values.max(0).tolist(), **more)

    def primitive(self, attributes: dict[str, int], faces: np.ndarray | None = SQUARE_FACES, **more) -> dict:
        made = {"attributes": attributes} | more
        if faces is not None:
            made["indices"] = self.accessor(np.asarray(faces, dtype=np.uint32).reshape(-1))
        self.document["meshes"][0]["primitives"].append(made)
        return made

    def material(self, image: Image.Image | None = None, info: dict | None = None, **pbr) -> int:
        if image is not None:
            images, textures = (self.document.setdefault(key, []) for key in ("images", "textures"))
            images.append({"bufferView": self.view(png(image)), "mimeType": "image/png"})
            textures.append({"source": len(images) - 1})
            pbr["baseColorTexture"] = {"index": len(textures) - 1} | (info or {})
        materials = self.document.setdefault("materials", [])
        materials.append({"pbrMetallicRoughness": pbr})
        return len(materials) - 1

    def square(self, **more) -> dict:
        """A textured square."""
        attributes = {"POSITION": self.positions(SQUARE.astype(np.float32)), "TEXCOORD_0": self.accessor(flipped(UV))}
        return self.primitive(attributes, material=self.material(texture()), **more)

    def write(self, path: Path) -> Path:
        """As glb."""
        blob = self.blob + b"\0" * (-len(self.blob) % 4)
        self.document["buffers"] = [{"byteLength": len(blob)}]
        text = json.dumps(self.document).encode()
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(blob), b"BIN\0") + blob
        path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
        return path


def flipped(uv: np.ndarray) -> np.ndarray:
    """Texture coordinates with their origin at the upper left."""
    return np.stack([uv[:, 0], 1 - uv[:, 1]], axis=-1).astype(np.float32)
