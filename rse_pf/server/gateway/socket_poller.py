"""Which of the robots' sockets are readable, for a bounded time in each round of the event loop.

libuv polls up to 48 times within one round while 1024 sockets are readable each time: a worker that once fell
so far behind read for up to 3.9 s without looking at its timers.  So its sockets have an own epoll object.
"""

from __future__ import annotations

import asyncio
import select
from collections.abc import Callable
from typing import Any

__all__ = ["SocketPoller"]

_AT_ONCE = 64
"""Sockets that are asked for together; the kernel passes first those that were not passed for longest."""
_BOUND_S = 0.03
"""No further socket is read in a round of the event loop once reading has taken so long.  With 0.008, frames
of robots that ignore their pauses stayed in the kernel until it was too late."""


class SocketPoller:
    """The part of an event loop that the transport of a socket uses.

    Source:
        ``uv__io_poll`` of libuv (``src/unix/linux.c``); epoll(7).
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, *, clock: Callable[[], float]) -> None:
        """Read no socket yet.

        Args:
            loop: Polls the own epoll object as one of its descriptors, and does all that is not reading.
            clock: Seconds, monotonic.
        """
        self._loop = loop
        self._clock = clock
        self._epoll = select.epoll()
        self._is_polled = False
        self._callbacks: dict[int, Callable[[], Any]] = {}
        self._left: list[tuple[int, int]] = []
        """Of the sockets asked for last, those that there was no time to read."""
        self._turns_over: list[Callable[[], None]] = []
        self._leaves_unread = False

    def __getattr__(self, name: str) -> Any:
        """Return what the event loop does itself: all but reading."""
        return getattr(self._loop, name)

    def add_reader(self, fd: int, callback: Callable[[], Any]) -> None:
        """Call *callback* as long as the descriptor *fd* is readable."""
        if not self._is_polled:
            self._is_polled = True
            self._loop.add_reader(self._epoll.fileno(), self._read)
        if fd not in self._callbacks:
            self._epoll.register(fd, select.EPOLLIN)
        self._callbacks[fd] = callback

    def remove_reader(self, fd: int) -> bool:
        """End what `add_reader` began; return whether there was anything."""
        if self._callbacks.pop(fd, None) is None:
            return False
        self._epoll.unregister(fd)
        return True

    def leaves_unread(self) -> bool:
        """Return whether there was no time for some of the sockets when they were read last."""
        return self._leaves_unread

    def end_turn(self, read_on: Callable[[], None]) -> None:
        """Call *read_on* once the present callback has returned: its socket is readable behind the others."""
        self._turns_over.append(read_on)

    def _read(self) -> None:
        callbacks, turns_over, clock = self._callbacks, self._turns_over, self._clock
        until_s = clock() + _BOUND_S
        while True:
            readable = self._left or self._epoll.poll(0, _AT_ONCE)
            self._left = []
            for number, (fd, _) in enumerate(readable, 1):
                callback = callbacks.get(fd)
                if callback is not None:  # that of another socket may have ended it
                    callback()
                    while turns_over:
                        turns_over.pop()()
                    if clock() >= until_s:
                        self._left = readable[number:]
                        self._leaves_unread = True
                        return
            if len(readable) < _AT_ONCE:
                self._leaves_unread = False
                return
