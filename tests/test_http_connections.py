"""One connection carries one request after the other, and nothing that could be taken for a second one."""

from __future__ import annotations

import asyncio
import random
from typing import Any

import pytest
import uvicorn
from uvicorn.server import ServerState

from fuzz.http_twin import mutated, read_by_us
from rse_pf.http_connections import bounded_protocol
from rse_pf.http_head import MAX_HEAD_BYTES

GET = b"GET /a HTTP/1.1\r\nHost: x\r\n\r\n"


class Transport:
    """What a protocol writes to."""

    def __init__(self) -> None:
        self.written, self.ended = b"", ""
        self.reads = True

    def get_extra_info(self, name: str, default: Any = None) -> Any:
        return default

    def set_write_buffer_limits(self, high: int, low: int) -> None: ...

    def write(self, data: bytes) -> None:
        self.written += data

    def writelines(self, parts: list[bytes]) -> None:
        self.written += b"".join(parts)

    def is_closing(self) -> bool:
        return bool(self.ended)

    def close(self) -> None:
        self.ended = self.ended or "closed"

    def abort(self) -> None:
        self.ended = "cut"

    def pause_reading(self) -> None:
        assert self.reads
        self.reads = False

    def resume_reading(self) -> None:
        assert not self.reads
        self.reads = True


class Echo:
    """An application that answers with the body that it gets; `hold` keeps answers back."""

    def __init__(self) -> None:
        self.seen: list[tuple[str, bytes]] = []
        self.hold = asyncio.Event()
        self.hold.set()
        self.headers: list[tuple[bytes, bytes]] | None = None
        self.cancelled = 0

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        body = b""
        try:
            while True:
                message = await receive()
                if message["type"] == "http.disconnect":
                    return
                body += message["body"]
                if not message["more_body"]:
                    break
            self.seen.append((scope["path"], body))
            await self.hold.wait()
        except asyncio.CancelledError:
            self.cancelled += 1
            raise
        headers = [(b"content-length", b"%d" % len(body))] if self.headers is None else self.headers
        await send({"type": "http.response.start", "status": 200, "headers": headers})
        await send({"type": "http.response.body", "body": body, "more_body": True})
        await send({"type": "http.response.body", "body": b""})


class Line:
    """A connection to `Echo`."""

    def __init__(self, app: Any = None, **bounds: Any) -> None:
        self.app = app or Echo()
        config = uvicorn.Config(self.app, lifespan="off", log_level="critical")
        self.state = ServerState()
        made: Any = bounded_protocol(most_idle=10, **bounds)
        self.protocol = made(config, self.state, {})
        self.transport = Transport()
        self.protocol.connection_made(self.transport)

    async def send(self, *pieces: bytes) -> bytes:
        """Return what is written when *pieces* were received and all work is done."""
        for piece in pieces:
            if self.transport.ended:
                break
            self.protocol.data_received(piece)
            await settled()
        written, self.transport.written = self.transport.written, b""
        return written


async def settled() -> None:
    for _ in range(20):
        await asyncio.sleep(0)


async def test_requests_one_after_the_other_are_answered_on_one_connection() -> None:
    line = Line()
    assert await line.send(GET) == b"HTTP/1.1 200 OK\r\ncontent-length: 0\r\n\r\n"
    put = b"PUT /b%20c HTTP/1.1\r\nHost: x\r\nContent-Length: 5\r\n\r\n"
    assert (await line.send(put, b"he", b"llo")).endswith(b"\r\n\r\nhello")
    chunked = b"PUT /d HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n"
    assert (await line.send(*(bytes([each]) for each in chunked + b"2\r\nab\r\n0\r\n\r\n"))).endswith(b"ab")
    assert line.app.seen == [("/a", b""), ("/b c", b"hello"), ("/d", b"ab")]
    assert line.transport.ended == ""


@pytest.mark.parametrize("cut", [0, 1])
async def test_bytes_behind_a_request_are_no_request_and_end_the_connection(cut: int) -> None:
    line = Line()
    line.app.hold.clear()
    await line.send(*((GET + GET,) if cut == 0 else (GET, GET)))
    line.app.hold.set()
    await settled()
    assert line.transport.written.count(b"HTTP/1.1 200") == 1
    assert b"connection: close" in line.transport.written
    assert line.transport.ended == "closed"
    assert len(line.app.seen) == 1


async def test_bytes_within_a_reply_end_the_connection_after_it() -> None:
    class Slow(Echo):
        async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
            headers = [(b"content-length", b"4")]
            await send({"type": "http.response.start", "status": 200, "headers": headers})
            await send({"type": "http.response.body", "body": b"ab", "more_body": True})
            await self.hold.wait()
            await send({"type": "http.response.body", "body": b"cd"})

    line = Line(Slow())
    line.app.hold.clear()
    await line.send(GET, GET)
    line.app.hold.set()
    await settled()
    assert line.transport.written == b"cd"
    assert line.transport.ended == "closed"


