"""``dzop symmetry``: find the symmetries of meshes and write them as models_info.json."""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from pathlib import Path
from typing import get_args

from pipeline.bop.given import MeshFiles, Unit
from pipeline.bop.symmetries import info_record, mesh_symmetries
from pipeline.errors import BadInput
from pipeline.functional.symmetry import Symmetries
from pipeline.io.files import write_json


def symmetry_command(arguments: Sequence[str]) -> None:
    """``dzop symmetry MESH ...``: print the symmetries of each mesh; with --out, write them. Raises BadInput."""
    options = _parser().parse_args(arguments)
    records = {}
    for number, path in enumerate(map(Path, options.meshes), start=1):
        model = MeshFiles((path,), scale=options.scale, units=options.units).model(1)
        geometric, visible = mesh_symmetries(model.mesh, model.diameter_mm)
        print(f"{path.name}\n  geometry    {geometric.text}\n  appearance  {visible.text}", flush=True)
        obj_id = _object_id(path, number)
        if obj_id in records:
            raise BadInput(path, found=f"object {obj_id} twice", needed="meshes named obj_000001.ply, obj_000002.ply")
        chosen: Symmetries = geometric if options.geometry else visible
        records[obj_id] = info_record(model.mesh, model.diameter_mm, chosen)
    if options.out is not None:
        write_json(Path(options.out), {str(obj_id): record for obj_id, record in sorted(records.items())})
        print(f"written   {options.out}")


def _object_id(path: Path, number: int) -> int:
    """The id in BOP's file name obj_000005.ply, otherwise the position on the command line."""
    named = re.fullmatch(r"obj_(\d{1,9})", path.stem)
    return int(named[1]) if named else number


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="dzop symmetry",
        description="Find the symmetries of meshes: those of the shape, and those that also preserve the colours.",
    )
    add = parser.add_argument
    add("meshes", nargs="+", help="mesh files, in millimetres without --units")
    add("--out", help="models_info.json to write: diameter, bounding box and symmetries of each mesh")
    add("--geometry", action="store_true", help="write the symmetries of the shape, whatever the colours")
    add("--units", choices=get_args(Unit), default="mm", help="of the meshes (default: mm)")
    add("--scale", type=float, default=1.0, help="multiplies the meshes, for any other unit (default: 1)")
    return parser
