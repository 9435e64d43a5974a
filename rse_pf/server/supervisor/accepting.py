"""Accept the sockets of robots, and pass those that have begun to send to workers at a limited rate.

1. At most `_ACCEPTS_AT_ONCE` sockets are accepted, then a pause of `_ACCEPT_PAUSE_S` follows.
2. A socket that has sent nothing waits, for at most the Hello timeout and among a bounded number of such
   sockets, and costs no worker anything; above the number, the one that has waited longest is closed.
3. A socket that has begun to send takes a token from a token bucket, which gains
   ``serving.max_accepts_per_s`` tokens a second and holds at most `HANDSHAKE_BURST`, and is passed on.
4. Without a token it waits, first in, first out.  While `_MAX_READY` sockets wait, no further ones are
   accepted.

The bytes of a socket are not read here: the worker reads them.
"""

from __future__ import annotations

import asyncio
import functools
import socket
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from rse_pf.config import ServingSettings
from rse_pf.http.unauthenticated import SilentConnections
from rse_pf.limits.token_bucket import TokenBucket
from rse_pf.server.gateway.rate_limits import HANDSHAKE_BURST

__all__ = ["RobotAcceptor"]

_ACCEPTS_AT_ONCE = 128  # sockets accepted before a pause, so that the event loop does its other work
_ACCEPT_PAUSE_S = 0.005  # seconds of the pause after 128 sockets: at most 25,600 a second are accepted
_MIN_PAUSE_S = 0.01  # shortest wait for a token in seconds, so that several sockets are passed on after it
_REFUSED_PAUSE_S = 0.1  # seconds from an error of accept, such as no free descriptor, to the next try
_MAX_READY = 1024  # sockets that wait for a token; while there are so many, no further sockets are accepted
_LISTEN_BACKLOG = 4096  # connections that may wait for accept in the kernel, if net.core.somaxconn allows it

_PEEK = socket.MSG_PEEK | socket.MSG_DONTWAIT

Accepted = tuple[socket.socket, int, str]
"""A socket, its number on this server, and the address of the other end."""


