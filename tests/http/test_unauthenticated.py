"""Connections that send no whole request are cheap and few, at every kind of listener."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest

from rse_pf.config.front_door import BALANCER_IDLE_TIMEOUT_S
from rse_pf.http.control_port import ControlReply, serve_control
from rse_pf.http.unauthenticated import (
    FIRST_REQUEST_S,
    KEEP_ALIVE_S,
    MAX_SILENT,
    SilentConnections,
    TlsListener,
)
from rse_pf.local.control.control_port import serve_control_port
from rse_pf.server.live_map.connection_security import client_context, server_context
from rse_pf.server.live_map.map_server.worker_connections import listen
from tests.kit.fakes import FakeLoop
from tests.kit.http_service import http_service

COUNT, SECONDS, DEADLINE_S = 300, 1.0, 10.0
TOKEN = "t" * 32


class Line:
    """`SilentConnections` on a loop whose time stands still."""

    def __init__(self, **bounds: Any) -> None:
        self.loop = FakeLoop()
        self.ended: list[int] = []
        self.silent: SilentConnections[int] = SilentConnections(
            call_later=self.loop.call_later,  # type: ignore[arg-type]
            **bounds,
        )

    def enter(self, key: int, source: str = "") -> None:
        self.silent.enter(key, lambda: self.ended.append(key), source)


def test_a_connection_without_a_request_is_cut_at_its_time_and_one_with_a_request_is_not() -> None:
    line = Line()
    line.enter(1)
    line.enter(2)
    line.loop.advance(FIRST_REQUEST_S - 0.1)
    line.silent.leave(2)
    line.silent.enter(1, lambda: None)  # does not begin anew
    assert line.ended == []
    line.loop.advance(0.2)

    assert (line.ended, line.silent.cut, len(line.silent), line.loop.timers) == ([1], 1, 0, 0)


def test_above_the_bound_the_one_that_waited_longest_is_cut_and_never_the_newest() -> None:
    line = Line(most=3, most_per_source=2)
    for key, source in enumerate("abacd"):
        line.enter(key, source)
    assert line.ended == [0, 1]  # of all, when there were four
    line.enter(5, "d")
    line.enter(6, "d")

    assert line.ended == [0, 1, 2, 4]  # of all, and of its address
    assert 6 in line.silent
    line.silent.cut_all()
    assert sorted(line.ended) == list(range(7))
    assert line.loop.timers == 0


def test_keep_alive_is_longer_than_the_balancer_keeps_a_connection() -> None:
    assert KEEP_ALIVE_S > BALANCER_IDLE_TIMEOUT_S


# --- listeners -------------------------------------------------------------------------------------

Started = AsyncIterator[int]


@contextlib.asynccontextmanager
async def control_of_a_server(folder: Path, seconds: float) -> Started:
    async def answer(_: Any) -> ControlReply:
        return ControlReply(body=b"{}")

    async with await serve_control("127.0.0.1", 0, answer, first_request_s=seconds) as server:
        yield server.sockets[0].getsockname()[1]


@contextlib.asynccontextmanager
async def control_of_a_platform(folder: Path, seconds: float) -> Started:
    async def page() -> tuple[str, bytes]:
        return "text/plain", b"{}"

    server = await serve_control_port({"/healthz": page}, {}, TOKEN, first_request_s=seconds)
    async with server:
        yield server.sockets[0].getsockname()[1]


async def answer(scope: Any, receive: Any, send: Any) -> None:
    headers = [(b"content-length", b"2")]
    await send({"type": "http.response.start", "status": 200, "headers": headers})
    await send({"type": "http.response.body", "body": b"{}"})


def data_or_fleet_page(folder: Path, seconds: float, **bounds: Any) -> Any:
    return http_service(answer, seconds=seconds, **bounds)


@contextlib.asynccontextmanager
async def owner_of_a_map(folder: Path, seconds: float) -> Started:
    async def serve(
        reader: asyncio.StreamReader, writer: asyncio.StreamWriter, named: Callable[[], Any]
    ) -> None:
        while line := await reader.readline():
            if line == b"\r\n":
                named()
                writer.write(b"HTTP/1.1 200 OK\r\n\r\n")

    context, _ = server_context("127.0.0.1", now_s=time.time())
    listening = listen("127.0.0.1", range(1))
    listener = TlsListener(listening, context, serve, seconds=seconds)
    listener.open()
    try:
        yield listening.getsockname()[1]
    finally:
        listener.close()


KINDS = [control_of_a_server, control_of_a_platform, data_or_fleet_page, owner_of_a_map]
BEGUN = (b"", b"G", b"GET /healthz HTTP/1.1\r\nHost: a\r\nContent-")
"""What silent connections send before they fall silent."""


class Honest:
    """A connection that asks."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader = reader
        self._writer = writer

    @classmethod
    async def open(cls, port: int, *, is_owner: bool) -> Honest:
        context = client_context() if is_owner else None
        return cls(*await asyncio.open_connection("127.0.0.1", port, ssl=context))

    async def ask(self) -> bytes:
        """Return the status line of one answer."""
        token = f"Authorization: Bearer {TOKEN}".encode()
        self._writer.write(b"GET /healthz HTTP/1.1\r\nHost: a\r\n" + token + b"\r\n\r\n")
        head = await self._reader.readuntil(b"\r\n\r\n")
        length = [line for line in head.lower().split(b"\r\n") if line.startswith(b"content-length")]
        await self._reader.readexactly(int(length[0].split(b":")[1]) if length else 0)
        return head.split(b"\r\n")[0]

    def close(self) -> None:
        self._writer.close()


