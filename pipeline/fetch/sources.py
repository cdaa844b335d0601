"""Where archives come from: the hub, a plain web folder, or a folder on this machine."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, cast

from pipeline.errors import BadInput
from pipeline.fetch.catalog import RemoteFile
from pipeline.fetch.transfer import remote_size, unreachable


@dataclass(frozen=True)
class Located:
    """A file that is there: its url, or its path on this machine; size and digest as pinned, else as stated there."""

    file: RemoteFile
    url: str = ""
    path: Path | None = None
    nbytes: int | None = None
    sha256: str | None = None


class Source(Protocol):
    """A place that has the published files."""

    @property
    def place(self) -> str:
        """For messages."""
        ...

    def locate(self, file: RemoteFile) -> Located:
        """The file there. Raises BadInput if it is missing, unreachable, or of another size than the pinned one."""
        ...


@dataclass(frozen=True)
class HubSource:
    """The hub's dataset repositories. ``endpoint`` None: the official hub, or HF_ENDPOINT."""

    endpoint: str | None = None

    @property
    def place(self) -> str:
        """For messages."""
        return self.endpoint or "the hub"

    def locate(self, file: RemoteFile) -> Located:
        """As Source.locate; the hub states size and sha256. No token is sent: the repositories are public."""
        from huggingface_hub import get_hf_file_metadata, hf_hub_url
        from huggingface_hub.errors import HfHubHTTPError

        # Its errors share a base with those of the HTTP library below it, which differs by version.
        http_error = cast(type[Exception], HfHubHTTPError.__bases__[0])
        url = hf_hub_url(file.repo, file.path, repo_type="dataset", revision=file.revision, endpoint=self.endpoint)
        try:
            stated = get_hf_file_metadata(url, token=False, endpoint=self.endpoint)
        except (http_error, OSError) as error:
            raise unreachable(url, error) from None
        digest = stated.etag if stated.etag and len(stated.etag) == 64 else None  # sha256; small files have a git id
        return _compare(file, url, Located(file, url=url, nbytes=stated.size, sha256=digest))


@dataclass(frozen=True)
class UrlSource:
    """A web folder that holds the files by name."""

    place: str

    def locate(self, file: RemoteFile) -> Located:
        """As Source.locate."""
        url = f"{self.place.rstrip('/')}/{file.name}"
        return _compare(file, url, Located(file, url=url, nbytes=remote_size(url)))


@dataclass(frozen=True)
class FolderSource:
    """A folder on this machine that holds the files by name."""

    place: str

    def locate(self, file: RemoteFile) -> Located:
        """As Source.locate."""
        path = Path(self.place).expanduser() / file.name
        if not path.is_file():
            raise BadInput(path, found="no such file", needed=f"{file.name} as {file.repo} on the hub has it")
        return _compare(file, str(path), Located(file, path=path, nbytes=path.stat().st_size))


def _compare(file: RemoteFile, where: str, found: Located) -> Located:
    """What was located, checked against what is pinned. Raises BadInput."""
    if file.nbytes is not None and found.nbytes is not None and found.nbytes != file.nbytes:
        raise BadInput(where, found=f"{found.nbytes} bytes", needed=f"the published {file.nbytes} bytes")
    if file.sha256 and found.sha256 and found.sha256 != file.sha256:
        raise BadInput(where, found=f"sha256 {found.sha256}", needed=f"the published {file.sha256}")
    return Located(file, found.url, found.path, file.nbytes or found.nbytes, file.sha256 or found.sha256)
