"""moto's S3 server on this machine, with a bucket for tests."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from pipeline.store import S3StoreConfig

BUCKET = "dzop-tests"
CREDENTIALS = {"AWS_ACCESS_KEY_ID": "key", "AWS_SECRET_ACCESS_KEY": "secret", "AWS_DEFAULT_REGION": "us-east-1"}


def _serve_s3() -> Any:
    """moto's S3 alone, without a log: moto's own server lists its folders at every request to find a service."""
    from moto.moto_server.werkzeug_app import MotoRequestHandler, create_backend_app
    from werkzeug.serving import make_server

    class Handler(MotoRequestHandler):
        def log_request(self, *args: Any) -> None:
            return

    return make_server("127.0.0.1", 0, create_backend_app("s3"), threaded=True, request_handler=Handler)


@dataclass
class S3Server:
    endpoint_url: str
    client: Any

    @classmethod
    @contextmanager
    def running(cls) -> Iterator[S3Server]:
        import boto3

        before = {name: os.environ.get(name) for name in CREDENTIALS}
        os.environ.update(CREDENTIALS)
        server = _serve_s3()
        threading.Thread(target=server.serve_forever, daemon=True).start()
        url = f"http://127.0.0.1:{server.server_port}"
        client = boto3.client("s3", endpoint_url=url)
        client.create_bucket(Bucket=BUCKET)
        yield cls(url, client)
        server.shutdown()
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value

    def emptied(self) -> S3Server:
        for key in self.keys():
            self.client.delete_object(Bucket=BUCKET, Key=key)
        return self

    def config(self, **fields: Any) -> S3StoreConfig:
        return S3StoreConfig(**{"url": f"s3://{BUCKET}/cache", "endpoint_url": self.endpoint_url} | fields)

    def keys(self) -> list[str]:
        pages = self.client.get_paginator("list_objects_v2").paginate(Bucket=BUCKET)
        return [found["Key"] for page in pages for found in page.get("Contents", ())]

    def get(self, key: str) -> bytes:
        return self.client.get_object(Bucket=BUCKET, Key=key)["Body"].read()

    def put(self, key: str, value: bytes) -> None:
        self.client.put_object(Bucket=BUCKET, Key=key, Body=value)

    def delete(self, key: str) -> None:
        self.client.delete_object(Bucket=BUCKET, Key=key)