async def silent_to(port: int, count: int, begun: tuple[bytes, ...] = BEGUN) -> list[socket.socket]:
    """Open *count* connections that begin a request at the most."""
    loop, opened = asyncio.get_running_loop(), []
    for number in range(count):
        each = socket.socket()
        each.setblocking(False)
        await loop.sock_connect(each, ("127.0.0.1", port))
        with contextlib.suppress(OSError):  # it was cut for a newer one
            await loop.sock_sendall(each, begun[number % len(begun)])
        opened.append(each)
    return opened


async def ended(each: socket.socket) -> None:
    """Wait until the server has closed *each*."""
    with contextlib.suppress(ConnectionError):
        while await asyncio.get_running_loop().sock_recv(each, 4096):
            pass


@pytest.mark.parametrize("kind", KINDS)
async def test_hundreds_of_silent_connections_are_cut_in_time_and_who_asks_is_served(
    kind: Any, tmp_path: Path
) -> None:
    is_owner = kind is owner_of_a_map

    async with kind(tmp_path, SECONDS) as port:
        first = await Honest.open(port, is_owner=is_owner)
        answered = await first.ask()
        silent = await silent_to(port, COUNT)
        began = time.monotonic()
        late = await Honest.open(port, is_owner=is_owner)
        assert await late.ask() == answered
        assert time.monotonic() - began < 1.0
        await asyncio.gather(*map(ended, silent))
        if kind is not control_of_a_platform:  # which closes each connection after its answer
            assert await first.ask() == await late.ask() == answered
        for each in (first, late, *silent):
            each.close()


@pytest.mark.parametrize("kind", KINDS)
async def test_above_the_bound_silent_connections_are_cut_at_once(kind: Any, tmp_path: Path) -> None:
    async with kind(tmp_path, 60.0) as port:
        silent = await silent_to(port, MAX_SILENT + 20, (b"",))
        await asyncio.gather(*map(ended, silent[:20]))
        newest = asyncio.ensure_future(ended(silent[-1]))
        first = await Honest.open(port, is_owner=kind is owner_of_a_map)
        assert b" 200 " in await first.ask()
        assert not newest.done()
        newest.cancel()
        for each in (first, *silent):
            each.close()


async def test_a_head_that_begins_after_an_answer_has_its_time_too(tmp_path: Path) -> None:
    async with data_or_fleet_page(tmp_path, SECONDS) as port:
        (slow,) = await silent_to(port, 1, (b"GET / HTTP/1.1\r\nHost: a\r\n\r\n",))
        assert b"200" in await asyncio.get_running_loop().sock_recv(slow, 4096)
        await asyncio.get_running_loop().sock_sendall(slow, b"GET / HTTP/1.1\r\n")
        await ended(slow)
        slow.close()


async def test_idle_connections_are_bounded_and_the_one_that_waited_longest_is_closed(tmp_path: Path) -> None:
    async with data_or_fleet_page(tmp_path, 60.0, most_idle=5) as port:
        several = [await Honest.open(port, is_owner=False) for _ in range(6)]
        for each in several:
            await each.ask()
        with pytest.raises((asyncio.IncompleteReadError, ConnectionError)):
            await several[0].ask()
        assert b" 200 " in await several[-1].ask()
        for each in several:
            each.close()
