"""Results of one photograph -> pose.json, overlay.jpg and pose.html in a folder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from os import PathLike
from pathlib import Path
from typing import Any

from jaxtyping import UInt8
from numpy import ndarray

from pipeline.bop.jsonio import read_json
from pipeline.errors import BadInput
from pipeline.io.files import unique_suffix, write_atomic, write_error, write_json
from pipeline.outputs.pose_result import PoseResult, draw_results
from pipeline.report.overlay import shows, write_overlay
from pipeline.report.pose_page import PosePage, ShownPose
from pipeline.report.scene_page import scene_html

FRAME = (
    "T_cam_obj maps points of the object to the camera, p_cam = T_cam_obj p_obj, in millimetres. Camera: origin in the "
    "optical centre, x right, y down, z forward (OpenCV). Object: coordinates of the mesh file, "
    "converted to millimetres (dataset.units, dataset.scale)."
)
LATEST = "latest"
Cards = Sequence[UInt8[ndarray, "_H _W 3"] | None]


def save_results(
    results: Sequence[PoseResult],
    folder: str | PathLike[str],
    *,
    image: str = "",
    more: dict[str, Any] | None = None,
    overlay: bool = True,
    cards: Callable[[], Cards] | None = None,
    note: str = "",
) -> list[Path]:
    """Write results of one image to a folder: with ``overlay`` overlay.jpg and pose.html, and last pose.json.

    ``image``: the photograph's file. ``more``: further fields of pose.json. ``cards``: draws the figures of
    how each pose was found, for the page. ``note``: how the photograph was changed. Returns the files. Raises
    DzopError.
    """
    to, made_from = Path(folder), str((more or {}).get("made_from", ""))
    pictures = [to / "overlay.jpg", to / "pose.html"]
    if overlay:
        drawn = draw_results(results)
        page = _page(results, drawn, title=image or to.name, cards=cards() if cards else (), note=note)
        write_overlay(pictures[0], drawn, made_from=made_from or None)
        write_atomic(pictures[1], page.html() + _mark(made_from))
    else:
        _remove(pictures)  # of other results, which pose.json would seem to describe
    _write_json(to, results, image=image, more=more or {})
    return [to / "pose.json", *(pictures if overlay else [])]


def holds_results(folder: Path, made_from: str, *, overlay: bool) -> bool:
    """Whether ``save_results`` has written all files of a folder with this ``made_from`` as a field of pose.json."""
    try:
        record = read_json(folder / "pose.json")
        if not isinstance(record, dict) or record.get("made_from") != made_from:
            return False
        if not overlay:
            return True
        page = (folder / "pose.html").read_text()
    except (BadInput, OSError, ValueError):
        return False
    return page.endswith(_mark(made_from)) and shows(folder / "overlay.jpg", made_from)


def _mark(made_from: str) -> str:
    """The end of a page, which says what it was made from."""
    return f"<!-- {made_from} -->\n" if made_from else ""


def _remove(files: Sequence[Path]) -> None:
    for path in files:
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            raise write_error(path, error) from None


def link_latest(folder: Path) -> None:
    """Link ``latest``, beside the folder, to it, if the file system supports symbolic links."""
    link = folder.parent / LATEST
    new = folder.parent / f".{LATEST}.{unique_suffix()}.partial"
    if link.exists() and not link.is_symlink():
        return
    with suppress(OSError):
        new.symlink_to(folder.name, target_is_directory=True)
        new.replace(link)


def _write_json(folder: Path, results: Sequence[PoseResult], *, image: str, more: dict[str, Any]) -> None:
    shown = results[0].image
    record = {
        "image": image,
        "K": None if shown is None else [float(shown.K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2))],
        "units": "mm",
        "frame": FRAME,
        "warnings": _warnings(results),
        **more,
        "poses": [result.to_record() for result in results],
    }
    write_json(folder / "pose.json", record)


def _page(results: Sequence[PoseResult], drawn: ndarray, *, title: str, cards: Cards, note: str) -> PosePage:
    image = results[0].image
    assert image is not None
    given = [*cards, *[None] * (len(results) - len(cards))]
    placed = [(r.model.mesh, r.T_cam_obj) for r in results if r.model is not None and r.T_cam_obj is not None]
    h, w = image.rgb.shape[:2]
    return PosePage(
        title,
        image.rgb,
        drawn,
        [
            ShownPose(r.name, r.summary(), r.T_cam_obj, card, r.alternatives)
            for r, card in zip(results, given, strict=True)
        ],
        _warnings(results),
        scene_html(placed, image.K, (h, w)) if placed else "",
        note,
    )


def _warnings(results: Sequence[PoseResult]) -> list[str]:
    return list(dict.fromkeys(text for result in results for text in result.warnings))