@pytest.mark.parametrize(
    "data",
    [b"\x16\x03\x01", b"get / HTTP/1.1\r\nHost: x\r\n\r\n", b"G" * MAX_HEAD_BYTES,
     GET.replace(b"\r\n", b"\n\n"), GET[:-2] + b"A: " + b"b" * MAX_HEAD_BYTES],
)  # fmt: skip
async def test_what_is_no_head_is_refused_and_its_connection_closed(data: bytes) -> None:
    line = Line()
    written = await line.send(data[:100], data[100:], GET)
    if line.transport.ended:
        assert written.startswith(b"HTTP/1.1 400 ")
        assert line.transport.ended == "closed"
    else:
        assert written == b"", "it waits for the end of a head"
    assert line.app.seen == []


def test_a_body_that_is_no_longer_in_chunks_is_refused() -> None:
    async def run(ends_with_client: bool) -> None:
        line = Line(ends_with_client=ends_with_client)
        head = b"PUT /d HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n"
        assert (await line.send(head, b"1\r\nab")).startswith(b"HTTP/1.1 400 ")
        assert line.transport.ended == "closed"
        assert line.app.seen == []

    for ends_with_client in (False, True):
        asyncio.run(run(ends_with_client))


def test_an_application_is_cancelled_when_its_client_is_gone_only_if_asked() -> None:
    async def run(ends_with_client: bool) -> int:
        line = Line(ends_with_client=ends_with_client)
        line.app.hold.clear()
        await line.send(GET)
        line.protocol.connection_lost(None)
        await settled()
        line.app.hold.set()
        await settled()
        assert line.transport.written == b""
        assert not line.state.tasks
        return int(line.app.cancelled)

    assert [asyncio.run(run(each)) for each in (False, True)] == [0, 1]


async def test_a_client_that_expects_it_is_told_to_go_on_before_its_body() -> None:
    line = Line()
    head = b"PUT /a HTTP/1.1\r\nHost: x\r\nExpect: 100-continue\r\nContent-Length: 2\r\n\r\n"
    assert await line.send(head) == b"HTTP/1.1 100 Continue\r\n\r\n"
    assert (await line.send(b"ab")).startswith(b"HTTP/1.1 200 OK")


async def test_a_long_body_is_not_read_faster_than_it_is_taken() -> None:
    line = Line()
    line.protocol.data_received(b"PUT /a HTTP/1.1\r\nHost: x\r\nContent-Length: 9000000\r\n\r\n")
    line.protocol.data_received(b"x" * 300_000)
    assert not line.transport.reads
    await settled()
    assert line.transport.reads


@pytest.mark.parametrize(
    ("headers", "written"),
    [
        ([(b"content-length", b"9")], b""), ([(b"content-length", b"1")], b""),
        ([(b"a", b"b\r\nc: d")], b"500"), ([(b"a b", b"c")], b"500"),
        ([], b"chunked\r\n\r\n2\r\nab\r\n0\r\n\r\n"),
    ],
)  # fmt: skip
async def test_a_reply_that_a_client_would_misread_is_not_sent(
    headers: list[tuple[bytes, bytes]], written: bytes
) -> None:
    line = Line()
    line.app.headers = headers
    answer = await line.send(b"PUT /a HTTP/1.1\r\nHost: x\r\nContent-Length: 2\r\n\r\nab")
    assert written in answer
    assert line.transport.ended == ("" if b"chunked" in written else "cut" if not written else "closed")


async def test_mutated_requests_in_pieces_reach_the_application_only_as_they_are_understood() -> None:
    source = random.Random(5)
    for _ in range(1500):
        data = mutated(source)
        cuts = sorted(source.randrange(len(data) + 1) for _ in range(source.randrange(4)))
        line = Line()
        await line.send(*(data[a:b] for a, b in zip([0, *cuts], [*cuts, len(data)], strict=True) if a < b))
        understood = read_by_us(data)
        assert len(line.app.seen) == (understood is not None), data
        if understood is not None:
            assert line.app.seen[0][1] == understood.body
        line.protocol.connection_lost(None)
        await settled()
        assert not line.state.tasks, data


async def test_a_client_that_has_the_last_byte_may_ask_again_before_the_application_has_ended() -> None:
    class Late(Echo):
        async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
            headers = [(b"content-length", b"2")]
            await send({"type": "http.response.start", "status": 200, "headers": headers})
            await send({"type": "http.response.body", "body": b"ab", "more_body": True})
            await self.hold.wait()
            await send({"type": "http.response.body", "body": b""})
            self.seen.append((scope["path"], b""))

    line = Line(Late())
    line.app.hold.clear()
    for _ in range(3):
        assert (await line.send(GET)).endswith(b"\r\n\r\nab")
    line.app.hold.set()
    await settled()
    assert (line.transport.ended, len(line.app.seen)) == ("", 3)


async def test_shutdown_closes_a_waiting_connection_at_once_and_a_busy_one_after_its_reply() -> None:
    idle, busy = Line(), Line()
    busy.app.hold.clear()
    await busy.send(GET)
    for line in (idle, busy):
        line.protocol.shutdown()
    assert (idle.transport.ended, busy.transport.ended) == ("closed", "")
    busy.app.hold.set()
    await settled()
    assert b"connection: close" in busy.transport.written
    assert busy.transport.ended == "closed"
