"""The socket of an owner: requests and updates of the workers of all servers, over TLS.

A message is its length and a MessagePack list.  A worker says ``hello`` with a token, the owner ``welcome``;
then requests are answered in any order.  Who does not say it in time is cut.  A worker that reads slowly gets
the newest update of each key, and no more than a bounded number of its requests is in work.
"""

from __future__ import annotations

import asyncio
import contextlib
import ssl
from collections.abc import Callable
from typing import Any

from rse_pf.errors import InternalError, RsePfError
from rse_pf.identity import RobotId
from rse_pf.ipc import FrameReader, encode_message
from rse_pf.server.live_map.owner.live_owner import LiveOwner, MapMoves
from rse_pf.silent_connections import BACKLOG, FIRST_REQUEST_S, TlsListener

__all__ = ["MAX_LINK_BYTES", "OwnerServer", "listen"]

MAX_LINK_BYTES = 4 << 20
"""One message between a worker and an owner."""
_READ_BYTES = 1 << 18
_MAX_IN_WORK = 256
_FLUSH_S = 2.0


def listen(host: str, ports: range) -> Any:
    """Return a socket that listens on *host*, on the first of *ports* that is free; port 0 takes any.

    Raises:
        OSError: None of them is free.
    """
    import socket

    failed: OSError | None = None
    for port in ports:
        try:
            return socket.create_server((host, port), backlog=BACKLOG)
        except OSError as error:
            failed = error
    assert failed is not None
    raise failed


class OwnerServer:
    """All connections of one owner; its methods are called in the event loop."""

    def __init__(
        self, owner: LiveOwner, *, check: Callable[[bytes], None], on_defect: Callable[[BaseException], None]
    ) -> None:
        """Listen to nobody yet.

        Args:
            owner: Answers.
            check: Raises Unauthorized for a token that is not valid here and now.
            on_defect: Gets what went wrong in the owner.
        """
        self._owner = owner
        self._check = check
        self._on_defect = on_defect
        self._links: set[_Link] = set()
        self._listener: TlsListener | None = None

    def open(self, listener: Any, context: ssl.SSLContext, *, hello_s: float = FIRST_REQUEST_S) -> None:
        """Serve on the socket *listener*; who has not said hello after *hello_s* is cut."""
        self._listener = TlsListener(listener, context, self._serve, seconds=hello_s)
        self._listener.open()

    def tell(self, payload: dict[str, Any]) -> None:
        """Send an update to every worker that watches the map."""
        for link in self._links:
            if link.is_watching:
                link.tell(payload)

    def beat(self, number: int) -> None:
        """Tell every worker that the lease was renewed."""
        for link in self._links:
            link.beat(number)

    async def close(self) -> None:
        """Send what is left, for a short time, and let the workers look for the next owner."""
        if self._listener is not None:
            self._listener.close()
        if self._links:
            await asyncio.wait([asyncio.ensure_future(link.move()) for link in self._links], timeout=_FLUSH_S)

    async def _serve(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, named: Callable[[], object]
    ) -> None:
        link = _Link(self._owner, writer, self._on_defect)
        link.start()
        try:
            frames = FrameReader(MAX_LINK_BYTES)
            hello, rest = await _first_message(reader, frames)
            self._check(hello)
            named()
            link.say(["welcome"])
            self._links.add(link)
            self._owner.users += 1
            try:
                await link.serve(reader, frames, rest)
            finally:
                self._owner.users -= 1
                self._links.discard(link)
        except RsePfError as error:
            link.say(["refused", 0, *_error_fields(error)])
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(link.flush(), _FLUSH_S)
        except (OSError, asyncio.TimeoutError):  # the worker is gone, or is none
            pass
        finally:
            link.end()


