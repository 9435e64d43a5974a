"""One connection carries one request after the other, and nothing that has two meanings."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from typing import Any

import pytest

from fuzz.http_twin import compare
from rse_pf.http.connections import MAX_HEAD_BYTES, MAX_HEADERS
from tests.kit.http_service import http_service

SOON_S = 30.0
GET = b"GET /a HTTP/1.1\r\nHost: x\r\n\r\n"
CHUNKED = b"PUT /d HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n"


class Echo:
    """An application that answers with the body that it gets; `hold` keeps answers back."""

    def __init__(self) -> None:
        self.seen: list[tuple[str, bytes]] = []
        self.hold, self.is_held, self.is_cancelled = asyncio.Event(), asyncio.Event(), asyncio.Event()
        self.hold.set()

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        body, more = b"", True
        while more:
            message = await receive()
            if message["type"] == "http.disconnect":
                return
            body, more = body + message["body"], message["more_body"]
        self.seen.append((scope["path"], body))
        self.is_held.set()
        try:
            await self.hold.wait()
        except asyncio.CancelledError:
            self.is_cancelled.set()
            raise
        headers = [(b"content-length", b"%d" % len(body))]
        await send({"type": "http.response.start", "status": 200, "headers": headers})
        await send({"type": "http.response.body", "body": body})


class Line:
    """A connection to an application on *port*."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, port: int) -> None:
        self.reader, self.writer, self.port = reader, writer, port

    async def send(self, *pieces: bytes) -> None:
        """Send *pieces*, as far as the server reads them."""
        with contextlib.suppress(ConnectionError):
            for piece in pieces:
                self.writer.write(piece)
                await self.writer.drain()

    async def was_received(self) -> None:
        """Wait until the server has received what was sent: it received what was sent to it later."""
        for _ in range(2):
            async with line_to_port(self.port) as other:
                await other.send(b"no request")
                await other.until_closed()

    async def answer(self) -> bytes:
        """Return one answer to which a length belongs."""
        head = await asyncio.wait_for(self.reader.readuntil(b"\r\n\r\n"), SOON_S)
        size = int(head.lower().partition(b"content-length: ")[2].split(b"\r\n")[0])
        return head + await asyncio.wait_for(self.reader.readexactly(size), SOON_S)

    async def until_closed(self) -> bytes:
        """Return all that comes until the server closes the connection."""
        received = b""
        with contextlib.suppress(ConnectionError):
            while piece := await asyncio.wait_for(self.reader.read(65536), SOON_S):
                received += piece
        return received


@contextlib.asynccontextmanager
async def line_to_port(port: int) -> AsyncIterator[Line]:
    line = Line(*await asyncio.open_connection("127.0.0.1", port), port)
    try:
        yield line
    finally:
        line.writer.transport.abort()


@contextlib.asynccontextmanager
async def line_to(app: Any, **bounds: Any) -> AsyncIterator[Line]:
    async with http_service(app, **bounds) as port, line_to_port(port) as line:
        yield line


async def test_requests_one_after_the_other_are_answered_on_one_connection() -> None:
    app = Echo()
    async with line_to(app) as line:
        await line.send(GET)
        assert await line.answer() == b"HTTP/1.1 200 OK\r\ncontent-length: 0\r\n\r\n"
        await line.send(b"PUT /b%20c HTTP/1.1\r\nHost: x\r\nContent-Length: 5\r\n\r\n", b"he", b"llo")
        assert (await line.answer()).endswith(b"\r\n\r\nhello")
        await line.send(*(bytes([each]) for each in CHUNKED + b"2\r\nab\r\n0\r\n\r\n"))
        assert (await line.answer()).endswith(b"ab")
    assert app.seen == [("/a", b""), ("/b c", b"hello"), ("/d", b"ab")]


@pytest.mark.parametrize("pieces", [(GET + GET,), (GET, GET)])
async def test_bytes_behind_a_request_are_no_request_and_end_the_connection(
    pieces: tuple[bytes, ...],
) -> None:
    app = Echo()
    app.hold.clear()
    async with line_to(app) as line:
        await line.send(pieces[0])
        await app.is_held.wait()
        await line.send(*pieces[1:])
        await line.was_received()
        app.hold.set()
        answers = await line.until_closed()
    assert answers.count(b"HTTP/1.1 200") == len(app.seen) == 1


async def test_bytes_within_a_reply_end_the_connection_after_it() -> None:
    class Slow(Echo):
        async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
            headers = [(b"content-length", b"4")]
            await send({"type": "http.response.start", "status": 200, "headers": headers})
            await send({"type": "http.response.body", "body": b"ab", "more_body": True})
            await self.hold.wait()
            await send({"type": "http.response.body", "body": b"cd"})

    app = Slow()
    app.hold.clear()
    async with line_to(app) as line:
        await line.send(GET)
        await asyncio.wait_for(line.reader.readuntil(b"ab"), SOON_S)
        await line.send(GET)
        await line.was_received()
        app.hold.set()
        assert await line.until_closed() == b"cd"


async def test_a_reply_before_the_end_of_a_body_ends_the_connection() -> None:
    async def early(scope: Any, receive: Any, send: Any) -> None:
        await send({"type": "http.response.start", "status": 204})
        await send({"type": "http.response.body"})

    async with line_to(early) as line:
        await line.send(CHUNKED)
        assert (await line.until_closed()).startswith(b"HTTP/1.1 204")


def head(*lines: bytes, start: bytes = b"GET /a?b HTTP/1.1", host: bytes = b"Host: x") -> bytes:
    return b"\r\n".join([start, host, *lines]) + b"\r\n\r\n"


