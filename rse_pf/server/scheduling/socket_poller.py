"""Read the sockets of robots for a bounded time in each round of the event loop.

libuv polls up to 48 times within one round while 1024 sockets are readable each time.  A worker that had
fallen that far behind read for up to 3.9 s without running its timers.  The sockets of robots therefore have
an epoll object of their own, which the event loop polls as one descriptor.
"""

from __future__ import annotations

import asyncio
import select
from collections.abc import Callable
from typing import Any

__all__ = ["SocketPoller"]

_AT_ONCE = 64  # sockets of one poll; the kernel returns first those that it has not returned for longest
# No further socket is read in a round of the event loop after reading has taken this long.  With 0.008,
# frames of robots that ignore their pauses stayed in the kernel beyond their deadline.
_BOUND_S = 0.03


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
        """Return a method of the event loop, for everything but reading."""
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
        """Call *read_on* after the present callback has returned, so that its socket is read after others."""
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