class RobotAcceptor:
    """Accepts the sockets of robots on one listener; its methods are called in the event loop."""

    def __init__(
        self,
        listener: socket.socket,
        serving: ServingSettings,
        *,
        silent_s: float,
        pass_on: Callable[[int, int, str], None],
        on_refused: Callable[[str], None],
    ) -> None:
        """Accept nothing yet.

        Args:
            listener: A bound socket; `close` closes it.
            serving: Settings with the limits of the server.
            silent_s: Seconds after which a socket that has sent nothing is closed.
            pass_on: Called with descriptor, number and address of a socket that has begun to send; the
                descriptor is closed after the call.
            on_refused: Called with the reason when accept fails.
        """
        self._listener = listener
        self._accept: Callable[[], tuple[int, Any]] = listener._accept  # type: ignore[attr-defined]
        """As `socket.accept`, without the system calls for family and type of the new socket."""
        self._serving = serving
        self._silent_s = silent_s
        self._pass_on = pass_on
        self._on_refused = on_refused
        self._rate = TokenBucket(serving.max_accepts_per_s, HANDSHAKE_BURST)
        self._ready: deque[Accepted] = deque()
        self._accept_pause: asyncio.TimerHandle | None = None
        self._rate_pause: asyncio.TimerHandle | None = None
        self._silent: SilentConnections[Accepted] | None = None
        self._accepted = 0
        self.pauses = 0
        """Number of times that passing on had to wait for a token."""

    @property
    def cut(self) -> int:
        """Number of sockets that were closed because they sent nothing."""
        return self._silent.cut if self._silent is not None else 0

    def open(self) -> None:
        """Begin to listen and to accept."""
        self._loop = asyncio.get_running_loop()
        self._silent = SilentConnections(
            call_later=self._loop.call_later,
            seconds=self._silent_s,
            most=self._serving.max_unauthenticated,
            most_per_source=(
                0 if self._serving.trusted_proxies else self._serving.max_unauthenticated_per_source
            ),
        )
        self._listener.listen(_LISTEN_BACKLOG)
        self._loop.add_reader(self._listener.fileno(), self._accept_some)

    def close(self) -> None:
        """Close the listener and all sockets that were not passed on."""
        for pause in (self._accept_pause, self._rate_pause):
            if pause is not None:
                pause.cancel()
        if self._silent is None:  # never opened
            self._listener.close()
        elif self._listener.fileno() >= 0:
            self._loop.remove_reader(self._listener.fileno())
            self._listener.close()
            self._silent.cut_all()
            while self._ready:
                self._ready.popleft()[0].close()

    def _accept_some(self) -> None:
        """Accept at most `_ACCEPTS_AT_ONCE` sockets, then pause."""
        for _ in range(_ACCEPTS_AT_ONCE):
            if len(self._ready) >= _MAX_READY:
                break
            try:
                fd, address = self._accept()
            except BlockingIOError:
                return
            except OSError as error:  # no descriptor is left, or the robot has closed the socket
                self._on_refused(str(error))
                self._pause_accepting(_REFUSED_PAUSE_S)
                return
            self._accepted += 1
            connection = socket.socket(socket.AF_INET, socket.SOCK_STREAM, 0, fd)
            self._take((connection, self._accepted, address[0]))
        self._pause_accepting(_ACCEPT_PAUSE_S)

    def _pause_accepting(self, pause_s: float) -> None:
        """Accept no socket for *pause_s* seconds; new connections wait in the kernel."""
        self._loop.remove_reader(self._listener.fileno())
        self._accept_pause = self._loop.call_later(pause_s, self._accept_on)

    def _accept_on(self) -> None:
        self._loop.add_reader(self._listener.fileno(), self._accept_some)

    def _take(self, accepted: Accepted) -> None:
        """Pass on or queue a new socket that has begun to send; wait for the first bytes of any other."""
        assert self._silent is not None
        connection, _, address = accepted
        if self._has_begun(accepted):
            self._serve_ready(accepted)
            return
        if connection.fileno() < 0:
            return  # the other end has closed the connection
        self._loop.add_reader(connection.fileno(), self._begin, accepted)
        self._silent.enter(accepted, functools.partial(self._drop, accepted), address)

    def _begin(self, accepted: Accepted) -> None:
        """Pass on or queue a waiting socket whose first bytes have come; nothing if it was closed instead."""
        assert self._silent is not None
        self._loop.remove_reader(accepted[0].fileno())
        self._silent.leave(accepted)
        if self._has_begun(accepted):
            self._serve_ready(accepted)

    def _drop(self, accepted: Accepted) -> None:
        self._loop.remove_reader(accepted[0].fileno())
        accepted[0].close()

    def _has_begun(self, accepted: Accepted) -> bool:
        """Return whether bytes of the socket have come; close it if its other end was closed."""
        try:
            if accepted[0].recv(1, _PEEK):
                return True
        except BlockingIOError:
            return False
        except OSError:
            pass  # the connection was reset
        accepted[0].close()
        return False

    def _serve_ready(self, accepted: Accepted) -> None:
        """Pass on *accepted*, which has begun to send, or let it wait for a token."""
        if self._rate_pause is not None or not self._try_to_pass_on(accepted):
            self._ready.append(accepted)

    def _try_to_pass_on(self, accepted: Accepted) -> bool:
        """Pass on *accepted* and return True if there is a token; else set a timer and return False."""
        wait_s = self._rate.take(time.monotonic()) if self._rate.rate > 0 else 0.0
        if wait_s > 0:
            self.pauses += 1
            self._rate_pause = self._loop.call_later(max(wait_s, _MIN_PAUSE_S), self._pass_on_some)
            return False
        self._pass_on(accepted[0].fileno(), accepted[1], accepted[2])
        accepted[0].close()
        return True

    def _pass_on_some(self) -> None:
        """Pass on as many sockets as there are tokens, in the order in which they began to send."""
        self._rate_pause = None
        while self._ready:
            # A socket may have been closed by its other end while it waited.
            if self._has_begun(self._ready[0]) and not self._try_to_pass_on(self._ready[0]):
                return
            self._ready.popleft()
