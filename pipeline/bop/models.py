"""Object models: meshes, diameters and symmetries."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from pipeline.bop.jsonio import abbreviate, describe_place, get_field, get_numbers, is_number, parse_vector, read_by_id
from pipeline.bop.scene import describe_rotation_fault
from pipeline.errors import BadInput
from pipeline.functional.rigid import rigid
from pipeline.io.meshes import diameter_mm, read_mesh
from pipeline.items.objects import ObjectModel

MAX_SYMMETRY_STEP = 0.01
"""Largest move of a vertex between neighbouring discretised symmetries, as a share of the diameter (BOP)."""


@dataclass(frozen=True, eq=False)
class ModelInfo:
    """An entry of models_info.json, mm. ``centre``: middle of the box in the object frame, None when not given."""

    diameter_mm: float
    symmetries: Float[np.ndarray, "s 4 4"]
    centre: Float[np.ndarray, " 3"] | None


def read_models_info(path: Path) -> dict[int, ModelInfo]:
    """Entries by object id; empty when there is no such file (diameters then come from the meshes)."""
    if not path.exists():
        return {}
    return {
        obj_id: _model_info(record, describe_place(path, object=obj_id)) for obj_id, record in read_by_id(path).items()
    }


def read_model(
    path: Path, obj_id: int, infos: dict[int, ModelInfo], *, distances_mm: Sequence[float] = ()
) -> ObjectModel:
    """The object of a mesh file. ``distances_mm``: how far from the camera it was annotated, to notice wrong units.

    Raises BadInput for a mesh without an entry in models_info.json (when there is one), and for lengths that
    do not fit one another.
    """
    check_model_files(path, obj_id, infos)
    mesh = read_mesh(path)
    measured = diameter_mm(mesh)
    info = infos.get(obj_id)
    if info is not None and abs(measured - info.diameter_mm) > 0.1 * info.diameter_mm:
        metres = " (it looks like metres)" if 500 < info.diameter_mm / measured < 2000 else ""
        found = f"a mesh of diameter {measured:.4g}{metres} where models_info.json says {info.diameter_mm:.4g}"
        raise BadInput(path, found=found, needed="vertices in millimetres and the diameter of this mesh")
    if fault := _unit_fault(measured, distances_mm):
        raise BadInput(path, found=fault, needed="mesh and cam_t_m2c both in millimetres")
    return ObjectModel(obj_id, mesh, info.diameter_mm, info.symmetries) if info else ObjectModel(obj_id, mesh, measured)


def check_model_files(path: Path, obj_id: int, infos: dict[int, ModelInfo]) -> None:
    """Raise BadInput when an object has no mesh file, or no entry in a models_info.json that exists."""
    if not path.exists():
        raise BadInput(path, found="no such file", needed=f"the mesh of object {obj_id}, which the targets ask for")
    if infos and obj_id not in infos:
        where = describe_place(path.parent / "models_info.json", object=obj_id)
        raise BadInput(
            where, found=f"entries for {', '.join(map(str, sorted(infos)))}", needed="diameter of this object"
        )


def symmetry_transforms(
    discrete: Float[np.ndarray, "d 4 4"], axes: Float[np.ndarray, "a 3"], offsets: Float[np.ndarray, "a 3"]
) -> Float[np.ndarray, "s 4 4"]:
    """All symmetries T_obj_obj (mm), the identity first.

    As bop_toolkit's get_symmetry_transformations with max_sym_disc_step = 0.01: every continuous one in
    ceil(pi / 0.01) = 315 rotations about its axis, each applied after the identity and every discrete one.
    """
    first = np.concatenate([np.eye(4)[None], discrete])
    if not len(axes):
        return first
    turns = np.concatenate([_turns(axis, offset) for axis, offset in zip(axes, offsets, strict=True)])
    return (turns[None] @ first[:, None]).reshape(-1, 4, 4)


def _turns(axis: Float[np.ndarray, " 3"], offset: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "n 4 4"]:
    count = int(np.ceil(np.pi / MAX_SYMMETRY_STEP))
    angles = 2 * np.pi / count * np.arange(count)
    R = Rotation.from_rotvec(angles[:, None] * axis / np.linalg.norm(axis)).as_matrix()
    return rigid(R, offset - R @ offset)


def _unit_fault(diameter: float, distances_mm: Sequence[float]) -> str:
    if diameter < 1:
        return f"a diameter of {diameter:.3g} (it looks like metres)"
    if not distances_mm:
        return ""
    distance = float(np.median(distances_mm))
    if diameter < 5 and distance > 100:
        return f"a diameter of {diameter:.3g} (it looks like metres) at a distance of {distance:.4g}"
    if distance < 0.1 * diameter:
        return f"a diameter of {diameter:.4g} at a distance of {distance:.3g} (cam_t_m2c looks like metres)"
    return ""


def _model_info(record: Any, where: str) -> ModelInfo:
    diameter = get_field(record, "diameter", where)
    if not (is_number(diameter) and np.isfinite(diameter) and diameter > 0):
        raise BadInput(f"{where}, field diameter", found=abbreviate(diameter), needed="a number > 0, in mm")
    given = enumerate(_list(record, "symmetries_discrete", where))
    discrete = [_discrete(value, f"{where}, symmetries_discrete {i}") for i, value in given]
    continuous = _list(record, "symmetries_continuous", where)
    inside = [f"{where}, symmetries_continuous {i}" for i in range(len(continuous))]
    axes = [get_numbers(symmetry, "axis", 3, place_) for symmetry, place_ in zip(continuous, inside, strict=True)]
    offsets = [get_numbers(symmetry, "offset", 3, place_) for symmetry, place_ in zip(continuous, inside, strict=True)]
    for axis, place_ in zip(axes, inside, strict=True):
        if not axis.any():
            raise BadInput(f"{place_}, field axis", found="a zero vector", needed="a direction")
    arrays = np.reshape(discrete, (-1, 4, 4)), np.reshape(axes, (-1, 3)), np.reshape(offsets, (-1, 3))
    return ModelInfo(float(diameter), symmetry_transforms(*arrays), _centre(record, where))


def _discrete(value: Any, where: str) -> Float[np.ndarray, "4 4"]:
    T = parse_vector(value, 16, where).reshape(4, 4)
    fault = describe_rotation_fault(T[:3, :3]) or (
        "" if np.allclose(T[3], [0, 0, 0, 1]) else f"a last row of {T[3].tolist()}"
    )
    if fault:
        raise BadInput(where, found=fault, needed="a rigid 4 x 4 matrix, row by row")
    return T


def _list(record: Any, field: str, where: str) -> list[Any]:
    value = record.get(field, [])
    if not isinstance(value, list):
        raise BadInput(f"{where}, field {field}", found=abbreviate(value), needed="a list")
    return value


def _centre(record: Any, where: str) -> Float[np.ndarray, " 3"] | None:
    names = [f"{kind}_{axis}" for kind in ("min", "size") for axis in "xyz"]
    if not all(name in record for name in names):
        return None
    low_and_size = parse_vector([record[name] for name in names], 6, f"{where}, fields min_x to size_z")
    return low_and_size[:3] + low_and_size[3:] / 2
