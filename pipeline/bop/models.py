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
from pipeline.io.digests import file_exists
from pipeline.io.meshes import prepare_mesh
from pipeline.items.objects import MeshFacts, ObjectModel

MAX_SYMMETRY_STEP = 0.01
"""Largest displacement of a vertex between neighbouring discretised symmetries, as a fraction of the diameter (BOP)."""


_UNITS = (("metres", 1000, 1.8), ("inches", 25.4, 1.1), ("centimetres", 10, 1.8), ("decimetres", 100, 1.8))
"""Units that a mesh may be in by mistake: mm per unit, and the tolerance of a ratio of diameters.

Some datasets state the bounding box's diagonal, which is up to 1.73 times the diameter.
"""


@dataclass(frozen=True, eq=False)
class ModelInfo:
    """An entry of models_info.json, mm. ``centre``: centre of the bounding box in the object frame, None if unknown."""

    diameter_mm: float
    symmetries: Float[np.ndarray, "s 4 4"]
    centre: Float[np.ndarray, " 3"] | None


def read_models_info(path: Path) -> dict[int, ModelInfo]:
    """Entries by object id; empty if the file is missing (diameters are then measured on the meshes)."""
    if not file_exists(path):
        return {}
    records = read_by_id(path).items()
    return {obj_id: _parse_model_info(record, describe_place(path, object=obj_id)) for obj_id, record in records}


def read_model(
    path: Path,
    obj_id: int,
    infos: dict[int, ModelInfo],
    *,
    distances_mm: Sequence[float] = (),
    simplify: int | None = None,
) -> ObjectModel:
    """The object of a mesh file, with at most ``simplify`` faces.

    ``distances_mm``: its annotated distances to the camera, to detect wrong units.
    Raises BadInput for a mesh that models_info.json (if it exists) does not list, and for lengths in different units.
    """
    check_model_files(path, obj_id, infos)
    mesh, facts = prepare_mesh(path, simplify=simplify)
    info = infos.get(obj_id)
    if info is not None:
        compare_diameters(path, facts, info)
    if fault := _describe_unit_fault(facts.diameter_mm, distances_mm):
        raise BadInput(path, found=fault, needed="mesh and cam_t_m2c both in millimetres")
    if info is None:
        return ObjectModel(obj_id, mesh, facts.diameter_mm, facts=facts)
    return ObjectModel(obj_id, mesh, info.diameter_mm, info.symmetries, facts)


def compare_diameters(path: Path, facts: MeshFacts, info: ModelInfo) -> str:
    """A warning if the diameter in models_info.json differs from the mesh's, "" if they agree.

    Raises BadInput if they seem to be in different units.
    """
    stated, measured = info.diameter_mm, facts.diameter_mm
    if abs(measured - stated) <= 0.1 * stated:
        return ""
    says = f"a mesh of diameter {measured:.4g}{{}} where models_info.json says {stated:.4g}"
    for unit, factor, tolerance in _UNITS:
        for of_mesh, ratio in ((True, stated / measured), (False, measured / stated)):
            if factor / tolerance < ratio < factor * tolerance:
                looks = f" (it looks like {unit})" if of_mesh else f" (models_info.json looks like {unit})"
                raise BadInput(path, found=says.format(looks), needed="both in millimetres")
    is_diagonal = abs(stated - facts.diagonal_mm) < 0.02 * facts.diagonal_mm
    hint = ", the diagonal of its bounding box" if is_diagonal else ""
    return f"{path.name}: found {says.format('')}{hint}; scores use models_info.json, as BOP's do"


def check_model_files(path: Path, obj_id: int, infos: dict[int, ModelInfo]) -> None:
    """Raise BadInput for an object without a mesh file, or that models_info.json (if it exists) does not list."""
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

    As bop_toolkit's get_symmetry_transformations with max_sym_disc_step = 0.01: each continuous symmetry becomes
    ceil(pi / 0.01) = 315 rotations about its axis, each composed with the identity and every discrete symmetry.
    """
    base = np.concatenate([np.eye(4)[None], discrete])
    if not len(axes):
        return base
    rotations = np.concatenate([_discretise(axis, offset) for axis, offset in zip(axes, offsets, strict=True)])
    return (rotations[None] @ base[:, None]).reshape(-1, 4, 4)


def _discretise(axis: Float[np.ndarray, " 3"], offset: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "n 4 4"]:
    """Equally spaced rotations about an axis through ``offset`` (mm), the identity first."""
    count = int(np.ceil(np.pi / MAX_SYMMETRY_STEP))
    angles = 2 * np.pi / count * np.arange(count)
    R = Rotation.from_rotvec(angles[:, None] * axis / np.linalg.norm(axis)).as_matrix()
    return rigid(R, offset - R @ offset)


def _describe_unit_fault(diameter: float, distances_mm: Sequence[float]) -> str:
    """Why the mesh or its distances cannot be in mm; "" if they may be."""
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


def _parse_model_info(record: Any, where: str) -> ModelInfo:
    diameter = get_field(record, "diameter", where)
    if not (is_number(diameter) and np.isfinite(diameter) and diameter > 0):
        raise BadInput(f"{where}, field diameter", found=abbreviate(diameter), needed="a number > 0, in mm")
    discrete = [
        _parse_discrete(value, f"{where}, symmetries_discrete {i}")
        for i, value in enumerate(_get_list(record, "symmetries_discrete", where))
    ]
    axes, offsets = [], []
    for i, symmetry in enumerate(_get_list(record, "symmetries_continuous", where)):
        axis, offset = _parse_continuous(symmetry, f"{where}, symmetries_continuous {i}")
        axes.append(axis)
        offsets.append(offset)
    arrays = np.reshape(discrete, (-1, 4, 4)), np.reshape(axes, (-1, 3)), np.reshape(offsets, (-1, 3))
    box = _parse_box(record, where)
    centre = None if box is None else box[:3] + box[3:] / 2
    return ModelInfo(float(diameter), symmetry_transforms(*arrays), centre)


def _parse_discrete(value: Any, where: str) -> Float[np.ndarray, "4 4"]:
    T = parse_vector(value, 16, where).reshape(4, 4)
    fault = describe_rotation_fault(T[:3, :3])
    if not fault and not np.allclose(T[3], [0, 0, 0, 1]):
        fault = f"a last row of {T[3].tolist()}"
    if fault:
        raise BadInput(where, found=fault, needed="a rigid 4 x 4 matrix, row by row")
    return T


def _parse_continuous(record: Any, where: str) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
    """Axis and offset (mm) of a continuous symmetry."""
    axis, offset = get_numbers(record, "axis", 3, where), get_numbers(record, "offset", 3, where)
    if not axis.any():
        raise BadInput(f"{where}, field axis", found="a zero vector", needed="a direction")
    return axis, offset


def _get_list(record: Any, field: str, where: str) -> list[Any]:
    value = record.get(field, [])
    if not isinstance(value, list):
        raise BadInput(f"{where}, field {field}", found=abbreviate(value), needed="a list")
    return value


def _parse_box(record: Any, where: str) -> Float[np.ndarray, " 6"] | None:
    """min_x, min_y, min_z, size_x, size_y, size_z of the bounding box; None if it is not given."""
    names = [f"{kind}_{axis}" for kind in ("min", "size") for axis in "xyz"]
    if not all(name in record for name in names):
        return None
    return parse_vector([record[name] for name in names], 6, f"{where}, fields min_x to size_z")
