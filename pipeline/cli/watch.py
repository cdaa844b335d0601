"""``dzop watch``: estimate the poses of new photographs in a folder with one process that stays warm."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.bop.photo import Photo, find_photograph
from pipeline.configuration import build_variant, compose_settings
from pipeline.errors import BadInput, DzopError
from pipeline.estimator import PoseEstimator
from pipeline.io.digests import track_files
from pipeline.outputs.photo_files import link_latest, save_results
from pipeline.outputs.pose_result import PoseResult

SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp")
PATIENCE_S = 5.0  # a file that cannot be read is reported once it has not changed for this long
UNSET = ("dataset=photo", "dataset.image=none", "dataset.mesh=none", "dataset.K=none")
Stamp = tuple[int, int]
"""Size and time of change of a file."""


def watch_command(arguments: Sequence[str]) -> None:
    """``dzop watch FOLDER NAME=VALUE ...``: watch until Ctrl-C; with --once, stop when nothing is left to do."""
    options = _parser().parse_args(arguments)
    folder = Path(options.folder).expanduser()
    if not folder.is_dir():
        raise BadInput(folder, found="no such folder", needed="the folder that photographs are written to")
    given = _read_settings(options.settings)
    with PoseEstimator.from_mesh(given["mesh"], settings=options.settings) as estimator:
        watcher = Watcher(folder, Path(options.out), given, estimator)
        print(f"watching {folder}; stop with Ctrl-C", flush=True)
        try:
            while watcher.step() or not options.once:
                time.sleep(options.every)
        except KeyboardInterrupt:
            pass
    print(f"stopped: {watcher.done} photographs, results in {options.out}")


@dataclass(eq=False)
class Watcher:
    """Photographs of a folder and what became of them. ``given``: the fields of ``dataset``, without ``image``."""

    folder: Path
    out: Path
    given: dict[str, Any]
    estimator: PoseEstimator
    done: int = 0
    _seen: dict[Path, tuple[Stamp, float]] = field(default_factory=dict)
    _settled: dict[Path, Stamp] = field(default_factory=dict)
    _before: list[PoseResult] = field(default_factory=list)

    def step(self) -> bool:
        """Process every photograph that is complete; whether some are still waited for."""
        waiting = False
        photos = [path for path in sorted(self.folder.iterdir()) if _is_picture(path)]
        for path in photos:
            stamp = _stamp(path)
            if self._settled.get(path) == stamp:
                continue
            masks = self._masks(path, photos)
            if not self._is_still([path, *masks]) or (self.given["mask"] is not None and not masks):
                waiting = True
                continue
            if self._process(path, masks):
                self._settled[path] = stamp
            else:
                waiting = True
        return waiting

    def _is_still(self, paths: Sequence[Path]) -> bool:
        """Whether no file has changed since the last look."""
        still = True
        for path in paths:
            stamp = _stamp(path)
            if path not in self._seen or self._seen[path][0] != stamp:
                self._seen[path] = (stamp, time.monotonic())
                still = False
        return still

    def _masks(self, path: Path, photos: Sequence[Path]) -> list[Path]:
        """The masks of a photograph, by name as with ``dataset=photo``. ``photos``: all in the folder."""
        if self.given["mask"] is None:
            return []
        folder = Path(self.given["mask"]).expanduser()
        files = sorted(folder.iterdir()) if folder.is_dir() else []
        return [f for f in files if f != path and _is_picture(f) and find_photograph(f, photos) == path.stem]

    def _process(self, path: Path, masks: Sequence[Path]) -> bool:
        """Estimate and write the poses of a photograph; False if it may still be incomplete."""
        try:
            with track_files():
                results, note = self._estimate(path, masks)
        except DzopError as error:
            if time.monotonic() - max(self._seen[file][1] for file in (path, *masks)) < PATIENCE_S:
                return False
            print(f"{path.name}: error: {error}", file=sys.stderr, flush=True)
            return True
        save_results(results, self.out / path.stem, image=str(path), note=note)
        link_latest(self.out / path.stem)
        for result in results:
            print(f"{path.name}: {result.summary()}", flush=True)
        self.done, self._before = self.done + 1, results
        return True

    def _estimate(self, path: Path, masks: Sequence[Path]) -> tuple[list[PoseResult], str]:
        fields = self.given | {"image": str(path), "mask": tuple(map(str, masks)) or None}
        photo: Photo = build_variant(fields, "dataset").open()
        rgb = photo.image(0, 0).rgb
        name, (target,) = self.estimator.names[0], photo.targets
        priors = {name: self._before} if self.given["video"] and len(self._before) == target.inst_count else None
        results = self.estimator.find(rgb, photo.camera_matrix, {name: _locate(photo)}, priors=priors)
        return list(results), photo.image_note


def _locate(photo: Photo) -> list[Any]:
    """The masks, or the box [x, y, width, height], of a photograph's instances. Raises BadInput for none."""
    size_hw = photo.image_size(0, 0)
    if photo.masks:
        labels = photo.mask_label if isinstance(photo.mask_label, tuple) else (photo.mask_label,)
        return [photo.object_mask(path, size_hw, label=label) for path in photo.masks[0] for label in labels]
    ((x0, y0, x1, y1),) = [detection.bbox_xyxy for detection in photo.locate(photo.targets[0])]
    return [np.array([x0 + 0.5, y0 + 0.5, x1 - x0, y1 - y0])]


def _read_settings(settings: Sequence[str]) -> dict[str, Any]:
    """The fields of ``dataset`` on the command line, checked as far as they concern no photograph. Raises BadInput."""
    given: dict[str, Any] = compose_settings([*UNSET, *settings])["dataset"]
    for name, needed in (("mesh", "the file of a mesh"), ("K", "[fx,fy,cx,cy] in pixels, or a camera file")):
        if given[name] == "none":
            raise BadInput(f"dataset.{name}", found="nothing", needed=needed)
    if not isinstance(given["mesh"], str):
        raise BadInput("dataset.mesh", found=f"{len(given['mesh'])} meshes", needed="one")
    if given["depth"] is not None:
        raise BadInput("dataset.depth", found="with watch", needed="dataset=photo, or the Python API")
    if (given["mask"] is None) == (given["bbox"] is None):
        found = "neither of mask and bbox" if given["mask"] is None else "mask and bbox"
        raise BadInput("dataset", found=found, needed="dataset.mask=FOLDER of masks, or dataset.bbox=[x,y,w,h]")
    return given


def _is_picture(path: Path) -> bool:
    return path.suffix.lower() in SUFFIXES and not path.name.startswith(".") and path.is_file()


def _stamp(path: Path) -> Stamp:
    try:
        found = path.stat()
    except OSError:
        return (0, 0)
    return (found.st_size, found.st_mtime_ns)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="dzop watch",
        description="Estimate the pose in every photograph of a folder, now and when new ones arrive.",
        epilog="dzop watch shots dataset.mesh=mug.ply 'dataset.K=[600,600,320,240]' dataset.mask=masks",
    )
    add, default = parser.add_argument, "(default: %(default)s)"
    add("folder", help="folder that photographs are written to")
    add("settings", nargs="*", metavar="NAME=VALUE", help="as with dataset=photo; dataset.mask is a folder of masks")
    add("--out", default="results", help=f"folder of results, one for each photograph {default}")
    add("--every", type=float, default=0.5, help=f"seconds between two looks at the folder {default}")
    add("--once", action="store_true", help="stop when every photograph in the folder is processed")
    return parser
