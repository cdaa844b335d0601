"""Wavefront material files: colours and textures by the materials' names."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pipeline.errors import BadInput

_OPTIONS = {"-blendu": 1, "-blendv": 1, "-cc": 1, "-clamp": 1, "-imfchan": 1, "-texres": 1, "-bm": 1, "-boost": 1}
_OPTIONS |= {"-colorspace": 1, "-type": 1, "-mm": 2}  # number of arguments; -o, -s and -t take up to three numbers


@dataclass
class Material:
    """Diffuse colour (0..1, None if not stated) and texture of a material, looked up at uv * scale + offset."""

    colour: tuple[float, ...] | None = None
    texture: str | None = None
    scale: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)


def parse_mtl(path: Path, data: bytes) -> dict[str, Material]:
    """Materials by name. Raises BadInput for texture options that change colours."""
    materials: dict[str, Material] = {}
    material = Material()
    for line in data.decode(errors="replace").replace("\\\n", " ").splitlines():
        key, _, rest = (
            line.strip().partition(" ") if "\t" not in line else line.strip().replace("\t", " ").partition(" ")
        )
        key, rest = key.lower(), rest.strip()
        if key == "newmtl":
            material = materials.setdefault(rest, Material())
        elif key == "kd":
            material.colour = _parse_colour(path, rest)
        elif key == "map_kd":
            _parse_texture(path, rest, material)
    return materials


def _parse_colour(path: Path, text: str) -> tuple[float, ...] | None:
    words = text.split()
    if words[:1] in (["xyz"], ["spectral"]):
        raise BadInput(path, found=f"Kd {text[:40]}", needed="Kd as red, green and blue")
    numbers = _numbers(words)
    return None if not numbers else tuple((numbers * 3)[:3] if len(numbers) == 1 else numbers[:3])


def _parse_texture(path: Path, text: str, material: Material) -> None:
    """The file name, which may contain blanks, and the scale and offset from its options."""
    words = text.split()
    while words and words[0].lower() in ("-o", "-s", "-t", *_OPTIONS):
        option = words.pop(0).lower()
        if option in _OPTIONS:
            values, words = words[: _OPTIONS[option]], words[_OPTIONS[option] :]
            if option == "-mm" and _numbers(values) != [0.0, 1.0]:
                found = f"map_Kd with {option} {' '.join(values)}"
                raise BadInput(path, found=found, needed="a texture without it; bake it")
            continue
        numbers = _numbers(words[:3])
        words = words[len(numbers) :]
        default = 1.0 if option == "-s" else 0.0
        u, v = (*numbers, default, default)[:2]
        if option == "-s":
            material.scale = (u, v)
        elif option == "-o":
            material.offset = (u, v)
    material.texture = text[len(text) - _tail(text, words) :].strip() or None


def _tail(text: str, words: list[str]) -> int:
    """Length of the end of the text made of these words and the blanks between them."""
    at = len(text)
    for word in reversed(words):
        at = text.rindex(word, 0, at)
    return len(text) - at


def _numbers(words: list[str]) -> list[float]:
    """The numbers at the start of the words."""
    numbers: list[float] = []
    for word in words:
        try:
            numbers.append(float(word))
        except ValueError:
            break
    return numbers
