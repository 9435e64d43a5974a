"""Connections that have not said who they are: a bounded number, each for a bounded time.

What an open socket costs before its first whole request is what a stranger can make a server spend.  Every
listener of the platform counts such connections here.  Nothing is read and nothing is judged here.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import socket
import ssl
from collections.abc import Callable, Hashable
from typing import Any, Generic, TypeVar

from rse_pf.config.front_door import BALANCER_IDLE_TIMEOUT_S

__all__ = [
    "BACKLOG",
    "FIRST_REQUEST_S",
    "KEEP_ALIVE_S",
    "PendingHandshakes",
    "SilentConnections",
    "TlsListener",
]

FIRST_REQUEST_S = 6.0
"""Time from the acceptance of a connection to its first whole head of a request, or hello.  With the waits
before the acceptance, and for the close among 5,000 others, a silent client is gone after ten seconds."""
BACKLOG = 4096
"""Connections that wait to be accepted: above that the kernel drops them, also those of robots, and they are
tried again after 1 and 3 s.  The kernel cuts it to net.core.somaxconn."""
KEEP_ALIVE_S = BALANCER_IDLE_TIMEOUT_S + 10.0
"""How long a served connection may be idle: longer than load balancers keep theirs, which would otherwise
send a request into a connection that is just being closed."""
MAX_SILENT = 256
"""Silent connections of one listener."""
_MAX_ACCEPTED_AT_ONCE = 32
"""Connections that are accepted in one round of the event loop."""
_MAX_SILENT_TLS = 128
"""Silent connections of one listener with TLS, whose handshake holds some 300 KiB each."""
_PAUSE_S = 0.2
"""After the system refused to accept: it has no descriptor left."""

Key = TypeVar("Key", bound=Hashable)


class PendingHandshakes(Generic[Key]):
    """Sockets that have not sent a token yet; when there are too many, the one that waited longest is cut.

    A robot sends its token within milliseconds, so the socket that waited longest is least likely to be one.
    If the newest were cut instead, a few silent sockets would lock the robots out.
    """

    def __init__(self, max_sockets: int, max_per_source: int) -> None:
        self._max_sockets = max_sockets
        self._max_per_source = max_per_source
        self._sources: dict[Key, str] = {}
        self._of_source: dict[str, dict[Key, None]] = {}

    def __len__(self) -> int:
        """Return how many wait."""
        return len(self._sources)

    def enter(self, key: Key, source: str) -> Key | None:
        """Add *key*; return the one to cut for it, if there are too many."""
        self._sources[key] = source
        own = self._of_source.setdefault(source, {})
        own[key] = None
        leaving: Key | None = None
        if self._max_per_source and len(own) > self._max_per_source:
            leaving = next(iter(own))
        elif len(self._sources) > self._max_sockets:
            leaving = next(iter(self._sources))
        if leaving is not None:
            self.leave(leaving)
        return leaving

    def leave(self, key: Key) -> None:
        """Forget one that sent a token, or is gone."""
        source = self._sources.pop(key, None)
        if source is None:
            return
        own = self._of_source[source]
        del own[key]
        if not own:
            del self._of_source[source]


class SilentConnections(Generic[Key]):
    """The connections of one listener that have sent no whole request yet."""

    def __init__(
        self,
        *,
        call_later: Callable[..., asyncio.TimerHandle],
        seconds: float = FIRST_REQUEST_S,
        most: int = MAX_SILENT,
        most_per_source: int = 0,
    ) -> None:
        """Know of no connection yet.

        Args:
            call_later: Of the event loop.
            seconds: After this a connection is cut.
            most: Above this, the connection that has waited longest is cut.
            most_per_source: The same for one address; 0 is no bound.
        """
        self.cut = 0
        """How many were cut."""
        self._line: PendingHandshakes[Key] = PendingHandshakes(most, most_per_source)
        self._call_later = call_later
        self._seconds = seconds
        self._waiting: dict[Key, tuple[asyncio.TimerHandle, Callable[[], object], str]] = {}

    def __len__(self) -> int:
        """Return how many wait."""
        return len(self._waiting)

    def __contains__(self, key: Key) -> bool:
        """Return whether *key* waits."""
        return key in self._waiting

    def enter(self, key: Key, cut: Callable[[], object], source: str = "") -> None:
        """Count the connection *key* from the address *source*, which *cut* ends; one that waits stays."""
        if key in self._waiting:
            return
        self._waiting[key] = self._call_later(self._seconds, self._cut, key), cut, source
        surplus = self._line.enter(key, source)
        if surplus is not None:
            self._cut(surplus)

    def leave(self, key: Key) -> str | None:
        """Forget one that sent its request, or is gone; return its address, None if it did not wait."""
        entry = self._waiting.pop(key, None)
        if entry is None:
            return None
        timer, _, source = entry
        timer.cancel()
        self._line.leave(key)
        return source

    def cut_all(self) -> None:
        """Cut all of them: the server leaves."""
        for key in list(self._waiting):
            self._cut(key)

    def _cut(self, key: Key) -> None:
        _, cut, _ = self._waiting[key]
        self.leave(key)
        self.cut += 1
        cut()


class TlsListener:
    """Accepts connections with TLS; one that sends nothing costs its socket alone.

    asyncio makes the objects of TLS, some 300 KiB, when it accepts.  Here they are made when the first bytes
    have come.
    """

    def __init__(
        self,
        listening: socket.socket,
        context: ssl.SSLContext,
        serve: Callable[[asyncio.StreamReader, asyncio.StreamWriter, Callable[[], object]], Any],
        *,
        seconds: float = FIRST_REQUEST_S,
        most: int = _MAX_SILENT_TLS,
        most_per_source: int = _MAX_SILENT_TLS // 2,
    ) -> None:
        """Accept nothing yet.

        Args:
            listening: A socket that listens; closed by `close`.
            context: Of a server.
            serve: A coroutine function; called after the handshake of TLS with reader, writer and a function
                that it calls when the other side has said who it is.
            seconds: See `SilentConnections`; the handshake is part of it.
            most: See `SilentConnections`.
            most_per_source: See `SilentConnections`.
        """
        self._listening = listening
        self._context = context
        self._serve = serve
        self._loop = asyncio.get_running_loop()
        self._seconds = seconds
        self.silent: SilentConnections[object] = SilentConnections(
            call_later=self._loop.call_later, seconds=seconds, most=most, most_per_source=most_per_source
        )
        self._tasks: set[asyncio.Task[None]] = set()
        self._raw: set[socket.socket] = set()
        """Sockets of tasks that have not shaken hands."""
        self._pause: asyncio.TimerHandle | None = None

    def open(self) -> None:
        """Begin to accept."""
        self._listening.setblocking(False)
        self._loop.add_reader(self._listening.fileno(), self._accept)

    def close(self) -> None:
        """Accept no more, and cut who said nothing; what was served goes on."""
        if self._pause is not None:
            self._pause.cancel()
        self._loop.remove_reader(self._listening.fileno())
        self._listening.close()
        self.silent.cut_all()

    def _accept(self) -> None:
        for _ in range(_MAX_ACCEPTED_AT_ONCE):
            try:
                accepted, peer = self._listening.accept()
            except BlockingIOError:
                return
            except OSError:
                self._loop.remove_reader(self._listening.fileno())
                self._pause = self._loop.call_later(_PAUSE_S, self.open)
                return
            accepted.setblocking(False)
            self.silent.enter(accepted, functools.partial(self._drop, accepted), str(peer[0]))
            if accepted in self.silent:
                self._loop.add_reader(accepted.fileno(), self._begin, accepted)

    def _drop(self, accepted: socket.socket) -> None:
        self._loop.remove_reader(accepted.fileno())
        accepted.close()

    def _begin(self, accepted: socket.socket) -> None:
        """Shake hands: the first bytes have come, or the end."""
        self._loop.remove_reader(accepted.fileno())
        source = self.silent.leave(accepted) or ""
        self._raw.add(accepted)
        task = self._loop.create_task(self._shake_hands(accepted))
        self._tasks.add(task)
        self.silent.enter(task, task.cancel, source)
        task.add_done_callback(functools.partial(self._on_end, accepted))

    def _on_end(self, accepted: socket.socket, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        self.silent.leave(task)
        if accepted in self._raw:
            self._raw.discard(accepted)
            accepted.close()

    async def _shake_hands(self, accepted: socket.socket) -> None:
        task = asyncio.current_task()
        reader = asyncio.StreamReader()
        try:
            transport, protocol = await self._loop.connect_accepted_socket(
                lambda: asyncio.StreamReaderProtocol(reader), accepted, ssl=self._context,
                ssl_handshake_timeout=self._seconds,
            )  # fmt: skip
        except OSError:
            return  # it was no TLS, or it has ended
        self._raw.discard(accepted)  # the transport closes it
        writer = asyncio.StreamWriter(transport, protocol, reader, self._loop)
        with contextlib.closing(writer):
            await self._serve(reader, writer, lambda: self.silent.leave(task))
