"""Bound the number and the age of connections that have not sent their first whole request.

Anybody can open such connections, and each costs the server memory and a file descriptor.  Each listener of
the platform counts them by a class of this module, which closes the oldest ones.  This module neither reads
requests nor checks tokens.
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
"""Longest time in seconds from the acceptance of a connection to the end of its first request head or Hello.
With 5,000 silent connections, the wait for acceptance and the closing take up to four seconds more: ten
seconds in all."""
BACKLOG = 4096
"""Most connections of a listener that wait for acceptance.  Above that the kernel drops new connections,
including those of robots, and clients retry after 1 and 3 s.  The kernel limits the value to
net.core.somaxconn."""
KEEP_ALIVE_S = BALANCER_IDLE_TIMEOUT_S + 10.0
"""Longest time in seconds for which a connection may be idle after a reply.  It exceeds the idle timeout of
load balancers, which would otherwise send requests on connections that the server is closing."""
MAX_SILENT = 256
"""Most connections of one listener that have not sent a whole request; robots send one within
milliseconds."""
_MAX_ACCEPTED_AT_ONCE = 32
"""Most connections that are accepted in one iteration of the event loop, so that other connections are served
in between."""
_MAX_SILENT_TLS = 128
"""The same as `MAX_SILENT` for a listener with TLS, where a handshake takes some 300 KiB of memory."""
_ACCEPT_PAUSE_S = 0.2
"""Seconds for which a listener pauses after accept(2) failed, because the process has no file descriptor
left until a connection is closed."""

Key = TypeVar("Key", bound=Hashable)


class PendingHandshakes(Generic[Key]):
    """Counts sockets that have not sent a token yet; above a limit it names the oldest one, to be closed.

    A robot sends its token within milliseconds, so the oldest socket is least likely that of a robot.  If the
    newest socket were closed instead, a few silent sockets would prevent robots from connecting.
    """

    def __init__(self, max_sockets: int, max_per_source: int) -> None:
        """Begin without sockets; *max_per_source* limits those of one source address, 0 is no limit."""
        self._max_sockets = max_sockets
        self._max_per_source = max_per_source
        self._sources: dict[Key, str] = {}
        self._of_source: dict[str, dict[Key, None]] = {}

    def __len__(self) -> int:
        """Return the number of counted sockets."""
        return len(self._sources)

    def enter(self, key: Key, source: str) -> Key | None:
        """Count the socket *key* from the address *source*; return the socket that the caller has to close.

        That socket is not counted any more.  None if no limit is exceeded.
        """
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
        """Stop counting the socket *key*, which sent a token or was closed; do nothing if it is unknown."""
        source = self._sources.pop(key, None)
        if source is None:
            return
        own = self._of_source[source]
        del own[key]
        if not own:
            del self._of_source[source]


class SilentConnections(Generic[Key]):
    """The connections of one listener that have not sent a whole request yet.

    A connection is closed when it is too old, or when it is the oldest one of too many.
    """

    def __init__(
        self,
        *,
        call_later: Callable[..., asyncio.TimerHandle],
        seconds: float = FIRST_REQUEST_S,
        most: int = MAX_SILENT,
        most_per_source: int = 0,
    ) -> None:
        """Begin without connections.

        Args:
            call_later: The method of that name of the event loop.
            seconds: Age in seconds at which a connection is closed.
            most: Number of connections above which the oldest one is closed.
            most_per_source: The same for the connections from one source address; 0 is no limit.
        """
        self.cut = 0
        """Number of connections that this object has closed."""
        self._line: PendingHandshakes[Key] = PendingHandshakes(most, most_per_source)
        self._call_later = call_later
        self._seconds = seconds
        self._waiting: dict[Key, tuple[asyncio.TimerHandle, Callable[[], object], str]] = {}

    def __len__(self) -> int:
        """Return the number of counted connections."""
        return len(self._waiting)

    def __contains__(self, key: Key) -> bool:
        """Return whether the connection *key* is counted."""
        return key in self._waiting

    def enter(self, key: Key, cut: Callable[[], object], source: str = "") -> None:
        """Count the connection *key* from the address *source* from now on; *cut* is called to close it.

        A connection that is counted already keeps its age.  If there are too many now, the oldest is closed.
        """
        if key in self._waiting:
            return
        self._waiting[key] = self._call_later(self._seconds, self._cut, key), cut, source
        surplus = self._line.enter(key, source)
        if surplus is not None:
            self._cut(surplus)

    def leave(self, key: Key) -> str | None:
        """Stop counting the connection *key*, which sent its request or was closed.

        Returns its source address, None if it was not counted.
        """
        entry = self._waiting.pop(key, None)
        if entry is None:
            return None
        timer, _, source = entry
        timer.cancel()
        self._line.leave(key)
        return source

    def cut_all(self) -> None:
        """Close all counted connections, because the server stops."""
        for key in list(self._waiting):
            self._cut(key)

    def _cut(self, key: Key) -> None:
        _, cut, _ = self._waiting[key]
        self.leave(key)
        self.cut += 1
        cut()


class TlsListener:
    """Accepts connections with TLS, and bounds those of clients that have not authenticated themselves.

    asyncio creates the TLS objects of a connection, some 300 KiB, when it accepts the connection.  This
    listener creates them when the first bytes arrive, so that a silent client costs a socket only.
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
        """Prepare the listener; `open` begins to accept connections.

        Args:
            listening: A listening socket; `close` closes it.
            context: TLS context of a server.
            serve: A coroutine function that is called after the TLS handshake with a reader, a writer, and a
                function to call when the client has authenticated itself.
            seconds: Seconds after which a client that has not authenticated itself is disconnected: first
                from the acceptance to its first bytes, then from these on.
            most: Most connections of such clients; above that the oldest one is closed.
            most_per_source: Most connections of such clients from one source address.
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
        """Sockets whose TLS handshake is not complete."""
        self._pause: asyncio.TimerHandle | None = None

    def open(self) -> None:
        """Begin to accept connections, also again after a pause."""
        self._listening.setblocking(False)
        self._loop.add_reader(self._listening.fileno(), self._accept)

    def close(self) -> None:
        """Stop accepting, and close unauthenticated connections; authenticated connections stay open."""
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
                self._pause = self._loop.call_later(_ACCEPT_PAUSE_S, self.open)
                return
            accepted.setblocking(False)
            self.silent.enter(accepted, functools.partial(self._drop, accepted), str(peer[0]))
            if accepted in self.silent:
                self._loop.add_reader(accepted.fileno(), self._begin, accepted)

    def _drop(self, accepted: socket.socket) -> None:
        self._loop.remove_reader(accepted.fileno())
        accepted.close()

    def _begin(self, accepted: socket.socket) -> None:
        """Start the TLS handshake of *accepted*, after its first bytes, or its end, have arrived."""
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
        """Make the TLS handshake, then serve the connection; return at once if the handshake fails."""
        task = asyncio.current_task()
        reader = asyncio.StreamReader()
        try:
            transport, protocol = await self._loop.connect_accepted_socket(
                lambda: asyncio.StreamReaderProtocol(reader), accepted, ssl=self._context,
                ssl_handshake_timeout=self._seconds,
            )  # fmt: skip
        except OSError:
            return  # the client does not speak TLS, or has closed the connection
        self._raw.discard(accepted)  # the transport closes it
        writer = asyncio.StreamWriter(transport, protocol, reader, self._loop)
        with contextlib.closing(writer):
            await self._serve(reader, writer, lambda: self.silent.leave(task))
