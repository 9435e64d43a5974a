"""Open a TCP connection to one of the addresses of a host, or fail soon if nobody answers.

The caller limits an attempt to about a second: Linux repeats an unanswered one after 1, 3 and 7 s, and a
robot whose network is back would wait for that.  The name is looked up for every attempt; while no name
server answers, the last known addresses are used.  A failed attempt is not repeated here.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import socket
from collections import deque
from typing import Any

__all__ = ["TcpDialler"]

LOOKUP_WAIT_S = 0.25
"""If addresses of the host are known from an earlier lookup, an attempt waits this many seconds for the name
server, and then uses the known ones."""
NEXT_ADDRESS_S = 0.25
"""While no address of a host has answered, the next one is tried after this many seconds (RFC 8305, 5)."""
MAX_ADDRESSES = 4
"""An attempt tries the first of the addresses of a host, at most this many, and ignores all others: a long
list would fill the time limit."""

_AddressInfo = tuple[Any, ...]
"""What `socket.getaddrinfo` returns for one address: family, type, protocol, canonical name, socket
address."""


class TcpDialler:
    """Open TCP connections, and remember the last known addresses of each host."""

    def __init__(self) -> None:
        """Begin without known addresses of hosts."""
        self._known: dict[tuple[str, int], list[_AddressInfo]] = {}
        self._lookups: dict[tuple[str, int], asyncio.Future[list[_AddressInfo]]] = {}

    async def connect(self, host: str, port: int, within_s: float) -> socket.socket:
        """Return a connected, non-blocking socket.

        Raises:
            OSError: Nobody answered within *within_s* seconds (``ETIMEDOUT``), the connection was refused,
                there is no route to the host, or its name is unknown.
        """
        until_s = asyncio.get_running_loop().time() + within_s
        addresses = await self._find_addresses(host, port, within_s)
        return await _connect_first(addresses[:MAX_ADDRESSES], until_s)

    async def _find_addresses(self, host: str, port: int, within_s: float) -> list[_AddressInfo]:
        key = (host, port)
        # 1. Return an IP address as it is, without a name server; a host name fails here, and is looked up.
        with contextlib.suppress(socket.gaierror):
            numeric = socket.AI_NUMERICHOST | socket.AI_NUMERICSERV
            return socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=numeric)
        # 2. Look the name up; if a lookup of an earlier attempt still runs, wait for it instead.
        lookup = self._lookups.get(key)
        if lookup is None:
            loop = asyncio.get_running_loop()
            lookup = asyncio.ensure_future(loop.getaddrinfo(host, port, type=socket.SOCK_STREAM))
            self._lookups[key] = lookup
            lookup.add_done_callback(lambda ended: self._keep_addresses(key, ended))
        known = self._known.get(key)
        done, _ = await asyncio.wait({lookup}, timeout=within_s if known is None else LOOKUP_WAIT_S)
        # 3. Return the addresses of this lookup, or else the last known ones; raise if there are neither.
        if done and lookup.exception() is None:
            return lookup.result()
        if known is not None:
            return known
        if done:
            return lookup.result()  # raises the error of the lookup
        raise OSError(errno.ETIMEDOUT, f"no name server answers for {host}")

    def _keep_addresses(self, key: tuple[str, int], lookup: asyncio.Future[list[_AddressInfo]]) -> None:
        self._lookups.pop(key, None)
        if not lookup.cancelled() and lookup.exception() is None:
            self._known[key] = lookup.result()


async def _connect_first(addresses: list[_AddressInfo], until_s: float) -> socket.socket:
    """Return the first connection to one of *addresses* that succeeds.

    The attempt to the next address begins `NEXT_ADDRESS_S` after the one before, or when that one fails;
    earlier attempts go on.  All end at *until_s* of the event loop's clock, or after the first success.

    Raises:
        OSError: No attempt succeeded: the error of a refused connection if there was one, else that of the
            first attempt that failed, else ``ETIMEDOUT``.
    """
    loop = asyncio.get_running_loop()
    untried, running = deque(addresses), set[asyncio.Task[socket.socket]]()
    failure: OSError | None = None
    try:
        while untried or running:
            left_s = until_s - loop.time()
            if left_s <= 0:
                break
            if untried:
                running.add(loop.create_task(_connect(untried.popleft())))
            timeout_s = min(left_s, NEXT_ADDRESS_S) if untried else left_s
            done, _ = await asyncio.wait(running, timeout=timeout_s, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                running.discard(task)
                try:
                    return task.result()
                except OSError as error:  # prefer a refusal, which says more than a time-out
                    failure = error if failure is None or error.errno == errno.ECONNREFUSED else failure
    finally:
        for task in running:
            task.add_done_callback(_close_connection)
            task.cancel()
    raise failure or OSError(errno.ETIMEDOUT, "nobody answers")


async def _connect(address: _AddressInfo) -> socket.socket:
    family, kind, protocol, _, socket_address = address
    connection = socket.socket(family, kind, protocol)
    try:
        connection.setblocking(False)
        await asyncio.get_running_loop().sock_connect(connection, socket_address)
    except BaseException:
        connection.close()
        raise
    return connection


def _close_connection(task: asyncio.Task[socket.socket]) -> None:
    if not task.cancelled() and task.exception() is None:
        task.result().close()
