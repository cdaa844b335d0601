"""zip archives -> a folder: nothing outside it, and nothing before the disk has room for all of it."""

from __future__ import annotations

import lzma
import shutil
import stat
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from tqdm import tqdm

from pipeline.errors import BadInput, DzopError
from pipeline.io.files import write_error
from pipeline.progress import format_bytes

_RESERVE = 1 << 24  # bytes that stay free


def check_room(folder: Path, nbytes: int, purpose: str) -> None:
    """Raise DzopError unless the disk of ``folder``, which need not exist yet, has room for ``nbytes``."""
    existing = next(parent for parent in (folder, *folder.absolute().parents) if parent.exists())
    try:
        free = shutil.disk_usage(existing).free
    except OSError as error:
        raise write_error(folder, error) from None
    if free < nbytes + _RESERVE:
        found, needed = format_bytes(free), format_bytes(nbytes + _RESERVE)
        raise DzopError(f"{folder}: found {found} free on its disk, needs {needed} for {purpose}; nothing was written")


def unpack(archives: Sequence[Path], name: str, folder: Path) -> None:
    """Unpack all archives into ``folder``; a first level that is only the dataset's name is left out.

    Raises BadInput for an archive that is damaged or has a member outside the folder, DzopError without room for all.
    """
    members = {archive: _members(archive, name) for archive in archives}
    total = sum(info.file_size for infos in members.values() for info, _ in infos)
    check_room(folder, total, f"{format_bytes(total)} of unpacked files")
    count = sum(map(len, members.values()))
    with tqdm(total=count, desc=f"unpacking {name}", unit="file", disable=None, dynamic_ncols=True) as bar:
        for archive, infos in members.items():
            with zipfile.ZipFile(archive) as opened:
                for info, path in infos:
                    _extract(archive, opened, info, folder / path)
                    bar.update()


def _members(archive: Path, name: str) -> list[tuple[zipfile.ZipInfo, PurePosixPath]]:
    """Files of an archive with their paths in the folder. Raises BadInput."""
    try:
        with zipfile.ZipFile(archive) as opened:
            infos = [info for info in opened.infolist() if not info.is_dir()]
    except (zipfile.BadZipFile, NotImplementedError, ValueError) as error:
        raise BadInput(archive, found=f"no readable zip archive ({error})", needed="the published archive") from None
    paths = [_checked_path(archive, info) for info in infos]
    nested = bool(paths) and all(path.parts[0] == name and len(path.parts) > 1 for path in paths)
    return [(info, PurePosixPath(*path.parts[nested:])) for info, path in zip(infos, paths, strict=True)]


def _checked_path(archive: Path, info: zipfile.ZipInfo) -> PurePosixPath:
    """A member's path. Raises BadInput for one that is absolute, leads upwards, or is a link."""
    text = info.filename
    path = PurePosixPath(text)
    needed = "files inside the dataset's folder; nothing was unpacked"
    if not path.parts or path.is_absolute() or ".." in path.parts or "\\" in text or ":" in path.parts[0]:
        raise BadInput(archive, found=f"a member named {text[:200]!r}", needed=needed)
    mode = info.external_attr >> 16
    if mode and not (stat.S_ISREG(mode) or stat.S_IFMT(mode) == 0):
        raise BadInput(archive, found=f"the member {text[:200]!r}, a link or device", needed=needed)
    return path


def _extract(archive: Path, opened: zipfile.ZipFile, info: zipfile.ZipInfo, path: Path) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with opened.open(info) as source, path.open("xb") as target:
            shutil.copyfileobj(source, target, 1 << 20)
    except (zipfile.BadZipFile, zlib.error, lzma.LZMAError, EOFError, RuntimeError, NotImplementedError) as error:
        where = f"{archive}, member {info.filename}"
        raise BadInput(where, found=f"damaged data ({error})", needed="the published archive") from None
    except FileExistsError:
        raise BadInput(f"{archive}, member {info.filename}", found="the name twice", needed="each file once") from None
    except OSError as error:
        raise write_error(path, error) from None
