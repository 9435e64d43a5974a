"""Open a TCP connection to one of the addresses of a host, or say soon that nobody answers.

An attempt is given up after about a second: Linux repeats an unanswered one after 1, 3 and 7 s, and a robot
whose network is back would wait for that.  A name is looked up for every attempt; while no lookup is
answered, the last known addresses are used, so that a network without name servers costs nothing.  Nothing is
retried here.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import socket
from collections import deque
from typing import Any

__all__ = ["TcpDialler"]

_LOOKUP_S = 0.25
"""A lookup that takes longer goes on, for the next attempt; this one uses the last known addresses."""
_NEXT_ADDRESS_S = 0.25
"""Source: RFC 8305, 5."""
_MAX_ADDRESSES = 4

_Address = tuple[Any, ...]
"""What `socket.getaddrinfo` returns for one address."""


class TcpDialler:
    """Opens TCP connections, and remembers the last addresses of each host."""

    def __init__(self) -> None:
        self._known: dict[tuple[str, int], list[_Address]] = {}
        self._lookups: dict[tuple[str, int], asyncio.Future[list[_Address]]] = {}

    async def connect(self, host: str, port: int, within_s: float) -> socket.socket:
        """Return a connected, non-blocking socket.

        Raises:
            OSError: Nobody answered within *within_s* (``ETIMEDOUT``), the connection was refused, there is
                no way there, or the name is not known.
        """
        until = asyncio.get_running_loop().time() + within_s
        addresses = await self._addresses(host, port, within_s)
        return await _first_answer(addresses[:_MAX_ADDRESSES], until)

    async def _addresses(self, host: str, port: int, within_s: float) -> list[_Address]:
        key = (host, port)
        with contextlib.suppress(socket.gaierror):
            numeric = socket.AI_NUMERICHOST | socket.AI_NUMERICSERV
            return socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=numeric)
        lookup = self._lookups.get(key)
        if lookup is None:
            loop = asyncio.get_running_loop()
            lookup = asyncio.ensure_future(loop.getaddrinfo(host, port, type=socket.SOCK_STREAM))
            self._lookups[key] = lookup
            lookup.add_done_callback(lambda ended: self._take_lookup(key, ended))
        known = self._known.get(key)
        done, _ = await asyncio.wait({lookup}, timeout=within_s if known is None else _LOOKUP_S)
        if done and lookup.exception() is None:
            return lookup.result()
        if known is not None:
            return known
        if done:
            return lookup.result()
        raise _nobody(f"no name server says where {host} is")

    def _take_lookup(self, key: tuple[str, int], ended: asyncio.Future[list[_Address]]) -> None:
        self._lookups.pop(key, None)
        if not ended.cancelled() and ended.exception() is None:
            self._known[key] = ended.result()


async def _first_answer(addresses: list[_Address], until: float) -> socket.socket:
    """Return the first connection of those to *addresses*, begun one after the other."""
    loop = asyncio.get_running_loop()
    rest, waiting = deque(addresses), set[asyncio.Task[socket.socket]]()
    failed: OSError | None = None
    try:
        while rest or waiting:
            left_s = until - loop.time()
            if left_s <= 0:
                break
            if rest:
                waiting.add(loop.create_task(_connect(rest.popleft())))
            timeout_s = min(left_s, _NEXT_ADDRESS_S) if rest else left_s
            done, _ = await asyncio.wait(waiting, timeout=timeout_s, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                waiting.discard(task)
                try:
                    return task.result()
                except OSError as error:
                    failed = error if failed is None or error.errno == errno.ECONNREFUSED else failed
    finally:
        for task in waiting:
            task.add_done_callback(_close)
            task.cancel()
    raise failed or _nobody("nobody answers")


async def _connect(address: _Address) -> socket.socket:
    family, kind, protocol, _, where = address
    made = socket.socket(family, kind, protocol)
    try:
        made.setblocking(False)
        await asyncio.get_running_loop().sock_connect(made, where)
    except BaseException:
        made.close()
        raise
    return made


def _close(task: asyncio.Task[socket.socket]) -> None:
    if not task.cancelled() and task.exception() is None:
        task.result().close()


def _nobody(why: str) -> OSError:
    return OSError(errno.ETIMEDOUT, why)
