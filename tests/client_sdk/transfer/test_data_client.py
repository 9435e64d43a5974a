"""Transfers of large data: parts, resuming, retries and time limits."""

from __future__ import annotations

import hashlib
import json
import random
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from client_sdk.transfer.data_client import DataClient, DataOptions
from rse_pf.errors import ConnectError, NotFound, QuotaExceeded, StoreError, Unauthorized
from rse_pf.maps.photos import PhotoLens

DATA = random.Random(1).randbytes(700_000)
DIGEST = hashlib.sha256(DATA).hexdigest()
Answer = tuple[int, dict[str, str], bytes]
Script = Callable[[str, str, dict[str, str], bytes], "Answer | None"]


class FakeService:
    """A data service in memory; *script* may answer a request instead, and ``(0, {}, b"")`` disconnects."""

    def __init__(self) -> None:
        self.objects: dict[str, bytes] = {}
        self.parts: dict[str, bytes] = {}
        self.sizes: dict[str, int] = {}
        self.asked: list[tuple[str, str]] = []
        self.script: Script = lambda method, path, headers, body: None
        service = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def answer(self) -> None:
                body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
                service.asked.append((self.command, self.path))
                given = dict(self.headers.items())
                made = service.script(self.command, self.path, given, body)
                status, headers, content = made or service.answer(self.command, self.path, given, body)
                if status == 0:
                    self.close_connection = True
                    return
                self.send_response(status)
                for name, value in {**headers, "Content-Length": str(len(content))}.items():
                    self.send_header(name, value)
                self.end_headers()
                self.wfile.write(content)

            do_GET = do_PUT = do_PATCH = do_DELETE = do_POST = answer

            def log_message(self, *_: object) -> None:
                """Write no log."""

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.thread = threading.Thread(target=self.server.serve_forever, args=(0.01,), daemon=True)
        self.thread.start()
        self.url = f"http://127.0.0.1:{self.server.server_address[1]}"

    def answer(self, method: str, path: str, headers: dict[str, str], body: bytes) -> Answer:
        kind, digest = path.split("/")[3:5]
        if kind == "uploads":
            if method == "PUT":
                self.sizes[digest] = json.loads(body)["size"]
            held = self.parts.setdefault(digest, b"")
            if method == "PATCH":
                if int(headers["Upload-Offset"]) != len(held):
                    return failure(409, "conflict")
                held = self.parts[digest] = held + body
            if len(held) == self.sizes[digest]:
                self.objects[digest] = held
            state = {"digest": digest, "size": self.sizes[digest], "offset": len(held), "part_bytes": 200_000}
            return 200, {}, json.dumps(state).encode()
        if method == "PUT":
            self.objects[digest] = body
            return 201, {}, json.dumps({"digest": digest, "size": len(body)}).encode()
        if digest not in self.objects:
            return failure(404, "not-found")
        whole = self.objects[digest]
        first, _, last = headers["Range"].removeprefix("bytes=").partition("-")
        if int(first) >= len(whole):
            return 416, {"Content-Range": f"bytes */{len(whole)}"}, b"{}"
        piece = whole[int(first) : int(last) + 1]
        content_range = f"bytes {first}-{int(first) + len(piece) - 1}/{len(whole)}"
        return 206, {"Content-Range": content_range}, piece

    def close(self) -> None:
        self.server.shutdown()
        self.server.server_close()
        self.thread.join(10)


def failure(status: int, code: str, **headers: str) -> Answer:
    return status, headers, json.dumps({"code": code, "message": "so it is", "hint": "do this"}).encode()


@pytest.fixture
def service() -> Iterator[FakeService]:
    made = FakeService()
    yield made
    made.close()


class TimedClient:
    """A data client with a fake clock that its pauses advance."""

    def __init__(self, service: FakeService) -> None:
        self.now = 0.0
        self.pauses: list[float] = []
        options = DataOptions(clock=lambda: self.now, sleep=self.sleep, random=random.Random(3))
        self.client = DataClient(service.url, "token", options)

    def sleep(self, seconds: float) -> None:
        self.pauses.append(seconds)
        self.now += seconds


