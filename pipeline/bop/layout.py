"""Folders of a dataset, with hints for common mistakes: archives, a root too deep or too high, another sensor."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Iterable
from pathlib import Path

from pipeline.bop.jsonio import describe_place
from pipeline.errors import BadInput
from pipeline.io.digests import file_exists
from pipeline.io.meshes import SUFFIXES

_ARCHIVES = (".zip", ".tar", ".gz", ".tgz", ".xz", ".bz2", ".7z", ".rar", ".z01")
_MAX_LISTED = 12
_SENSOR = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")


def check_folders(root: Path, split: str, models: str) -> None:
    """Raise BadInput for a missing folder, suggesting the folder probably meant or listing what exists."""
    if root.is_file():
        raise BadInput(root, found=_describe_file(root), needed="the folder of the dataset (unpack an archive first)")
    if not root.is_dir():
        _raise_missing(root, "the dataset", (p for p in _list_folders(root.parent)))
    split_is_there, models_are_there = _has_scenes(root / split), _has_meshes(root / models)
    if split_is_there and models_are_there:
        return
    if not split_is_there and (meant := _find_root(root, split, models)):
        found, needed = f"no scenes in {split}", f"dataset.root={meant}, which has {split} and {models}"
        raise BadInput(root, found=found, needed=needed)
    for folder, what, is_candidate in (
        (root / split, "a split", _has_scenes),
        (root / models, "object models", _has_meshes),
    ):
        if not folder.is_dir():
            _raise_missing(folder, what, (p for p in _list_folders(root) if is_candidate(p)))
        deeper = [p for p in _list_folders(folder) if is_candidate(p)]
        if deeper and not is_candidate(folder):
            raise BadInput(folder, found=f"a folder within: {deeper[0].name}", needed=f"{what}, not one level deeper")


def check_scene_folder(folder: Path, scene_id: int, sensor: str = "") -> None:
    """Raise BadInput for a missing scene, or one without files of the chosen sensor; lists the sensors it has."""
    where = describe_place(folder, scene=scene_id)
    if not folder.is_dir():
        there = [p.name for p in _list_folders(folder.parent)] + _list_archives(folder.parent)
        raise BadInput(where, found=f"no such folder{_hint(there)}", needed="the scene's folder")
    name = f"scene_camera_{sensor}.json" if sensor else "scene_camera.json"
    sensors = sorted(p.stem.removeprefix("scene_camera_") for p in folder.glob("scene_camera_*.json"))
    if file_exists(folder / name) or not (sensor or sensors):
        return
    if not sensors:
        raise BadInput(where, found=f"no {name}, and no other sensor's", needed="dataset.sensor=null")
    found = f"files of the sensors {', '.join(sensors[:_MAX_LISTED])} and no {name}"
    raise BadInput(where, found=found, needed=f"dataset.sensor, one of them, such as dataset.sensor={sensors[0]}")


def check_sensor_name(sensor: str | None) -> str:
    """The sensor's name, "" for None. Raises BadInput for a name that no file can have."""
    if sensor is not None and not _SENSOR.fullmatch(sensor):
        raise BadInput("dataset.sensor", found=repr(sensor), needed="a sensor's name, such as cam1 or photoneo")
    return sensor or ""


def find_model(folder: Path, obj_id: int) -> Path:
    """The object's mesh: the ply if there is one, else the first that exists in another format, else the ply's path."""
    paths = [folder / f"obj_{obj_id:06d}{suffix}" for suffix in SUFFIXES]
    return next((path for path in paths if file_exists(path)), paths[0])


def _raise_missing(path: Path, what: str, candidates: Iterable[Path]) -> None:
    there = sorted(p.name for p in candidates)
    there += [f"{name}, to be unpacked" for name in _list_archives(path.parent)]
    found = f"{_describe_file(path)}" if path.is_file() else "no such folder"
    raise BadInput(path, found=found, needed=f"the folder of {what}{_hint(there)}")


def _find_root(root: Path, split: str, models: str) -> Path | None:
    """A folder below or above ``root`` that has the split and the models."""
    below = [child for child in _list_folders(root) if child.name not in (split, models)]
    folders = [*below, *root.absolute().parents[:3]]
    return next((p for p in folders if _has_scenes(p / split) and _has_meshes(p / models)), None)


def _has_scenes(folder: Path) -> bool:
    return any(folder.glob("[0-9]" * 6))


def _has_meshes(folder: Path) -> bool:
    return any(path.suffix.lower() in SUFFIXES for path in folder.glob("obj_*"))


def _list_folders(folder: Path) -> list[Path]:
    try:
        return sorted(path for path in folder.iterdir() if path.is_dir())
    except OSError:
        return []


def _list_archives(folder: Path) -> list[str]:
    try:
        return sorted(path.name for path in folder.iterdir() if path.suffix.lower() in _ARCHIVES and path.is_file())
    except OSError:
        return []


def _describe_file(path: Path) -> str:
    is_archive = path.suffix.lower() in _ARCHIVES or zipfile.is_zipfile(path)
    return "an archive in place of its folder" if is_archive else "a file in place of a folder"


def _hint(there: list[str]) -> str:
    return f" (there: {', '.join(there[:_MAX_LISTED])})" if there else ""
