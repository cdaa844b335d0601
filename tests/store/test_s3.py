"""A store on S3: server faults and damaged chunks are reported in one line; two writers may write one entry."""

import multiprocessing
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest

import pipeline.store.journal
from pipeline.errors import BadInput
from pipeline.store import DamagedEntry, S3StoreConfig, Store
from pipeline.store.remote import StoreUnreachable
from tests.store.test_store import LAYOUT, REF, ROWS, compute, fill, values


def chunk_key(s3) -> str:
    """Key of row 3 of the entry, in the folder that its completion record names."""
    return f"cache/{REF.path}/{Store(s3.config()).read(REF).record['folder']}/maps/c.3.0.0"


def test_a_flipped_byte_and_a_missing_chunk_are_detected_and_repaired(s3):
    store = Store(s3.config())
    fill(store)
    intact = s3.get(chunk_key(s3))
    for damaged in (bytes([intact[0] ^ 1]) + intact[1:], intact[:-3], None):
        chunk = chunk_key(s3)
        s3.delete(chunk) if damaged is None else s3.put(chunk, damaged)
        with pytest.raises(DamagedEntry, match="run again to recompute only what is damaged"):
            store.read(REF).array("maps")
        log: list[list[int]] = []
        fill(store, log)
        assert log == [[0, 1, 2, 3]]
        assert s3.get(chunk_key(s3)) == intact
        np.testing.assert_array_equal(store.read(REF).array("maps"), values(list(range(ROWS))))


def test_a_missing_bucket_is_reported_in_one_line(s3):
    with pytest.raises(StoreUnreachable, match="s3://no-such-bucket/cache: the bucket does not exist"):
        Store(s3.config(url="s3://no-such-bucket/cache"))


@pytest.mark.parametrize("url", ["bucket/cache", "s3://", "s3:///"])
def test_a_url_without_a_bucket_is_reported_in_one_line(url):
    with pytest.raises(BadInput, match=r"store.url: found .*, needs s3://bucket/prefix"):
        S3StoreConfig(url=url).open()


def test_a_malformed_endpoint_is_reported_in_one_line(s3):
    with pytest.raises(BadInput, match=r"store.endpoint_url: found .*, needs a URL"):
        Store(s3.config(endpoint_url="somewhere"))


def test_missing_credentials_are_reported_in_one_line(s3, monkeypatch):
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(name)
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    with pytest.raises(StoreUnreachable, match="found no AWS credentials; set AWS_ACCESS_KEY_ID"):
        Store(s3.config(timeout_s=7.0))


def test_a_refused_connection_is_reported_in_one_line():
    pytest.importorskip("s3fs", reason="needs s3fs: pip install --editable '.[s3]'")
    with pytest.raises(StoreUnreachable, match="run again when it answers: completed entries are kept"):
        Store(S3StoreConfig(url="s3://bucket/cache", endpoint_url="http://127.0.0.1:1", anonymous=True))


def test_a_server_that_never_answers_times_out(s3):
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        silent.listen(64)
        url = f"http://127.0.0.1:{silent.getsockname()[1]}"
        with pytest.raises(StoreUnreachable, match=r"timeout|no answer within"):
            Store(s3.config(endpoint_url=url, timeout_s=0.05))


class Faulty(BaseHTTPRequestHandler):
    """A proxy that fails the requests selected by ``server.faults`` and forwards the others."""

    protocol_version = "HTTP/1.1"

    def log_message(self, *args) -> None: ...

    def _pass(self) -> None:
        import http.client

        body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        if self.server.faults(self.command, self.path):
            self._answer(
                self.server.status, b"<Error><Code>InternalError</Code><Message>injected</Message></Error>", {}
            )
            return
        there = http.client.HTTPConnection(self.server.behind)
        there.request(self.command, self.path, body, dict(self.headers))
        answer = there.getresponse()
        content = answer.read()
        self._answer(answer.status, content, dict(answer.getheaders()))
        there.close()

    def _answer(self, status: int, body: bytes, headers: dict[str, str]) -> None:
        self.send_response_only(status)
        length = headers.get("Content-Length", "0") if self.command == "HEAD" else str(len(body))
        kept = {
            n: v for n, v in headers.items() if n.lower() not in ("content-length", "connection", "transfer-encoding")
        }
        for name, value in (kept | {"Content-Length": length}).items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    do_GET = do_PUT = do_POST = do_DELETE = do_HEAD = _pass  # noqa: N815