@pytest.fixture
def robot(service: FakeService) -> Iterator[TimedClient]:
    made = TimedClient(service)
    yield made
    made.client.close()


def once(answer: Answer, method: str = "PATCH", after: int = 0) -> Script:
    """Return a script that gives *answer* to one request of *method*, the one after *after* others."""
    left = [after]

    def script(asked: str, path: str, headers: dict[str, str], body: bytes) -> Answer | None:
        if asked != method:
            return None
        left[0] -= 1
        return answer if left[0] == -1 else None

    return script


def test_a_large_object_is_sent_in_parts_of_the_servers_size(
    service: FakeService, robot: TimedClient
) -> None:
    progress: list[tuple[int, int]] = []

    assert robot.client.upload(DATA, lambda done, size: progress.append((done, size))) == DIGEST

    assert service.objects[DIGEST] == DATA
    assert [done for done, _ in progress] == [0, 200_000, 400_000, 600_000, 700_000]
    assert {size for _, size in progress} == {700_000}


@pytest.mark.parametrize(
    "cut", [(0, {}, b""), failure(503, "busy"), failure(500, "internal"), failure(408, "expired")]
)
def test_a_broken_request_is_retried_after_a_growing_pause(
    service: FakeService, robot: TimedClient, cut: Answer
) -> None:
    service.script = once(cut, after=1)

    assert robot.client.upload(DATA) == DIGEST

    assert service.objects[DIGEST] == DATA
    assert len(robot.pauses) == 1


def test_a_part_whose_answer_was_lost_is_not_sent_twice(service: FakeService, robot: TimedClient) -> None:
    def stored_but_cut(method: str, path: str, headers: dict[str, str], body: bytes) -> Answer | None:
        if (
            method == "PATCH"
            and headers["Upload-Offset"] == "200000"
            and len(service.parts[DIGEST]) == 200_000
        ):
            service.answer(method, path, headers, body)
            return 0, {}, b""
        return None

    service.script = stored_but_cut

    assert robot.client.upload(DATA) == DIGEST
    assert service.objects[DIGEST] == DATA


def test_an_upload_of_another_process_is_resumed(
    service: FakeService, robot: TimedClient, tmp_path: Path
) -> None:
    service.parts[DIGEST] = DATA[:400_000]
    (tmp_path / "cloud").write_bytes(DATA)

    robot.client.upload(tmp_path / "cloud")

    assert service.objects[DIGEST] == DATA
    assert [method for method, _ in service.asked].count("PATCH") == 2


def last(robot: TimedClient, answer: Answer) -> Script:
    """Return a script that gives *answer* when the deadline has passed."""

    def script(method: str, path: str, headers: dict[str, str], body: bytes) -> Answer:
        robot.now += DataOptions().deadline_s
        return answer

    return script


OTHER = json.dumps({"digest": "0" * 64, "size": 5, "offset": 5, "part_bytes": 5}).encode()


@pytest.mark.parametrize("data", [b"small", DATA])
@pytest.mark.parametrize(
    "other", [(307, {}, b""), (200, {}, b""), (200, {}, b"{}"), (200, {}, b"\xff"), (200, {}, OTHER)]
)
def test_only_the_data_service_can_report_that_an_object_is_stored(
    service: FakeService, robot: TimedClient, other: Answer, data: bytes
) -> None:
    service.script = last(robot, other)

    with pytest.raises(ConnectError, match=r"http://127\.0\.0\.1"):
        robot.client.upload(data)
    assert service.objects == {}

    service.script = once((200, {}, b"{}"), "PUT")
    assert service.objects[robot.client.upload(data)] == data


LENS = PhotoLens(fx=500.0, fy=500.0, cx=320.0, cy=240.0)


@pytest.mark.parametrize("body", [b"", b"{}", b"[1]", b'{"id":7}'])
@pytest.mark.parametrize(
    "ask",
    [
        lambda client: list(client.objects()),
        lambda client: client.maps(),
        lambda client: client.map_version("k\u00fcche"),
        lambda client: client.download_map("my map"),
        lambda client: client.localise("kitchen", b"", LENS),
        lambda client: client.map_outline("kitchen"),
    ],
)
def test_a_reply_that_no_data_service_writes_is_a_failed_connection(
    service: FakeService, robot: TimedClient, ask: Callable[[DataClient], object], body: bytes
) -> None:
    service.script = last(robot, (200, {}, body))

    with pytest.raises(ConnectError, match="answers 200 OK as no RSE-PF server does"):
        ask(robot.client)


