"""The robots' sockets of one worker: picows on uvloop, between the supervisor's descriptors and the
dispatcher.

Only this file knows picows.  The text of an exception never reaches a robot, a robot that reads too slowly is
cut off, and nothing behind the first CLOSE frame is read.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Callable
from functools import partial
from typing import Any

from rse_pf.backend.gateway.audit_recorder import AuditRecorder
from rse_pf.backend.gateway.connection import RobotConnection
from rse_pf.backend.gateway.dispatcher import Dispatcher
from rse_pf.backend.gateway.frames import CloseBorder
from rse_pf.backend.gateway.handshake import HEALTH, Accepted, HandshakePolicy, Rejected
from rse_pf.backend.gateway.rate_limits import PendingHandshakes, SourceRates
from rse_pf.config import ServingSettings
from rse_pf.errors import MissingExtra

__all__ = ["PendingSocket", "RobotSockets", "listener_type", "protocol_type"]

_MAX_CLOSE_REASON_BYTES = 123
_TOO_LONG = b"HTTP/1.1 431 Request Header Fields Too Large\r\nConnection: close\r\nContent-Length: 0\r\n\r\n"
_MAX_READ_BYTES = 16384
"""Bytes read at once: thousands of the smallest frames fit in, and the other robots wait meanwhile."""
_LINGER_S = 2.0
"""Time that a robot has to read the CLOSE frame and to end its side; then the socket is cut."""
_READ_BUFFER_BYTES = 2048
"""The first read buffer of a socket; it grows with the messages."""


class _NoLogger:
    """The logger that picows gets; otherwise it would make one for each socket."""

    def isEnabledFor(self, level: int) -> bool:
        return False

    def log(self, *args: Any) -> None: ...

    debug = info = warning = error = exception = log


class PendingSocket:
    """A socket until its handshake is judged."""

    __slots__ = ("_is_cut", "_left_bytes", "_transport", "number", "peer", "source")

    def __init__(self, peer: str, max_head_bytes: int, number: int = 0) -> None:
        self.peer = self.source = peer
        self.number = number
        self._left_bytes = max_head_bytes
        self._transport: Any = None
        self._is_cut = False

    def connected(self, transport: Any) -> None:
        """Know the transport; the socket may have been cut before."""
        self._transport = transport
        if self._is_cut:
            transport.abort()

    def cut(self) -> None:
        """End the socket without an answer."""
        self._is_cut = True
        if self._transport is not None:
            self._transport.abort()

    def is_too_long(self, size: int) -> bool:
        """Count *size* more bytes of the request head; answer one that is too long."""
        self._left_bytes -= size
        if self._left_bytes < 0 and not self._is_cut:
            self._is_cut = True
            self._transport.write(_TOO_LONG)
            self._transport.close()
            return True
        return self._is_cut


class RobotSockets:
    """Takes accepted sockets, and connects each robot whose handshake is accepted to the dispatcher."""

    def __init__(
        self,
        dispatcher: Dispatcher,
        handshake: HandshakePolicy,
        *,
        max_robots: int,
        workers: int,
        new_name: Callable[[], str],
        recorder: AuditRecorder,
    ) -> None:
        self._dispatcher = dispatcher
        self._context = dispatcher.context
        self._handshake = handshake
        serving = self._context.settings.serving
        self._max_robots = max_robots
        self._sources = SourceRates(serving)
        per_source = 0 if serving.trusted_proxies else serving.max_unauthenticated_per_source
        self._pending: PendingHandshakes[PendingSocket] = PendingHandshakes(
            -(-serving.max_unauthenticated // workers), -(-per_source // workers)
        )
        self._new_name = new_name
        self._recorder = recorder
        self._tasks: set[asyncio.Task[None]] = set()
        picows, self._connect_accepted_socket = _libraries()
        self._picows = picows
        self._protocol = protocol_type(picows)
        self._listener = listener_type(picows, self._context.loop, serving)
        self._arguments = (
            _NoLogger(), True, serving.handshake_timeout_s,
            False, 20.0, 20.0, picows.WSAutoPingStrategy.PING_WHEN_IDLE, False,
            self._context.settings.session.max_message_bytes, None, _READ_BUFFER_BYTES,
        )  # fmt: skip

    def take(self, fd: int, ended: Callable[[], None], number: int) -> None:
        """Serve the accepted socket *fd*, the server's *number*-th; *ended* is called once, at its end."""
        accepted = socket.socket(fileno=fd)
        accepted.setblocking(False)
        # Otherwise the kernel buffers megabytes for a slow reader, unnoticed.
        serving = self._context.settings.serving
        accepted.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, serving.write_buffer_bytes)
        pending = PendingSocket(_peer(accepted), serving.max_handshake_bytes, number)
        surplus = self._pending.enter(pending, pending.peer)
        if surplus is not None:
            self._context.metrics.closed["unauthenticated"] += 1
            surplus.cut()

        def gone() -> None:
            self._pending.leave(pending)
            ended()

        task = self._context.loop.create_task(self._serve(accepted, pending, gone))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _serve(
        self, accepted: socket.socket, pending: PendingSocket, ended: Callable[[], None]
    ) -> None:
        judge = partial(self._judge, pending)
        try:
            await self._connect_accepted_socket(
                self._context.loop,
                lambda: self._protocol(pending, ended, None, None, False, judge, *self._arguments),
                accepted,
            )
        except OSError:
            accepted.close()
            ended()

    def _judge(self, pending: PendingSocket, request: Any) -> Any:
        """Answer a handshake; picows would send the text of an exception, so none may pass."""
        self._pending.leave(pending)
        try:
            verdict = self._verdict(pending, request)
            self._recorder.judged(verdict, pending.source, request.headers.get("Authorization", ""))
        except Exception as error:  # noqa: BLE001  see above
            self._context.log.error("defect", at="handshake", traceback=repr(error))
            verdict = self._handshake.defect
        if isinstance(verdict, Rejected):
            self._context.metrics.handshakes[verdict.result] += 1
            kinds = self._picows.WSUpgradeResponse
            if verdict.result == HEALTH:
                response = kinds.create_ok_response(verdict.body, dict(verdict.headers))
            else:
                self._context.log.info("refused", result=verdict.result, reason=verdict.reason)
                response = kinds.create_error_response(verdict.status, verdict.body, dict(verdict.headers))
            return self._picows.WSUpgradeResponseWithListener(response, None)
        self._context.metrics.handshakes["ok"] += 1
        chosen = {"Sec-WebSocket-Protocol": verdict.subprotocol} if verdict.subprotocol else None
        response = self._picows.WSUpgradeResponse.create_101_response(chosen)
        return self._picows.WSUpgradeResponseWithListener(
            response, self._listener(self._dispatcher, verdict, pending.number)
        )

    def _verdict(self, pending: PendingSocket, request: Any) -> Accepted | Rejected:
        headers, now = request.headers, self._context.clocks.monotonic()
        source = pending.source = self._sources.source(
            pending.peer, ",".join(headers.getall("X-Forwarded-For", []))
        )
        if self._sources.wait_s(source, now) > 0:
            return self._handshake.too_fast
        connection = [word.strip().lower() for word in ",".join(headers.getall("Connection", [])).split(",")]
        if "upgrade" in connection:
            headers["Connection"] = "upgrade"
        offered = ",".join(headers.getall("Sec-WebSocket-Protocol", [])).split(",")
        verdict = self._handshake.judge(
            path=bytes(request.path),
            authorization=headers.get("Authorization", ""),
            offered=[word.strip() for word in offered],
            is_full=len(self._dispatcher.connections) >= self._max_robots,
            anonymous=self._new_name(),
            now_s=self._context.clocks.wall(),
        )
        if not isinstance(verdict, Accepted):
            return verdict
        banned_s = self._dispatcher.rates.banned_s(verdict.robot, now)
        return self._handshake.too_fast if banned_s > 0 else verdict


