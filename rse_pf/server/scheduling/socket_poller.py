"""Read the sockets of robots for a bounded time in each round of the event loop.

Why the event loop does not poll these sockets itself: libuv polls up to 48 times within one round as long as
1024 sockets are readable each time, and an overloaded worker read for up to 3.9 s without running its timers.
The sockets of robots therefore have an epoll object of their own, which the event loop polls as one
descriptor.  In each round `SocketPoller` reads sockets for `_MAX_READ_S`; the others wait for the next round.
"""

from __future__ import annotations

import asyncio
import select
from collections.abc import Callable
from typing import Any

__all__ = ["SocketPoller"]

_MAX_POLLED = 64  # sockets that one poll returns; the kernel returns those first that waited longest
# Seconds of reading in one round of the event loop, after which no further socket is read.  With 0.008 s,
# frames of robots that ignore their pauses stayed in the kernel beyond their deadlines.
_MAX_READ_S = 0.03


class SocketPoller:
    """Takes the place of the event loop in the transports of robots' sockets, and polls these sockets.

    All other methods of the event loop are passed on to it.

    Source:
        ``uv__io_poll`` of libuv (``src/unix/linux.c``); epoll(7).
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, *, clock: Callable[[], float]) -> None:
        """Read no socket yet.

        Args:
            loop: The event loop, which polls the epoll object of this poller as one descriptor.
            clock: Returns monotonic seconds.
        """
        self._loop = loop
        self._clock = clock
        self._epoll = select.epoll()
        self._is_polled = False
        self._callbacks: dict[int, Callable[[], Any]] = {}
        self._unread: list[tuple[int, int]] = []
        """Descriptors and events that the last poll returned, and that there was no time to read."""
        self._after_callback: list[Callable[[], None]] = []
        """Called when the callback of the present socket has returned, see `read_after_others`."""
        self._leaves_unread = False

    def __getattr__(self, name: str) -> Any:
        """Return the method *name* of the event loop, for everything but reading."""
        return getattr(self._loop, name)

    def add_reader(self, fd: int, callback: Callable[[], Any]) -> None:
        """Call *callback* whenever the descriptor *fd* is readable, until `remove_reader`."""
        if not self._is_polled:
            self._is_polled = True
            self._loop.add_reader(self._epoll.fileno(), self._read)
        if fd not in self._callbacks:
            self._epoll.register(fd, select.EPOLLIN)
        self._callbacks[fd] = callback

    def remove_reader(self, fd: int) -> bool:
        """Stop watching the descriptor *fd*; return whether it was watched."""
        if self._callbacks.pop(fd, None) is None:
            return False
        self._epoll.unregister(fd)
        return True

    def leaves_unread(self) -> bool:
        """Return whether the last round left readable sockets unread, because its time was used up."""
        return self._leaves_unread

    def read_after_others(self, read_on: Callable[[], None]) -> None:
        """Call *read_on* when the callback of the present socket has returned.

        A transport that has paused reading gives the function that resumes it, so that its socket is read
        again only after the other readable sockets.
        """
        self._after_callback.append(read_on)

    def _read(self) -> None:
        """Call the callbacks of readable sockets for at most `_MAX_READ_S`; leave the others unread."""
        callbacks, after_callback, clock = self._callbacks, self._after_callback, self._clock
        until_s = clock() + _MAX_READ_S
        while True:
            readable = self._unread or self._epoll.poll(0, _MAX_POLLED)
            self._unread = []
            for number, (fd, _) in enumerate(readable, 1):
                callback = callbacks.get(fd)
                if callback is not None:  # None if the callback of another socket has closed this socket
                    callback()
                    while after_callback:
                        after_callback.pop()()
                    if clock() >= until_s:
                        self._unread = readable[number:]
                        self._leaves_unread = True
                        return
            if len(readable) < _MAX_POLLED:
                self._leaves_unread = False
                return
