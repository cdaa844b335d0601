"""url -> file, over HTTP: resumed where it broke off, also by a later process; with a bar, or with lines in a log."""

from __future__ import annotations

import http.client
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Protocol

from tqdm import tqdm

from pipeline.errors import BadInput, DzopError
from pipeline.io.files import write_error
from pipeline.progress import format_bytes

BLOCK = 1 << 20
TIMEOUT_S = 30.0
TRIES = 5  # in a row that bring nothing
PAUSE_S = 1.0  # before the second try; doubled before each further one
LOG_SHARE, LOG_S = 0.1, 30.0  # a log gets a line after this share of the file, and after this many seconds
AGENT = {"User-Agent": "dzop", "Accept-Encoding": "identity"}
RESUME = "run again to resume"


class Meter(Protocol):
    """Receives the number of bytes that are there."""

    def __call__(self, nbytes: int) -> None:
        """Show that ``nbytes`` of the file are there."""
        ...


@dataclass(eq=False)
class _Log:
    """Lines for a log: one per ``LOG_SHARE`` of the file or ``LOG_S`` seconds, whichever comes later."""

    title: str
    total: int | None
    shown: int = 0
    at: float = 0.0

    def __call__(self, nbytes: int) -> None:
        step = (self.total or 0) * LOG_SHARE
        if nbytes - self.shown < max(step, 1) or (time.monotonic() - self.at < LOG_S and nbytes != self.total):
            return
        of = "" if self.total is None else f" of {format_bytes(self.total)} ({nbytes / max(self.total, 1):.0%})"
        print(f"{self.title}: {format_bytes(nbytes)}{of}", flush=True)
        self.shown, self.at = nbytes, time.monotonic()


@contextmanager
def meter(title: str, total: int | None) -> Iterator[Meter]:
    """A progress bar of bytes on a terminal; elsewhere lines of text."""
    if not sys.stderr.isatty():
        yield _Log(title, total, at=time.monotonic())
        return
    with tqdm(total=total, desc=title, unit="B", unit_scale=True, dynamic_ncols=True) as bar:

        def show(nbytes: int) -> None:
            bar.update(nbytes - bar.n)

        yield show


def remote_size(url: str) -> int | None:
    """Size of a file in bytes; None if the server does not say. Raises BadInput for a missing one, or no network."""
    try:
        with urllib.request.urlopen(_request(url, method="HEAD"), timeout=TIMEOUT_S) as response:
            length = response.headers.get("Content-Length")
            return int(length) if length and length.isdigit() else None
    except (OSError, http.client.HTTPException, ValueError) as error:
        raise unreachable(url, error) from None


def download(url: str, path: Path, nbytes: int | None) -> None:
    """Download a file to ``path``, which may hold its beginning already.

    A broken connection is tried again, and what has arrived stays for the next call. ``nbytes``: its size if known.
    Raises DzopError if the connection stays broken or the disk is full, and BadInput if the server refuses.
    """
    have = path.stat().st_size if path.exists() else 0
    if nbytes is None or have > nbytes:  # no server can be asked for the bytes after an unknown end
        path.unlink(missing_ok=True)
        have = 0
    if have:
        print(f"{path.stem}: resuming at {format_bytes(have)}", flush=True)
    with meter(path.stem, nbytes) as show:
        failed = 0
        while nbytes is None or have < nbytes:
            try:
                if _append(url, path, have, show) and nbytes is None:
                    return
                problem = "the connection was closed"
            except urllib.error.HTTPError as error:
                if error.code < 500 and error.code not in (408, 429):
                    raise unreachable(url, error) from None
                problem = f"HTTP {error.code} {error.reason}"
            except (urllib.error.URLError, http.client.HTTPException, TimeoutError, ConnectionError) as error:
                problem = _reason(error)
            arrived = path.stat().st_size if path.exists() else 0
            failed = 0 if arrived > have else failed + 1
            have = arrived
            if failed >= TRIES:
                of = "" if nbytes is None else f" of {format_bytes(nbytes)}"
                raise DzopError(f"{url}: {problem} after {format_bytes(have)}{of}; {RESUME}")
            if failed:
                time.sleep(PAUSE_S * 2 ** (failed - 1))


def _append(url: str, path: Path, have: int, show: Meter) -> bool:
    """One request for the bytes from ``have`` on, appended to ``path``. True when the server has sent all it stated."""
    headers = {"Range": f"bytes={have}-"} if have else {}
    with urllib.request.urlopen(_request(url, headers=headers), timeout=TIMEOUT_S) as response:
        partial = response.status == http.client.PARTIAL_CONTENT
        if partial and not (response.headers.get("Content-Range") or "").startswith(f"bytes {have}-"):
            raise http.client.HTTPException(f"the server sent other bytes than those from {have} on")
        have = have if partial else 0  # a server that ignores the range sends the file from its beginning
        length = response.headers.get("Content-Length")
        end = have + int(length) if length and length.isdigit() else None
        try:
            with path.open("ab" if partial else "wb") as file:
                while block := response.read(BLOCK):
                    file.write(block)
                    have += len(block)
                    show(have)
        except OSError as error:
            if error.errno is None or isinstance(error, TimeoutError | ConnectionError):
                raise
            raise write_error(path, error) from None
    return end is None or have >= end


def _request(
    url: str, *, method: str = "GET", headers: Mapping[str, str] = MappingProxyType({})
) -> urllib.request.Request:
    return urllib.request.Request(url, method=method, headers={**AGENT, **headers})


def unreachable(url: str, error: Exception) -> BadInput:
    """The error to raise for a file that a server does not give: what it said, or why there is no connection."""
    code = getattr(error, "code", None) or getattr(getattr(error, "response", None), "status_code", None)
    if code == http.client.NOT_FOUND:
        return BadInput(url, found="no such file there (HTTP 404)", needed="a place that has it: --from URL or FOLDER")
    if code is not None:
        return BadInput(url, found=f"a refusal (HTTP {code})", needed="a place that gives it: --from URL or FOLDER")
    needed = "a network connection, or the archives on this machine: --from FOLDER"
    return BadInput(url, found=f"no connection ({_reason(error)})", needed=needed)


def _reason(error: Exception) -> str:
    reason = getattr(error, "reason", None) or error
    text = getattr(reason, "strerror", None) or str(reason) or type(error).__name__
    return " ".join(str(text).split())[:200]