REFUSED = {
    "TLS": b"\x16\x03\x01", "no end": b"G" * MAX_HEAD_BYTES,
    "no host": head(host=b"A: b"), "two hosts": head(b"HOST: y"),
    "two lengths": head(b"Content-Length: 1", b"Content-Length: 1"),
    "length and coding": head(b"Content-Length: 1", b"Transfer-Encoding: chunked"),
    "list of lengths": head(b"Content-Length: 1, 1"), "sign": head(b"Content-Length: +1"),
    "underscore": head(b"Content-Length: 1_0"), "empty length": head(b"Content-Length:"),
    "20 digits": head(b"Content-Length: 99999999999999999999"),
    "coding": head(b"Transfer-Encoding: gzip, chunked"), "folded": head(b"A: b", b" c"),
    "space before the colon": head(b"A : b"), "no colon": head(b"A"), "no name": head(b": b"),
    "bare LF": head(b"A: b\nB: c"), "bare CR": head(b"A: b\rc"), "NUL": head(b"A: b\0c"),
    "vertical tab": head(b"A: \x0bb"), "DEL": head(b"A: \x7f"), "HTTP/1.0": head(start=b"GET / HTTP/1.0"),
    "HTTP/2.0": head(start=b"GET / HTTP/2.0"), "absolute": head(start=b"GET http://x/ HTTP/1.1"),
    "asterisk": head(start=b"OPTIONS * HTTP/1.1"), "two spaces": head(start=b"GET  / HTTP/1.1"),
    "small letters": head(start=b"get / HTTP/1.1"), "letter above ASCII": head(start=b"GET /\xe4 HTTP/1.1"),
    "fragment": head(start=b"GET /a#b HTTP/1.1"),
    "upgrade": head(b"Connection: Upgrade", b"Upgrade: websocket"),
    "65 lines": head(*[b"A: b"] * MAX_HEADERS), "16 KiB": head(b"A: " + b"b" * MAX_HEAD_BYTES),
    "empty line first": b"\r\n" + head(), "no lines": b"GET / HTTP/1.1\r\n\r\n",
    "chunk longer than its size": CHUNKED + b"1\r\nab\r\n", "sign of a chunk": CHUNKED + b"+5\r\n",
    "prefix of a chunk": CHUNKED + b"0x5\r\n", "chunk without a size": CHUNKED + b"\r\n",
    "line feed for the end of a chunk": CHUNKED + b"1\r\na\n0\r\n\r\n",
    "trailer": CHUNKED + b"0\r\nAuthorization: y\r\n\r\n",
    "chunks of one byte": CHUNKED + b"1\r\na\r\n" * 9999,
    "size without end": CHUNKED + b"0" * 99_999, "trailer without end": CHUNKED + b"0\r\n" + b"a" * 99_999,
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
async def test_what_has_two_meanings_or_no_end_is_refused_and_its_connection_closed(name: str) -> None:
    app = Echo()
    async with line_to(app, seconds=SOON_S) as line:
        await line.send(REFUSED[name])
        assert (await line.until_closed()).startswith(b"HTTP/1.1 400 ")
    assert app.seen == []


async def test_a_head_may_have_64_lines_and_16_kib_and_a_body_many_chunks() -> None:
    longest = head(b"A: ".ljust(MAX_HEAD_BYTES - len(head(b"")), b"b"))
    assert len(longest) == MAX_HEAD_BYTES
    async with line_to(Echo()) as line:
        coded = longest.replace(b"A: ", b"Transfer-Encoding: chunked\r\nA: ").replace(b"b" * 28, b"", 1)
        for accepted in (longest, head(*[b"A: b"] * (MAX_HEADERS - 1)), coded + b"0\r\n\r\n", GET):
            await line.send(accepted)
            assert (await line.answer()).startswith(b"HTTP/1.1 200 ")
        await line.send(CHUNKED + b"40\r\n%s\r\n" % (b"a" * 64) * 5000 + b"0\r\n\r\n")
        assert (await line.answer()).endswith(b"a" * 320_000)


@pytest.mark.parametrize("ends_with_client", [False, True])
async def test_an_application_is_cancelled_when_its_client_is_gone_only_if_asked(
    ends_with_client: bool,
) -> None:
    app = Echo()
    app.hold.clear()
    async with line_to(app, ends_with_client=ends_with_client) as line:
        await line.send(GET)
        await app.is_held.wait()
        line.writer.transport.abort()
        if ends_with_client:
            await asyncio.wait_for(app.is_cancelled.wait(), SOON_S)
        else:
            app.hold.set()
    assert app.is_cancelled.is_set() == ends_with_client


async def test_a_client_that_expects_it_is_asked_to_go_on_before_its_body() -> None:
    async with line_to(Echo()) as line:
        await line.send(head(b"Expect: 100-continue", b"Content-Length: 2"))
        go_on = await asyncio.wait_for(line.reader.readuntil(b"\r\n\r\n"), SOON_S)
        assert go_on == b"HTTP/1.1 100 Continue\r\n\r\n"
        await line.send(b"ab")
        assert (await line.answer()).startswith(b"HTTP/1.1 200 OK")


@pytest.mark.parametrize("seed", range(2))
async def test_what_is_accepted_is_understood_alike_by_h11(seed: int) -> None:
    accepted, problems = await compare(5000, seed)

    assert problems == []
    assert accepted > 0.08 * 5000, "samples that nobody accepts compare nothing"