def _peer(accepted: socket.socket) -> str:
    try:
        return str(accepted.getpeername()[0])
    except OSError:
        return ""  # gone already


def _libraries() -> tuple[Any, Any]:
    try:
        import aiofastnet
        from picows import picows
    except ImportError as error:
        raise MissingExtra("picows", "backend") from error
    return picows, aiofastnet.connect_accepted_socket


def protocol_type(picows: Any) -> Any:
    """Return the subclass of picows' protocol that one robot's socket uses."""
    base = picows.WSProtocol
    get_buffer, buffer_updated, connection_lost = base.get_buffer, base.buffer_updated, base.connection_lost
    connection_made = base.connection_made

    class Protocol(base):  # type: ignore[misc, valid-type]
        """Passes nothing behind the first CLOSE to picows, and tells when the socket is gone."""

        def __init__(self, pending: PendingSocket, ended: Callable[[], None], *arguments: Any) -> None:
            super().__init__(*arguments)
            self._pending = pending
            self._ended = ended
            self._border = CloseBorder()
            self._buffer = memoryview(b"")

        def connection_made(self, transport: Any) -> None:
            connection_made(self, transport)
            self._pending.connected(transport)

        def get_buffer(self, hint: int) -> memoryview:
            buffer: memoryview = get_buffer(self, hint)
            self._buffer = buffer if len(buffer) <= _MAX_READ_BYTES else buffer[:_MAX_READ_BYTES]
            return self._buffer

        def buffer_updated(self, n: int) -> None:
            if not self._border.is_upgraded and self._pending.is_too_long(n):
                return
            if self.transport is not None and self.transport.is_close_frame_sent:
                return
            wanted = self._border.wanted(self._buffer, n)
            if wanted:
                buffer_updated(self, wanted)

        def connection_lost(self, error: Exception | None) -> None:
            try:
                connection_lost(self, error)
            finally:
                self._ended()

    return Protocol