def test_a_refusal_is_final_and_typed(service: FakeService, robot: TimedClient) -> None:
    service.script = once(failure(413, "quota"), "PUT")

    with pytest.raises(QuotaExceeded, match="so it is"):
        robot.client.upload(DATA)
    assert robot.pauses == []


def test_retries_end_at_the_deadline(service: FakeService, robot: TimedClient) -> None:
    service.script = lambda *_: (0, {}, b"")

    with pytest.raises(ConnectError):
        robot.client.upload(DATA)

    assert 30.0 < robot.now <= 60.0
    assert max(robot.pauses) <= 5.0


def test_a_retry_waits_as_long_as_the_server_asks(service: FakeService, robot: TimedClient) -> None:
    service.script = once(failure(503, "busy", **{"Retry-After": "7"}), "PUT")

    robot.client.upload(b"small")

    assert robot.pauses == [7.0]


def test_a_platform_without_a_data_service_is_reported_soon_and_with_a_hint(
    service: FakeService, robot: TimedClient
) -> None:
    service.script = lambda *_: (503, {}, b"no healthy upstream")  # of Envoy without targets

    with pytest.raises(ConnectError, match="has no data service") as raised:
        robot.client.upload(DATA)

    assert 2.0 < robot.now <= 5.0
    assert "--no-data" in raised.value.hint


def test_a_download_is_verified_and_resumed(service: FakeService, robot: TimedClient, tmp_path: Path) -> None:
    large = random.Random(2).randbytes(2_500_000)
    digest = hashlib.sha256(large).hexdigest()
    service.objects[digest] = large
    service.script = once((0, {}, b""), "GET", after=1)

    assert robot.client.download(digest) == large

    (tmp_path / f".map.{digest[:16]}.part").write_bytes(large[:1_000_000])
    service.asked.clear()
    robot.client.download(digest, tmp_path / "map")
    assert (tmp_path / "map").read_bytes() == large
    assert len(service.asked) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["map"]


def test_bytes_that_do_not_match_the_digest_are_refused(
    service: FakeService, robot: TimedClient, tmp_path: Path
) -> None:
    service.objects[DIGEST] = DATA[:-1] + b"?"

    with pytest.raises(StoreError, match="digest"):
        robot.client.download(DIGEST, tmp_path / "map")

    assert list(tmp_path.iterdir()) == []
    with pytest.raises(NotFound):
        robot.client.download("0" * 64)


def test_a_token_callable_that_fails_is_asked_again_after_a_pause(
    robot: TimedClient, service: FakeService
) -> None:
    asked: list[int] = []

    def token() -> str:
        asked.append(1)
        if len(asked) < 3:
            raise KeyError("the service of tokens is down")
        return "token"

    client = DataClient(service.url, token, DataOptions(clock=lambda: robot.now, sleep=robot.sleep))

    digest = client.upload(b"data")

    assert service.objects[digest] == b"data"
    assert len(asked) == 3
    assert len(robot.pauses) == 2
    client.close()


def test_an_async_token_callable_is_refused_with_the_callable_that_fits(service: FakeService) -> None:
    async def token() -> str:
        return "token"

    client = DataClient(service.url, token)  # type: ignore[arg-type]

    with pytest.raises(Unauthorized) as refused:
        client.upload(b"data")

    assert "fresh_token" in refused.value.hint
    client.close()


def test_a_transfer_goes_on_although_its_progress_function_raises(
    robot: TimedClient, service: FakeService, caplog: pytest.LogCaptureFixture
) -> None:
    def progress(done: int, size: int) -> None:
        raise KeyError("a bug of the program")

    data = bytes(range(256)) * 2000

    digest = robot.client.upload(data, progress)

    assert robot.client.download(digest, progress=progress) == data
    assert len([record for record in caplog.records if record.exc_info]) == 1
