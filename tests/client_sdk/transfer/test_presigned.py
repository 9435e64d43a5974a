"""Transfers by presigned addresses: without the token, and through the data service if the bucket fails."""

from __future__ import annotations

import random
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from client_sdk.transfer.data_client import DataClient, DataOptions, is_allowed
from rse_pf.storage.object_store import MemoryStore, digest_of
from tests.kit.fake_data_service import HttpServer, Service, small_settings

DATA = random.Random(1).randbytes(700_000)
DIGEST = digest_of(DATA)


class Bucket(MemoryStore):
    """A store in memory with an HTTP server, which robots reach by presigned addresses while it is *open*."""

    def __init__(self) -> None:
        super().__init__()
        self.is_open = True
        self.asked: list[tuple[str, int]] = []
        self.tokens = 0
        bucket = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def answer(self) -> None:
                data = self.rfile.read(int(self.headers.get("Content-Length", 0)))
                name = self.path.partition("?")[0].removeprefix("/")
                bucket.tokens += "Authorization" in self.headers
                body = b""
                if not bucket.is_open or not self.path.endswith("?signed"):
                    status = 403
                elif self.command == "PUT":
                    assert self.headers["x-checksum"] == digest_of(data)
                    bucket.put(name, data)
                    status = 200
                else:
                    first, _, last = self.headers["Range"].removeprefix("bytes=").partition("-")
                    whole = bucket.get(name)
                    status, body = 206, whole[int(first) : int(last) + 1]
                bucket.asked.append((self.command, status))
                self.send_response(status)
                if status == 206:
                    content_range = f"bytes {first}-{int(first) + len(body) - 1}/{len(whole)}"
                    self.send_header("Content-Range", content_range)
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            do_GET = do_PUT = answer

            def log_message(self, *_: object) -> None:
                """Write no log."""

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.01,), daemon=True)
        self._thread.start()
        self._url = f"http://127.0.0.1:{self._server.server_address[1]}"

    def presigned_put(self, name: str, *, size: int, sha256: str, ttl_s: int) -> tuple[str, dict[str, str]]:
        return f"{self._url}/{name}?signed", {"Content-Length": str(size), "x-checksum": sha256}

    def presigned_get(self, name: str, *, ttl_s: int) -> str:
        return f"{self._url}/{name}?signed"

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(10)


@pytest.fixture
def bucket() -> Iterator[Bucket]:
    """Run a bucket that answers."""
    made = Bucket()
    yield made
    made.close()


@pytest.fixture
def service(bucket: Bucket) -> Service:
    """Run a data service that offers addresses of the bucket."""
    return Service(small_settings(part_bytes=200_000, max_object_bytes=1 << 20, quota_bytes=1 << 22), bucket)


@contextmanager
def connected(
    service: Service, sleep: Callable[[float], None] = lambda seconds: None
) -> Iterator[DataClient]:
    """Make a data client that calls *sleep* instead of pausing."""
    with HttpServer(service) as server:
        client = DataClient(server.url, service.token, DataOptions(sleep=sleep))
        try:
            yield client
        finally:
            client.close()


@pytest.fixture
def robot(service: Service) -> Iterator[DataClient]:
    """Make a data client that never pauses."""
    with connected(service) as client:
        yield client


def carried(service: Service) -> int:
    """Return how many bytes of objects went through the data service instead of the bucket."""
    lines = [line for line in service.lines if line["operation"] in ("append_part", "get_object")]
    return sum(line["received_bytes"] + line["sent_bytes"] for line in lines)


def test_large_data_uses_presigned_addresses_without_the_token(
    service: Service, bucket: Bucket, robot: DataClient
) -> None:
    assert robot.upload(DATA) == DIGEST
    assert robot.download(DIGEST) == DATA

    assert bucket.asked == [("PUT", 200), ("GET", 206)]
    assert carried(service) == 0
    assert bucket.tokens == 0


def test_after_three_failures_of_the_bucket_the_service_transfers_the_bytes(
    service: Service, bucket: Bucket, robot: DataClient
) -> None:
    bucket.is_open = False

    assert robot.upload(DATA) == DIGEST
    assert robot.download(DIGEST) == DATA

    assert bucket.asked == [("PUT", 403)] * 3 + [("GET", 403)] * 3
    assert carried(service) >= 2 * len(DATA)


def test_a_presigned_address_that_expired_is_requested_again(service: Service, bucket: Bucket) -> None:
    bucket.is_open = False

    def open_bucket(seconds: float) -> None:
        bucket.is_open = True

    with connected(service, sleep=open_bucket) as robot:
        assert robot.upload(DATA) == DIGEST
        bucket.is_open = False
        assert robot.download(DIGEST) == DATA

    assert bucket.asked == [("PUT", 403), ("PUT", 200), ("GET", 403), ("GET", 206)]
    assert carried(service) == 0


@pytest.mark.parametrize(
    ("url", "secure", "allowed"),
    [
        ("https://bucket.s3.amazonaws.com/a?x", True, True),
        ("http://bucket/a", True, False),
        ("http://127.0.0.1:1/a", False, True),
        ("ftp://bucket/a", False, False),
        ("", False, False),
    ],
)
def test_tls_is_never_given_up(url: str, secure: bool, allowed: bool) -> None:
    assert is_allowed(url, secure=secure) is allowed
