"""Questions to a control port: one connection, a deadline on each, and no late answer is believed."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager

import pytest

from rse_pf.local.servers.control_client import ControlPort

SOON_S = 10.0
AT_ONCE_S = 0.05

Talk = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]


@asynccontextmanager
async def a_port(talk: Talk, token: str | None = None) -> AsyncIterator[ControlPort]:
    """Serve *talk*; yield the port to ask there."""

    async def quiet(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            await talk(reader, writer)
        except (EOFError, OSError, asyncio.CancelledError):
            pass
        finally:
            writer.close()

    server = await asyncio.start_server(quiet, "127.0.0.1", 0)
    port = ControlPort(server.sockets[0].getsockname()[1], token)
    yield port
    port.close()
    server.close()


def page(body: bytes, head: bytes = b"") -> bytes:
    return b"HTTP/1.1 200 OK\r\nContent-Length: %d\r\n%s\r\n%s" % (len(body), head, body)


async def test_an_answer_that_comes_too_late_is_not_taken_for_the_next_one() -> None:
    asked = 0

    async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        nonlocal asked
        while await reader.readuntil(b"\r\n\r\n"):
            asked += 1
            if asked > 1:
                writer.write(page(b'{"answer": %d}' % asked))

    async with a_port(talk) as port:
        with pytest.raises(ConnectionError, match="no answer from port"):
            await port.ask("/a", timeout_s=AT_ONCE_S)
        assert (await port.ask("/a", timeout_s=SOON_S)).document() == {"answer": 2}


@pytest.mark.parametrize(
    "answer",
    [
        b"",
        b"HTTP/1.1 200 OK\r\nContent-Length: 9\r\n\r\nshort",
        b"HTTP/1.1 200 OK\r\n\r\n",
        b"nonsense\r\n\r\n",
        page(b"", b"X: " + b"x" * 20_000 + b"\r\n"),
    ],
)
async def test_whatever_is_no_answer_is_a_connection_error(answer: bytes) -> None:
    async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readuntil(b"\r\n\r\n")
        writer.write(answer)

    async with a_port(talk) as port:
        with pytest.raises(ConnectionError):
            await port.ask("/a", timeout_s=SOON_S)


async def test_events_are_followed_until_the_operation_is_over() -> None:
    heads: list[str] = []

    async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        heads.append((await reader.readuntil(b"\r\n\r\n")).decode())
        writer.write(b'HTTP/1.1 200 OK\r\n\r\n{"event": "a"}\n{"event": "over"}\n')

    async with a_port(talk) as port:
        events = [event["event"] async for event in port.follow("/drain?server=a", silence_s=SOON_S)]

    assert events == ["a", "over"]
    assert heads[0].startswith("POST /drain?server=a HTTP/1.1\r\n")
    assert "Connection: close\r\n" in heads[0], "else a refusal would keep the connection, and the caller"
