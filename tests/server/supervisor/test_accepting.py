"""The robots' port: silent sockets wait in the supervisor, and the rate is that of sockets that send."""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
from collections.abc import AsyncIterator
from typing import Any

import pytest

from rse_pf.config import ServingSettings
from rse_pf.server.supervisor.accepting import RobotAcceptor

DEADLINE_S = 10.0


class Port:
    """An acceptor, and the numbers of the sockets that it passed on."""

    def __init__(self, *, silent_s: float, **serving: Any) -> None:
        self.listener = socket.socket()
        self.listener.bind(("127.0.0.1", 0))
        self.listener.setblocking(False)
        self.passed: asyncio.Queue[tuple[int, bytes]] = asyncio.Queue()
        settings: dict[str, Any] = {"max_unauthenticated_per_source": 0, **serving}
        self.acceptor = RobotAcceptor(
            self.listener,
            ServingSettings(**settings),
            silent_s=silent_s,
            pass_on=self._pass_on,
            on_refused=pytest.fail,
        )

    def _pass_on(self, fd: int, number: int, peer: str) -> None:
        assert peer == "127.0.0.1"
        with socket.socket(fileno=os.dup(fd)) as passed:
            self.passed.put_nowait((number, passed.recv(100)))

    async def dial(self, first: bytes = b"") -> socket.socket:
        each = socket.socket()
        each.setblocking(False)
        await asyncio.get_running_loop().sock_connect(each, self.listener.getsockname())
        each.send(first)
        return each


@contextlib.asynccontextmanager
async def opened(*, burst: int = 1000, silent_s: float = 5.0, **serving: Any) -> AsyncIterator[Port]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("rse_pf.server.supervisor.accepting.HANDSHAKE_BURST", float(burst))
        port = Port(silent_s=silent_s, **serving)
    port.acceptor.open()
    try:
        yield port
    finally:
        port.acceptor.close()


async def ended(each: socket.socket) -> None:
    with contextlib.suppress(ConnectionError):
        assert await asyncio.get_running_loop().sock_recv(each, 1) == b""


async def test_silent_sockets_take_nothing_of_the_rate_and_a_robot_is_passed_on_behind_them() -> None:
    async with opened(max_accepts_per_s=1.0, burst=1, max_unauthenticated=50) as port:
        silent = [await port.dial() for _ in range(300)]
        robot = await port.dial(b"GET")
        assert await port.passed.get() == (301, b"GET")
        await asyncio.gather(*map(ended, silent[:250]))
        assert port.acceptor.cut - 250 in (0, 1)  # the robot may have been accepted before its bytes came
        assert port.acceptor.pauses == 0
        for each in (robot, *silent):
            each.close()


async def test_a_silent_socket_is_cut_at_its_time_and_one_that_speaks_before_is_passed_on() -> None:
    async with opened(silent_s=0.2) as port:
        silent, robot = await port.dial(), await port.dial()
        robot.send(b"GET")
        assert await port.passed.get() == (2, b"GET")
        await ended(silent)
        assert port.acceptor.cut == 1
        silent.close()
        robot.close()


async def test_sockets_that_send_wait_for_the_rate_in_their_order() -> None:
    async with opened(max_accepts_per_s=100.0, burst=2) as port:
        began = asyncio.get_running_loop().time()
        robots = [await port.dial(b"GET") for _ in range(12)]
        passed = [(await port.passed.get())[0] for _ in robots]
        assert passed == list(range(1, 13))
        assert asyncio.get_running_loop().time() - began >= 0.09
        assert port.acceptor.pauses > 0
        for each in robots:
            each.close()


async def test_a_socket_that_ends_while_it_waits_takes_nothing_of_the_rate() -> None:
    async with opened(max_accepts_per_s=5.0, burst=1) as port:
        for _ in range(200):
            (await port.dial()).close()
        robot = await port.dial(b"GET")
        assert await port.passed.get() == (201, b"GET")
        assert port.acceptor.pauses == 0
        robot.close()