class _Link:
    """The connection of one worker."""

    def __init__(
        self, owner: LiveOwner, writer: asyncio.StreamWriter, on_defect: Callable[[BaseException], None]
    ) -> None:
        self.is_watching = False
        self._owner = owner
        self._writer = writer
        self._on_defect = on_defect
        self._messages: list[Any] = []
        self._updates: dict[str, dict[str, Any]] = {}
        self._beat: int | None = None
        self._has_more = asyncio.Event()
        self._is_flushed = asyncio.Event()
        self._in_work = asyncio.Semaphore(_MAX_IN_WORK)
        self._tasks: set[asyncio.Future[None]] = set()

    def start(self) -> None:
        """Begin to send."""
        self._tasks.add(asyncio.ensure_future(self._send_on()))

    def say(self, message: list[Any]) -> None:
        """Send *message* when the socket takes it."""
        self._messages.append(message)
        self._is_flushed.clear()
        self._has_more.set()

    def beat(self, number: int) -> None:
        """Tell of the newest renewal of the lease."""
        self._beat = number
        self._has_more.set()

    def tell(self, payload: dict[str, Any]) -> None:
        """Send an update, unless a newer one of its key comes before the socket takes it."""
        key = f"{payload['kind']}/{payload.get('robot', '')}"
        self._updates.pop(key, None)
        self._updates[key] = payload
        self._is_flushed.clear()
        self._has_more.set()

    async def flush(self) -> None:
        """Wait until all was sent."""
        await self._is_flushed.wait()

    async def move(self) -> None:
        """Answer what is in work, and then let the worker look for the next owner."""
        for _ in range(_MAX_IN_WORK):
            await self._in_work.acquire()
        self.say(["moving"])
        await self._is_flushed.wait()

    def end(self) -> None:
        """Close the connection."""
        for task in self._tasks:
            task.cancel()
        self._writer.close()

    async def serve(self, reader: asyncio.StreamReader, frames: FrameReader, messages: list[Any]) -> None:
        """Answer requests until the worker closes the connection."""
        while True:
            for message in messages:
                await self._take(message)
            data = await reader.read(_READ_BYTES)
            if not data:
                return
            messages = list(frames.feed(data))

    async def _take(self, message: list[Any]) -> None:
        match message:
            case ["request", int(number), [str(), str(), str()] as robot, str(operation), bytes(request)]:
                await self._in_work.acquire()
                task = asyncio.ensure_future(self._answer(number, RobotId(*robot), operation, request))
                self._tasks.add(task)
                task.add_done_callback(self._tasks.discard)
            case ["watch"]:
                self.is_watching = True
                for payload in self._owner.present():
                    self.tell(payload)
            case ["unwatch"]:
                self.is_watching = False
                self._updates.clear()

    async def _answer(self, number: int, robot: RobotId, operation: str, request: bytes) -> None:
        try:
            self.say(["answer", number, await self._owner.answer(robot, operation, request)])
        except MapMoves:
            self.say(["again", number])
        except RsePfError as error:
            self.say(["refused", number, *_error_fields(error)])
        except Exception as error:  # noqa: BLE001  the worker must not wait for it
            self._on_defect(error)
            refused = InternalError("the owner of the live map failed", hint="the server's log has it")
            self.say(["refused", number, *_error_fields(refused)])
        finally:
            self._in_work.release()

    async def _send_on(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                await self._has_more.wait()
                self._has_more.clear()
                messages = [*self._messages, *(["update", each] for each in self._updates.values())]
                if self._beat is not None:
                    messages.append(["beat", self._beat])
                self._beat = None
                self._messages.clear()
                self._updates.clear()
                self._writer.write(b"".join(map(encode_message, messages)))
                await self._writer.drain()
                if not self._has_more.is_set():
                    self._is_flushed.set()


async def _first_message(reader: asyncio.StreamReader, frames: FrameReader) -> tuple[bytes, list[Any]]:
    """Return the token of the hello, and the messages that came with it; raises RsePfError or OSError."""
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
    return [error.code, error.message, error.hint, error.retry_after_ms]
