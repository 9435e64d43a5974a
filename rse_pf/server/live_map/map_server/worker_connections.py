"""Serve the connections of workers to a map server: requests, replies and updates over TLS.

A message is a MessagePack list with its length in front (`rse_pf.processes.ipc`):

1. The worker sends ``hello`` with a token within `FIRST_REQUEST_S` seconds, else its connection is closed.
2. The map server answers ``welcome``, or ``refused`` and closes the connection.
3. The worker sends any number of ``request``, ``watch`` (send updates) and ``unwatch``.
4. The map server replies to each request with ``answer``, ``refused`` or ``again`` (the map moves), in any
   order, and sends ``update`` and ``beat`` (the lease was renewed).
5. The map server sends ``moving`` when it gives the map up.

A worker that reads slowly gets only the newest update of each key.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import ssl
from collections.abc import Callable
from typing import Any

from rse_pf.errors import InternalError, RsePfError
from rse_pf.http.unauthenticated import BACKLOG, FIRST_REQUEST_S, TlsListener
from rse_pf.identity import RobotId
from rse_pf.processes.ipc import FrameReader, encode_message
from rse_pf.server.live_map.connection_security import MAX_MESSAGE_BYTES
from rse_pf.server.live_map.map_server.map_server import MapMoving, MapServer

__all__ = ["WorkerConnections", "listen"]

_READ_BYTES = 1 << 18  # largest number of bytes that one read of a worker's socket returns
_MAX_CONCURRENT_REQUESTS = 256
"""Largest number of unanswered requests of one worker; at this number, nothing more is read from the socket
of the worker, so that memory is bounded."""
_FLUSH_S = 2.0
"""Seconds for which a map server waits until its last messages are written to the sockets of workers, when
the map is given up and before a refused connection is closed; then it continues, although messages may be
lost."""


def listen(host: str, ports: range) -> socket.socket:
    """Return a socket that listens on *host*, on the first free port of *ports*; port 0 is any free port.

    Raises:
        OSError: No port of *ports*, which is not empty, is free, or *host* is no address of this machine.
    """
    last_error: OSError | None = None
    for port in ports:
        try:
            return socket.create_server((host, port), backlog=BACKLOG)
        except OSError as error:
            last_error = error
    assert last_error is not None
    raise last_error


class WorkerConnections:
    """All connections of workers to one map server; all methods are called in the event loop."""

    def __init__(
        self,
        map_server: MapServer,
        *,
        check_token: Callable[[bytes], None],
        on_defect: Callable[[BaseException], None],
    ) -> None:
        """Prepare to serve connections; `open` begins to accept them.

        Args:
            map_server: Answers the requests.
            check_token: Raises Unauthorized unless a token is valid for a connection to this map server now.
            on_defect: Called with each unexpected exception.
        """
        self._map_server = map_server
        self._check_token = check_token
        self._on_defect = on_defect
        self._connections: set[_WorkerConnection] = set()
        self._listener: TlsListener | None = None

    def open(self, listener: socket.socket, context: ssl.SSLContext) -> None:
        """Accept connections on the listening socket *listener*.

        A connection without a complete ``hello`` after `FIRST_REQUEST_S` seconds is closed.
        """
        self._listener = TlsListener(listener, context, self._serve, seconds=FIRST_REQUEST_S)
        self._listener.open()

    def send_update(self, payload: dict[str, Any]) -> None:
        """Send an update to every worker that has subscribers of the map."""
        for connection in self._connections:
            if connection.is_watching:
                connection.send_update(payload)

    def send_renewal(self, number: int) -> None:
        """Send the *number* of the newest renewal of the lease to every worker."""
        for connection in self._connections:
            connection.send_renewal(number)

    async def close(self) -> None:
        """Accept no more connections, wait until running requests are answered, and send workers ``moving``.

        Return after 2 s in any case, although requests may have no answer yet.
        """
        if self._listener is not None:
            self._listener.close()
        if self._connections:
            finishing = [asyncio.ensure_future(connection.finish()) for connection in self._connections]
            await asyncio.wait(finishing, timeout=_FLUSH_S)

    async def _serve(
        self,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
        mark_authenticated: Callable[[], object],
    ) -> None:
        """Authenticate the peer of a new connection by its token, and serve it until it disconnects."""
        connection = _WorkerConnection(self._map_server, writer, self._on_defect)
        connection.start()
        try:
            frames = FrameReader(MAX_MESSAGE_BYTES)
            token, messages = await _read_hello(reader, frames)
            self._check_token(token)
            mark_authenticated()
            connection.send(["welcome"])
            self._connections.add(connection)
            self._map_server.users += 1
            try:
                await connection.serve(reader, frames, messages)
            finally:
                self._map_server.users -= 1
                self._connections.discard(connection)
        except RsePfError as error:
            connection.send(["refused", 0, *_error_fields(error)])
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(connection.flush(), _FLUSH_S)
        except (OSError, asyncio.TimeoutError):  # disconnected, or not a worker: close without an answer
            pass
        finally:
            connection.close()


class _WorkerConnection:
    """The connection of one worker to this map server: a queue of messages and the requests in progress."""

    def __init__(
        self,
        map_server: MapServer,
        writer: asyncio.StreamWriter,
        on_defect: Callable[[BaseException], None],
    ) -> None:
        self.is_watching = False
        """Whether the worker has subscribers of the map."""
        self._map_server = map_server
        self._writer = writer
        self._on_defect = on_defect
        self._messages: list[Any] = []
        self._updates: dict[str, dict[str, Any]] = {}  # updates that were not written yet, by key
        self._renewal: int | None = None  # renewal of the lease that was not written yet
        self._has_unsent = asyncio.Event()
        self._is_flushed = asyncio.Event()
        self._request_slots = asyncio.Semaphore(_MAX_CONCURRENT_REQUESTS)
        self._tasks: set[asyncio.Future[None]] = set()

    def start(self) -> None:
        """Start the task that writes queued messages to the worker's socket."""
        self._tasks.add(asyncio.ensure_future(self._write_messages()))

    def send(self, message: list[Any]) -> None:
        """Queue *message* to be written to the worker's socket."""
        self._messages.append(message)
        self._is_flushed.clear()
        self._has_unsent.set()

    def send_renewal(self, number: int) -> None:
        """Queue the number of a renewal of the lease; it replaces an older one that was not written yet."""
        self._renewal = number
        self._has_unsent.set()

    def send_update(self, payload: dict[str, Any]) -> None:
        """Queue an update; it replaces an older update of the same key that was not written yet."""
        key = f"{payload['kind']}/{payload.get('robot', '')}"
        self._updates.pop(key, None)
        self._updates[key] = payload
        self._is_flushed.clear()
        self._has_unsent.set()

    async def flush(self) -> None:
        """Wait until the messages and updates that were queued before this call are written to the socket."""
        await self._is_flushed.wait()

    async def finish(self) -> None:
        """Wait until the requests of the worker are answered, and send ``moving``: the map is given up.

        Further requests of the worker are not handled any more.
        """
        for _ in range(_MAX_CONCURRENT_REQUESTS):
            await self._request_slots.acquire()
        self.send(["moving"])
        await self._is_flushed.wait()

    def close(self) -> None:
        """Cancel the requests of the worker and the writing of messages, and close its socket."""
        for task in self._tasks:
            task.cancel()
        self._writer.close()

    async def serve(self, reader: asyncio.StreamReader, frames: FrameReader, messages: list[Any]) -> None:
        """Handle *messages*, which came with the hello, and all later ones until the worker disconnects."""
        while True:
            for message in messages:
                await self._handle(message)
            data = await reader.read(_READ_BYTES)
            if not data:
                return
            messages = list(frames.feed(data))

    async def _handle(self, message: list[Any]) -> None:
        match message:
            case ["request", int(number), [str(), str(), str()] as robot, str(operation), bytes(request)]:
                await self._request_slots.acquire()
                task = asyncio.ensure_future(self._answer(number, RobotId(*robot), operation, request))
                self._tasks.add(task)
                task.add_done_callback(self._tasks.discard)
            case ["watch"]:
                self.is_watching = True
                for payload in self._map_server.current_updates():
                    self.send_update(payload)
            case ["unwatch"]:
                self.is_watching = False
                self._updates.clear()

    async def _answer(self, number: int, robot: RobotId, operation: str, request: bytes) -> None:
        """Answer the request *number* of the worker: with ``answer``, ``again`` or ``refused``.

        A map that is being given up answers ``again``.  Every other exception is sent as a refusal, and one
        that is no RsePfError is reported as a defect.
        """
        try:
            self.send(["answer", number, await self._map_server.answer(robot, operation, request)])
        except MapMoving:
            self.send(["again", number])
        except RsePfError as error:
            self.send(["refused", number, *_error_fields(error)])
        except Exception as error:  # noqa: BLE001  a defect
            self._on_defect(error)
            refused = InternalError(
                "the map server failed on this request", hint="read the traceback in the server's log"
            )
            self.send(["refused", number, *_error_fields(refused)])
        finally:
            self._request_slots.release()

    async def _write_messages(self) -> None:
        """Write queued messages, updates and the newest renewal to the socket until it fails."""
        with contextlib.suppress(OSError):
            while True:
                await self._has_unsent.wait()
                self._has_unsent.clear()
                messages = [*self._messages, *(["update", payload] for payload in self._updates.values())]
                if self._renewal is not None:
                    messages.append(["beat", self._renewal])
                self._renewal = None
                self._messages.clear()
                self._updates.clear()
                self._writer.write(b"".join(map(encode_message, messages)))
                await self._writer.drain()
                if not self._has_unsent.is_set():
                    self._is_flushed.set()


async def _read_hello(reader: asyncio.StreamReader, frames: FrameReader) -> tuple[bytes, list[Any]]:
    """Read the first message; return its token, and the messages that came with it.

    Raises:
        ConnectionResetError: The peer disconnected, or the first message is not ``hello``.
        RsePfError: The peer sent malformed bytes.
    """
    while True:
        data = await reader.read(_READ_BYTES)
        if not data:
            raise ConnectionResetError
        messages = list(frames.feed(data))
        if messages:
            match messages[0]:
                case ["hello", bytes(token)]:
                    return token, messages[1:]
            raise ConnectionResetError


def _error_fields(error: RsePfError) -> list[Any]:
    """Return code, message, hint and retry time (ms) of *error*, which the message ``refused`` ends with."""
    return [error.code, error.message, error.hint, error.retry_after_ms]
