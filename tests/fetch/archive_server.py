"""A web server with archives, as the hub serves them and as a plain folder, whose connections break on demand."""

import threading
from collections import Counter
from dataclasses import dataclass, field
from hashlib import sha256
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

COMMIT = "0123456789abcdef0123456789abcdef01234567"


@dataclass
class ArchiveServer:
    """Serves ``files`` (name -> content) below any path that ends with the name.

    ``breaks``: for each of the next downloads the number of bytes after which its connection is closed. ``stated``:
    digests that are not those of the content. ``refuses``: status by name. ``sent`` and ``asked``: bytes and downloads
    by name.
    """

    files: dict[str, bytes]
    breaks: list[int] = field(default_factory=list)
    stated: dict[str, str] = field(default_factory=dict)
    refuses: dict[str, int] = field(default_factory=dict)
    ignores_ranges: bool = False
    sent: Counter = field(default_factory=Counter)
    asked: Counter = field(default_factory=Counter)

    def __enter__(self):
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), _handler(self))
        self._server.daemon_threads = True
        threading.Thread(target=self._server.serve_forever, args=(0.02,), daemon=True).start()
        return self

    def __exit__(self, *_):
        self._server.shutdown()
        self._server.server_close()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self._server.server_port}"


def _handler(server: ArchiveServer) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        def log_message(self, *_):
            """Print nothing."""

        def do_HEAD(self):
            self._answer(with_content=False)

        def do_GET(self):
            self._answer(with_content=True)

        def _answer(self, *, with_content: bool):
            name = self.path.rsplit("/", 1)[-1]
            server.asked[name] += with_content
            status = server.refuses.get(name, 200 if name in server.files else 404)
            if status != 200:
                self.send_response(status)
                self.send_header("Content-Length", "0")
                self.end_headers()
                return
            content, start = server.files[name], 0
            asked = self.headers.get("Range")
            if asked and not server.ignores_ranges:
                start = int(asked.removeprefix("bytes=").rstrip("-"))
            self.send_response(206 if start else 200)
            if start:
                self.send_header("Content-Range", f"bytes {start}-{len(content) - 1}/{len(content)}")
            self.send_header("Content-Length", str(len(content) - start))
            if "/resolve/" in self.path:
                digest = server.stated.get(name, sha256(content).hexdigest())
                self.send_header("X-Repo-Commit", COMMIT)
                self.send_header("X-Linked-Size", str(len(content)))
                self.send_header("X-Linked-ETag", f'"{digest}"')
            self.end_headers()
            if with_content:
                end = min(len(content), start + server.breaks.pop(0)) if server.breaks else len(content)
                server.sent[name] += end - start  # first, because the client may have all bytes before write returns
                self.wfile.write(content[start:end])

    return Handler