@contextmanager
def faulty(s3) -> Iterator[ThreadingHTTPServer]:
    server = ThreadingHTTPServer(("127.0.0.1", 0), Faulty)
    server.behind, server.status = s3.endpoint_url.removeprefix("http://"), 500
    server.faults = lambda command, path: False
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield server
    server.shutdown()
    server.server_close()


@pytest.mark.parametrize("status", [500, 503, 403])
def test_a_server_fault_leaves_the_entry_incomplete_and_the_next_run_completes_it(s3, status, monkeypatch):
    monkeypatch.setattr(pipeline.store.journal, "RUNNING_S", 0.0)  # as if the next run started minutes later
    with faulty(s3) as server:
        store = Store(s3.config(endpoint_url=f"http://127.0.0.1:{server.server_address[1]}"))
        server.status, written = status, []

        def after_five_chunks(command: str, path: str) -> bool:
            written.extend([path] if command == "PUT" and "/maps/c." in path else [])
            return len(written) > 5

        server.faults = after_five_chunks
        with pytest.raises(StoreUnreachable) as fault:
            store.fill({REF: LAYOUT}, rows=ROWS, batch=1, compute=compute)
        assert len(str(fault.value).splitlines()) == 1
    resumed = Store(s3.config())
    assert resumed.state(REF) == "partial"
    assert resumed.fill({REF: LAYOUT}, rows=ROWS, batch=1, compute=compute).reused == 5
    np.testing.assert_array_equal(resumed.read(REF).array("maps"), values(list(range(ROWS))))


def test_a_fault_while_reading_is_not_taken_for_a_missing_entry(s3):
    fill(Store(s3.config()))
    with faulty(s3) as server:
        store = Store(s3.config(endpoint_url=f"http://127.0.0.1:{server.server_address[1]}"))
        server.faults = lambda command, path: True
        for request in (lambda: store.is_complete(REF), lambda: store.read(REF)):
            with pytest.raises(StoreUnreachable):
                request()
        server.faults = lambda command, path: "/maps/c." in path
        with pytest.raises(StoreUnreachable):
            store.read(REF).array("maps")
    assert Store(s3.config()).is_complete(REF)


def _fill_together(fields: dict, barrier, answers) -> None:
    try:
        store = Store(S3StoreConfig(**fields))
        barrier.wait(60)
        store.fill({REF: LAYOUT}, rows=ROWS, batch=1, compute=compute)
        answers.put(store.read(REF).array("maps").tobytes())
    except Exception as error:
        answers.put(repr(error))


@pytest.mark.slow
def test_processes_on_the_same_cold_cache_end_with_the_same_bytes(s3):
    context = multiprocessing.get_context("spawn")
    barrier, answers = context.Barrier(2), context.Queue()
    fields = {"url": "s3://dzop-tests/cache", "endpoint_url": s3.endpoint_url}
    writers = [context.Process(target=_fill_together, args=(fields, barrier, answers)) for _ in range(2)]
    for writer in writers:
        writer.start()
    found = [answers.get(timeout=120) for _ in writers]
    for writer in writers:
        writer.join(30)
    assert found == [values(list(range(ROWS))).tobytes()] * 2
    store = Store(s3.config())
    assert store.state(REF) == "cached"
    np.testing.assert_array_equal(store.read(REF).array("maps"), values(list(range(ROWS))))
