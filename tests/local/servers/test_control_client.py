"""Questions to a control port: one connection, a deadline on each, and no late answer is believed."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any

import pytest

from rse_pf.errors import UsageError
from rse_pf.local.servers.control_client import ControlPort

SOON_S = 10.0
AT_ONCE_S = 0.05

Talk = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]


def with_server(
    talk: Talk, work: Callable[[ControlPort], Coroutine[Any, Any, Any]], token: str | None = None
) -> Any:
    async def run() -> Any:
        server = await asyncio.start_server(talk, "127.0.0.1", 0)
        port = ControlPort(server.sockets[0].getsockname()[1], token)
        try:
            return await work(port)
        finally:
            port.close()
            server.close()

    return asyncio.run(run())


def page(body: bytes, head: bytes = b"") -> bytes:
    return b"HTTP/1.1 200 OK\r\nContent-Length: %d\r\n%s\r\n%s" % (len(body), head, body)


def test_questions_share_one_connection() -> None:
    connections = []

    async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        connections.append(writer)
        while head := await reader.readuntil(b"\r\n\r\n"):
            writer.write(page(b'{"asked": "%s"}' % head.split(b" ")[1]))

    async def work(port: ControlPort) -> list[Any]:
        return [(await port.ask(target, timeout_s=SOON_S)).document() for target in ("/a", "/b")]

    assert with_server(_quietly(talk), work) == [{"asked": "/a"}, {"asked": "/b"}]
    assert len(connections) == 1


@pytest.mark.parametrize(
    ("token", "carried"), [(None, []), ("ab" * 16, [f"authorization: bearer {'ab' * 16}"])]
)
def test_every_question_carries_the_token(token: str | None, carried: list[str]) -> None:
    heads: list[str] = []

    async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while head := await reader.readuntil(b"\r\n\r\n"):
            heads.append(head.decode().lower())
            writer.write(page(b"{}"))

    async def work(port: ControlPort) -> None:
        for target in ("/a", "/b"):
            await port.ask(target, timeout_s=SOON_S)

    with_server(_quietly(talk), work, token)

    told = [[line for line in head.split("\r\n") if line.startswith("authorization")] for head in heads]
    assert told == [carried, carried]


def test_an_answer_that_comes_too_late_is_not_taken_for_the_next_one() -> None:
    asked = 0

    async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        nonlocal asked
        while await reader.readuntil(b"\r\n\r\n"):
            asked += 1
            if asked > 1:
                writer.write(page(b'{"answer": %d}' % asked))

    async def work(port: ControlPort) -> Any:
        with pytest.raises(ConnectionError, match="no answer from port"):
            await port.ask("/a", timeout_s=AT_ONCE_S)
        return (await port.ask("/a", timeout_s=SOON_S)).document()

    assert with_server(_quietly(talk), work) == {"answer": 2}


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
def test_whatever_is_no_answer_is_a_connection_error(answer: bytes) -> None:
    async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readuntil(b"\r\n\r\n")
        writer.write(answer)

    async def work(port: ControlPort) -> None:
        with pytest.raises(ConnectionError):
            await port.ask("/a", timeout_s=SOON_S)

    with_server(_quietly(talk), work)


async def test_a_port_where_nobody_listens_is_a_connection_error() -> None:
    async def work(port: ControlPort) -> None:
        with pytest.raises(ConnectionError):
            await port.ask("/a", timeout_s=SOON_S)

    server = await asyncio.start_server(lambda reader, writer: None, "127.0.0.1", 0)
    number = server.sockets[0].getsockname()[1]
    server.close()
    await server.wait_closed()
    await work(ControlPort(number))


def _quietly(talk: Talk) -> Talk:
    async def quiet(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            await talk(reader, writer)
        except (EOFError, OSError, asyncio.CancelledError):
            pass
        finally:
            writer.close()

    return quiet


def test_events_are_followed_until_the_operation_is_over() -> None:
    heads: list[str] = []

    async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        heads.append((await reader.readuntil(b"\r\n\r\n")).decode())
        writer.write(b'HTTP/1.1 200 OK\r\n\r\n{"event": "a"}\n{"event": "over"}\n')
        writer.close()

    async def work(port: ControlPort) -> list[str]:
        return [event["event"] async for event in port.follow("/drain?server=a", silence_s=SOON_S)]

    assert with_server(talk, work) == ["a", "over"]
    assert heads[0].startswith("POST /drain?server=a HTTP/1.1\r\n")
    assert "Connection: close\r\n" in heads[0], "else a refusal would keep the connection, and the caller"


def test_a_refused_operation_says_why_and_a_silent_one_ends() -> None:
    async def refuse(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readuntil(b"\r\n\r\n")
        writer.write(page(b'{"message": "no such server", "hint": "see the list"}\n').replace(b"200", b"409"))

    async def say_nothing(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.read()

    async def follow(port: ControlPort) -> list[Any]:
        return [event async for event in port.follow("/drain", silence_s=AT_ONCE_S)]

    with pytest.raises(UsageError, match="no such server"):
        with_server(_quietly(refuse), follow)
    with pytest.raises(ConnectionError, match="no answer"):
        with_server(_quietly(say_nothing), follow)
