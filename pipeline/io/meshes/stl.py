"""stl files, with the colours that some programs put into a binary file's spare bytes."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from pipeline.errors import BadInput
from pipeline.io.meshes.corners import split_face_colours
from pipeline.items.objects import Mesh

_VALID, _DEFAULT = 0x8000, b"COLOR="  # VisCAM's mark of a coloured face; Magics' colour of the whole mesh


def parse_stl(path: Path, data: bytes) -> tuple[Mesh, bool]:
    """The mesh in an stl's bytes, not checked yet, and whether it has colours. Raises BadInput."""
    import trimesh

    loaded = trimesh.load_scene(io.BytesIO(data), file_type="stl", process=False)
    parts: list[Any] = [part for part in loaded.dump() if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    if not parts:
        raise BadInput(path, found="0 faces", needed="a mesh with vertices and faces")
    whole: Any = parts[0] if len(parts) == 1 else trimesh.util.concatenate(parts)
    mesh = Mesh(np.asarray(whole.vertices, dtype=float), np.asarray(whole.faces, dtype=np.int64))
    colours = _face_colours(data, len(mesh.faces))
    return (mesh, False) if colours is None else (split_face_colours(mesh, colours), True)


def _face_colours(data: bytes, faces: int) -> UInt8[np.ndarray, "f 3"] | None:
    """Colours in the two spare bytes of each face: 5 bits each, blue first (VisCAM) or red first (Magics)."""
    if len(data) != 84 + 50 * faces:
        return None
    spare = np.frombuffer(data, dtype=np.uint8)[84:].reshape(faces, 50)[:, 48:].copy().view("<u2")[:, 0]
    levels = np.stack([(spare >> shift) & 31 for shift in (10, 5, 0)], axis=-1) * 255 // 31
    at = data[:80].find(_DEFAULT)
    if at >= 0 and at + len(_DEFAULT) + 3 <= 80:
        whole = np.frombuffer(data, dtype=np.uint8)[at + len(_DEFAULT) :][:3]
        return np.where((spare & _VALID > 0)[:, None], whole, levels[:, ::-1]).astype(np.uint8)
    return levels.astype(np.uint8) if (spare & _VALID).all() else None
