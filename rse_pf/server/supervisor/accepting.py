"""Accept the sockets of robots, and pass on those that have begun to send.

To accept a socket is cheap, a handshake is not.  A socket that has sent nothing waits here for a bounded
time, among a bounded number, and costs no worker anything.  ``serving.max_accepts_per_s`` limits the sockets
that are passed on.  No byte is consumed here.
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

_ACCEPTS_AT_ONCE = 128  # sockets accepted before a pause, so that the event loop serves others
_ACCEPT_PAUSE_S = 0.005  # that pause: at most 25,600 sockets a second are accepted
_MIN_PAUSE_S = 0.01  # shortest pause for the rate of accepts, so that several sockets are passed on together
_REFUSED_PAUSE_S = 0.1  # pause after the kernel refused to accept, because no descriptor is left
_MAX_READY = 1024  # sockets that have begun to send and wait for the rate; no more are accepted beyond it
_LISTEN_BACKLOG = 4096  # connections that wait for accept; the kernel reduces it to net.core.somaxconn

_PEEK = socket.MSG_PEEK | socket.MSG_DONTWAIT

Accepted = tuple[socket.socket, int, str]
"""A socket, its number on this server, and the address of the other end."""


class RobotAcceptor:
    """Accepts the sockets of robots; its methods are called in the event loop."""

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
            listener: A bound socket; closed by `close`.
            serving: Limits of the server.
            silent_s: A socket that sends nothing for this long is closed.
            pass_on: Gets descriptor, number and address of a socket that has begun to send; the descriptor is
                closed afterwards.
            on_refused: Gets the reason when the system accepts no more.
        """
        self._listener = listener
        self._accept: Callable[[], tuple[int, Any]] = listener._accept  # type: ignore[attr-defined]
        """`socket.accept` without the questions about family and kind of the socket."""
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
        """How often a socket had to wait for the rate."""

    @property
    def cut(self) -> int:
        """How many sockets were cut because they sent nothing."""
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
        """Accept no more, and cut who waits here."""
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

    # --- accepting -------------------------------------------------------------------------------

    def _accept_some(self) -> None:
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
        """Stop watching the listener for *pause_s*; it stays readable meanwhile."""
        self._loop.remove_reader(self._listener.fileno())
        self._accept_pause = self._loop.call_later(pause_s, self._accept_on)

    def _accept_on(self) -> None:
        self._loop.add_reader(self._listener.fileno(), self._accept_some)

    # --- silent sockets --------------------------------------------------------------------------

    def _take(self, accepted: Accepted) -> None:
        assert self._silent is not None
        connection, _, address = accepted
        if self._has_begun(accepted):
            self._serve_ready(accepted)
            return
        if connection.fileno() < 0:
            return  # it has ended
        self._loop.add_reader(connection.fileno(), self._begin, accepted)
        self._silent.enter(accepted, functools.partial(self._drop, accepted), address)

    def _begin(self, accepted: Accepted) -> None:
        """Pass on or queue *accepted*, whose first bytes have come; drop it if it has ended instead."""
        assert self._silent is not None
        self._loop.remove_reader(accepted[0].fileno())
        self._silent.leave(accepted)
        if self._has_begun(accepted):
            self._serve_ready(accepted)

    def _drop(self, accepted: Accepted) -> None:
        self._loop.remove_reader(accepted[0].fileno())
        accepted[0].close()

    def _has_begun(self, accepted: Accepted) -> bool:
        """Return whether bytes have come; a socket that has ended is closed."""
        try:
            if accepted[0].recv(1, _PEEK):
                return True
        except BlockingIOError:
            return False
        except OSError:
            pass  # it was reset
        accepted[0].close()
        return False

    # --- sockets that have begun to send -----------------------------------------------------------

    def _serve_ready(self, accepted: Accepted) -> None:
        """Pass on *accepted*, which has begun to send, or let it wait for the rate."""
        if self._rate_pause is not None or not self._try_to_pass_on(accepted):
            self._ready.append(accepted)

    def _try_to_pass_on(self, accepted: Accepted) -> bool:
        """Pass on *accepted* and return True if the rate allows it; else set a timer and return False."""
        wait_s = self._rate.take(time.monotonic()) if self._rate.rate > 0 else 0.0
        if wait_s > 0:
            self.pauses += 1
            self._rate_pause = self._loop.call_later(max(wait_s, _MIN_PAUSE_S), self._pass_on_some)
            return False
        self._pass_on(accepted[0].fileno(), accepted[1], accepted[2])
        accepted[0].close()
        return True

    def _pass_on_some(self) -> None:
        """Pass on as many sockets as the rate allows, in the order in which they began to send."""
        self._rate_pause = None
        while self._ready:
            # One may have ended while it waited.
            if self._has_begun(self._ready[0]) and not self._try_to_pass_on(self._ready[0]):
                return
            self._ready.popleft()
