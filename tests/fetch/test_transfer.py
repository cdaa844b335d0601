"""One file from a server: of known and unknown size, from a busy server, and onto a full disk."""

import errno
import io
from pathlib import Path

import pytest
from archive_server import ArchiveServer

from pipeline.errors import BadInput, DzopError
from pipeline.fetch.transfer import TRIES, download, meter

NAME, CONTENT = "part.zip", bytes(range(256)) * 40


@pytest.fixture
def server(monkeypatch):
    monkeypatch.setattr("pipeline.fetch.transfer.PAUSE_S", 0.0)
    with ArchiveServer({NAME: CONTENT}) as running:
        yield running


@pytest.mark.parametrize("nbytes", [len(CONTENT), None])
@pytest.mark.parametrize("there", [b"", CONTENT + b"more"], ids=["no beginning", "more than the file"])
def test_a_file_arrives_whole_whatever_lay_in_its_place(server, tmp_path, nbytes, there):
    path = tmp_path / f"{NAME}.partial"
    path.write_bytes(there)
    download(f"{server.url}/{NAME}", path, nbytes)
    assert path.read_bytes() == CONTENT


def test_a_busy_server_is_asked_again_before_the_error_names_its_status(server, tmp_path):
    server.refuses[NAME] = 503
    with pytest.raises(DzopError, match=rf"{NAME}: HTTP 503 Service Unavailable after 0 B of 10\.2 kB; .*resume"):
        download(f"{server.url}/{NAME}", tmp_path / NAME, len(CONTENT))
    assert server.asked[NAME] == TRIES


def test_a_refusal_is_not_asked_again(server, tmp_path):
    server.refuses[NAME] = 403
    with pytest.raises(BadInput, match=rf"{NAME}: found a refusal \(HTTP 403\), needs a place that gives it"):
        download(f"{server.url}/{NAME}", tmp_path / NAME, len(CONTENT))
    assert server.asked[NAME] == 1


def test_a_disk_that_fills_during_a_download_is_named(server, tmp_path, monkeypatch):
    def full(self: Path, *_, **__):
        raise OSError(errno.ENOSPC, "No space left on device", str(self))

    monkeypatch.setattr(Path, "open", full)
    with pytest.raises(DzopError, match=rf"{NAME}: the disk is full; make room"):
        download(f"{server.url}/{NAME}", tmp_path / NAME, len(CONTENT))


def test_a_terminal_shows_a_bar_that_follows_the_bytes(monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    shown = Terminal()
    monkeypatch.setattr("sys.stderr", shown)
    with meter(NAME, 2000) as show:
        show(500)
        show(2000)
    assert NAME in shown.getvalue()
    assert "100%" in shown.getvalue()