def listener_type(picows: Any, loop: asyncio.AbstractEventLoop, serving: ServingSettings) -> Any:
    """Return the subclass of picows' listener that passes frames between a socket and the dispatcher."""
    text, binary = int(picows.WSMsgType.TEXT), int(picows.WSMsgType.BINARY)

    class Listener(picows.WSListener):  # type: ignore[misc]
        """One robot's socket: passes frames to its connection, and is the connection's `Wire`."""

        def __init__(self, dispatcher: Dispatcher, accepted: Accepted, number: int) -> None:
            self._dispatcher = dispatcher
            self._accepted = accepted
            self._number = number
            self._transport: Any = None
            self._connection: RobotConnection | None = None
            self._cut: asyncio.TimerHandle | None = None
            self._holds = 0

        def on_ws_connected(self, transport: Any) -> None:
            self._transport = transport
            high = serving.write_buffer_bytes
            transport.underlying_transport.set_write_buffer_limits(high=high, low=high // 4)
            self._connection = self._dispatcher.connect(self, self._accepted, self._number)

        def on_ws_frame(self, transport: Any, frame: Any) -> None:
            if self._connection is not None:
                rsv = bool(frame.rsv1 or frame.rsv2 or frame.rsv3)
                payload = frame.get_payload_as_bytes()
                self._connection.frame(frame.msg_type, bool(frame.fin), rsv, payload)

        def on_ws_disconnected(self, transport: Any) -> None:
            if self._cut is not None:
                self._cut.cancel()
            if self._connection is not None:
                self._connection.ended()
                self._connection = None

        def pause_writing(self) -> None:
            if self._cut is None:
                self._cut = loop.call_later(serving.slow_reader_timeout_s, self._cut_off)
                # The commands of a robot that does not read its answers are not read either.
                self.hold()

        def resume_writing(self) -> None:
            if self._cut is not None:
                self._cut.cancel()
                self._cut = None
                self.read_on()

        def send(self, data: bytes, is_text: bool) -> None:
            if self._connection is not None:
                self._transport.send(text if is_text else binary, data)

        def send_pong(self, data: bytes) -> None:
            self._transport.send_pong(data)

        def pause(self, seconds: float) -> None:
            self.hold()
            loop.call_later(seconds, self.read_on)

        def hold(self) -> None:
            self._holds += 1
            self._transport.underlying_transport.pause_reading()

        def read_on(self) -> None:
            self._holds -= 1
            if self._connection is not None and not self._holds:
                self._transport.underlying_transport.resume_reading()

        def close(self, code: int, reason: str) -> None:
            self._transport.send_close(code, reason.encode()[:_MAX_CLOSE_REASON_BYTES])
            # Closing with unread bytes would reset the connection, and the robot would not see the code.
            with contextlib.suppress(OSError):  # the robot reset it, and the loop has not heard of that yet
                self._transport.underlying_transport.write_eof()
            loop.call_later(_LINGER_S, self._transport.disconnect, False)

        def _cut_off(self) -> None:
            self._dispatcher.context.metrics.closed["slow-reader"] += 1
            self._transport.disconnect(False)

    return Listener
