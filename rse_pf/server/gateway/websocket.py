"""The sockets of robots in one worker: handshakes, then WebSocket connections by picows on uvloop.

1. `RobotSockets` reads the head of the request from each socket that the supervisor passed to this worker,
   and answers the handshake, in small time slices (`DeferredWork`).
2. A socket whose handshake is accepted gets a `RobotProtocol`, which passes bytes to picows, and a
   `Listener`, which passes frames to a `RobotConnection` and writes for it.

Only this file uses picows.  The text of an exception is never sent to a robot, a robot that reads too slowly
is disconnected, and nothing behind the first CLOSE frame is read.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Callable
from dataclasses import replace
from typing import Any

# The transport is made directly: aiofastnet's connect_accepted_socket costs a task and two futures a socket.
from aiofastnet.selector_transport import SelectorSocketTransport
from picows import picows as _picows

from rse_pf.auth.claimed import claimed_by
from rse_pf.config.front_door import MAX_HANDSHAKE_BYTES, WRITE_BUFFER_BYTES
from rse_pf.http.unauthenticated import PendingHandshakes
from rse_pf.server.gateway.audit_recorder import AuditRecorder
from rse_pf.server.gateway.connection import RobotConnection
from rse_pf.server.gateway.dispatcher import Dispatcher
from rse_pf.server.gateway.frames import CloseBorder
from rse_pf.server.gateway.handshake import (
    HEALTH,
    Accepted,
    HandshakePolicy,
    Rejected,
    RequestHead,
    banned_rejection,
)
from rse_pf.server.gateway.rate_limits import SourceRates
from rse_pf.server.scheduling.deferred_work import DeferredWork
from rse_pf.server.scheduling.socket_poller import SocketPoller

picows: Any = _picows  # the type stubs of picows lack some names that are used here

__all__ = ["PendingSocket", "RobotSockets"]

_MAX_CLOSE_REASON_BYTES = 123  # RFC 6455, 5.5: a control frame has at most 125 bytes, two for the close code
_UPGRADE = (
    b"GET / HTTP/1.1\r\nUpgrade: websocket\r\nConnection: upgrade\r\n"
    b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: %b\r\n\r\n"
)
"""The short request, with the robot's key, that picows gets instead of the robot's request: picows keeps its
request in memory as long as the connection."""
_SWITCHING = 101  # HTTP status of an accepted upgrade
_NO_HEADERS: dict[str, str] = {}
_MAX_READ_BYTES = 16384  # bytes read from one socket before the next one: up to 2,700 of the smallest frames
_HANDSHAKES_S = 0.0005  # seconds for handshakes in one round of the event loop: commands hardly wait for them
# Steps of handshakes that wait; while there are so many, new sockets stay in the supervisor's channel.
_MAX_WAITING = 8
# Seconds in which a robot can read the CLOSE frame and close its side, before the socket is closed.
_LINGER_S = 2.0
_READ_BUFFER_BYTES = 2048  # first size of a socket's read buffer: small for idle robots; it grows as needed
_TEXT = int(picows.WSMsgType.TEXT)
_BINARY = int(picows.WSMsgType.BINARY)


class _NoLogger:
    """A logger that ignores everything, shared by all sockets: picows would make one for each socket."""

    def isEnabledFor(self, level: int) -> bool:
        return False

    def log(self, *args: Any) -> None: ...

    debug = info = warning = error = exception = log


_NO_LOGGER = _NoLogger()


class _RobotSocket(socket.socket):
    """An accepted socket without system calls for its options and addresses.

    Libraries request these values for their log lines only, so that constants are returned.
    """

    family = socket.AF_INET  # also for IPv6: the options that are set are the same
    type = socket.SOCK_STREAM

    def getsockopt(self, *_: int) -> int:  # type: ignore[override]
        return 0

    def getsockname(self) -> None:
        return None

    getpeername = getsockname


class PendingSocket:
    """A socket that the supervisor accepted, until its handshake is answered.

    Attributes:
        accepted: The socket.
        peer: Address of the other end of the TCP connection.
        number: Number of the socket on this server, in the order of acceptance.
        on_end: Called once, when the socket is closed.
        seen: The bytes of the request that have arrived.
        timeout: The timer that closes the socket; None before the first read, and after the whole request was
            read.
    """

    __slots__ = ("accepted", "number", "on_end", "peer", "seen", "timeout")

    def __init__(
        self, accepted: socket.socket, peer: str, on_end: Callable[[], None], number: int = 0
    ) -> None:
        self.accepted = accepted
        self.peer = peer
        self.on_end = on_end
        self.number = number
        self.seen = b""
        self.timeout: asyncio.TimerHandle | None = None

    def close(self, answer: bytes = b"") -> None:
        """Send *answer* unless it is empty, and close the socket."""
        if answer:
            # The kernel takes a whole answer at once, since its buffer is far larger.
            with contextlib.suppress(OSError):
                self.accepted.send(answer)
        self.accepted.close()
        self.on_end()


class _Upgrade:
    """The HTTP answer that picows sends to an accepted handshake; cheaper than the class of picows."""

    __slots__ = ("_subprotocol", "headers")
    status = _SWITCHING

    def __init__(self, subprotocol: str) -> None:
        self._subprotocol = subprotocol
        self.headers: dict[str, str] = {}

    def to_bytes(self) -> bytearray:
        """Return the bytes of the answer, with the header ``Sec-WebSocket-Accept`` that picows has added."""
        chosen = f"Sec-WebSocket-Protocol: {self._subprotocol}\r\n" if self._subprotocol else ""
        accept = self.headers["Sec-WebSocket-Accept"]
        self.headers = _NO_HEADERS  # picows keeps this object as long as the connection
        return bytearray(
            "HTTP/1.1 101 Switching Protocols\r\nConnection: upgrade\r\nUpgrade: websocket\r\n"
            f"{chosen}Sec-WebSocket-Accept: {accept}\r\n\r\n".encode()
        )


class RobotSockets:
    """Answers the handshakes of one worker, and connects the accepted robots to its dispatcher."""

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
        """Have no socket yet.

        Args:
            dispatcher: Gets the connections of accepted robots.
            handshake: Decides about handshakes.
            max_robots: Connections of this worker above which handshakes are rejected.
            workers: Number of workers of the server, each of which has its part of the server's limits.
            new_name: Returns a name for a robot without a token.
            recorder: Records handshakes for the audit log.
        """
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
        clock = self._context.clocks.monotonic
        self._poller = SocketPoller(self._context.loop, clock=clock)
        dispatcher.stateless.leaves_unread = self._poller.leaves_unread
        self._steps = DeferredWork(self._context.loop, clock=clock, bound_s=_HANDSHAKES_S)

    @property
    def is_behind(self) -> bool:
        """Whether no further socket should be taken now, because `_MAX_WAITING` steps of handshakes wait."""
        return len(self._steps) >= _MAX_WAITING

    def take(self, fd: int, on_end: Callable[[], None], number: int, peer: str) -> None:
        """Read the handshake of an accepted socket, and serve its robot if the handshake is accepted.

        Args:
            fd: The descriptor of the socket, which this object closes.
            on_end: Called once, when the socket is closed.
            number: Number of the socket on this server, in the order of acceptance.
            peer: Address of the other end of the TCP connection.
        """
        family = socket.AF_INET6 if ":" in peer else socket.AF_INET
        accepted = _RobotSocket(family, socket.SOCK_STREAM, 0, fd)
        accepted.setblocking(False)
        self._steps.add(self._read_first, PendingSocket(accepted, peer, on_end, number))

    def _read_first(self, pending: PendingSocket) -> None:
        """Read a new socket; if its request is not whole yet, wait for the rest until the Hello timeout.

        Of too many sockets that wait, the one that has waited longest is closed.
        """
        if self._read(pending):
            return
        loop, session = self._context.loop, self._context.settings.session
        pending.timeout = loop.call_later(session.hello_timeout_s, self._steps.add, self._cut_late, pending)
        loop.add_reader(pending.accepted.fileno(), self._on_readable, pending)
        surplus = self._pending.enter(pending, pending.peer)
        if surplus is not None:
            self._context.metrics.closed["unauthenticated"] += 1
            self._cut(surplus)

    def _cut_late(self, pending: PendingSocket) -> None:
        """Close a socket whose Hello timeout is over, unless its whole request was read meanwhile."""
        if pending.timeout is not None:
            self._cut(pending)

    def _cut(self, pending: PendingSocket) -> None:
        """Stop waiting for the request of a socket, and close the socket without an answer."""
        self._forget(pending)
        pending.close()

    def _forget(self, pending: PendingSocket) -> None:
        """Remove the timer and the reader of a socket that waits for the rest of its request."""
        if pending.timeout is not None:
            pending.timeout.cancel()
            pending.timeout = None
            self._context.loop.remove_reader(pending.accepted.fileno())
            self._pending.leave(pending)

    def _on_readable(self, pending: PendingSocket) -> None:
        """Read a socket whose bytes have come, in a deferred step."""
        # The next read is a deferred step, because a thousand sockets may be readable in the same round.
        self._context.loop.remove_reader(pending.accepted.fileno())
        self._steps.add(self._read_on, pending)

    def _read_on(self, pending: PendingSocket) -> None:
        """Read a socket that waits for the rest of its request; wait again if the rest is not whole."""
        # A socket that was closed while it waited for this step is not read.
        if pending.timeout is not None and not self._read(pending):
            self._context.loop.add_reader(pending.accepted.fileno(), self._on_readable, pending)

    def _read(self, pending: PendingSocket) -> bool:
        """Read the bytes of the request that have arrived, and answer the handshake if the request is whole.

        Return True if the socket was answered or closed, False if more of the request must arrive.
        """
        max_bytes = MAX_HANDSHAKE_BYTES
        try:
            # More than the head is read, because closing with unread bytes would reset the connection, and
            # the answer would be lost.
            data = pending.accepted.recv(_MAX_READ_BYTES)
        except BlockingIOError:
            return False
        except OSError:
            data = b""
        pending.seen += data
        end = pending.seen.find(b"\r\n\r\n")
        if data and end < 0 and len(pending.seen) <= max_bytes:
            return False
        self._forget(pending)
        if not data:
            pending.close()
        elif end < 0:
            self._refuse(pending, self._handshake.too_long, pending.peer, "")
        else:
            self._answer_handshake(pending, RequestHead.parse(pending.seen[:end]), pending.seen[end + 4 :])
        return True

    def _answer_handshake(self, pending: PendingSocket, head: RequestHead | None, rest: bytes) -> None:
        """Answer the handshake with the request *head*; None rejects it, as no valid request.

        *rest* are bytes that were read behind the head.  An exception is logged and answered with status 500.
        """
        if head is None:
            self._refuse(pending, self._handshake.no_request, pending.peer, "")
            return
        source, token = pending.peer, ""
        try:
            source = self._sources.source(pending.peer, head.text(b"x-forwarded-for"))
            token = head.token()
            verdict = self._verdict(head, source)
            self._recorder.record_verdict(verdict, source, token, self._handshake.keys)
        except Exception as error:  # noqa: BLE001  a defect must not stop the worker for other robots
            self._context.log.error("defect", at="handshake", traceback=repr(error))
            verdict = self._handshake.defect
        if isinstance(verdict, Accepted):
            self._context.metrics.handshakes["ok"] += 1
            self._serve(pending, verdict, _UPGRADE % head.websocket_key, rest)
        else:
            self._refuse(pending, verdict, source, token)

    def _refuse(self, pending: PendingSocket, verdict: Rejected, source: str, token: str) -> None:
        """Count and log the rejection *verdict*, send its HTTP answer and close the socket."""
        self._context.metrics.handshakes[verdict.result] += 1
        if verdict.result != HEALTH:
            about = {"source": source, **claimed_by(token, self._handshake.keys)}
            self._context.log.info("refused", result=verdict.result, reason=verdict.reason, **about)
        pending.close(verdict.answer)

    def _serve(self, pending: PendingSocket, verdict: Accepted, upgrade: bytes, rest: bytes) -> None:
        """Give the socket of an accepted handshake to picows, with the request *upgrade* and then *rest*."""
        listener = Listener(self._dispatcher, verdict, pending.number)
        accepted = pending.accepted
        try:
            # By default the kernel buffers megabytes, and this process would notice a slow robot too late.
            accepted.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, WRITE_BUFFER_BYTES)
            protocol = RobotProtocol(
                listener, verdict.subprotocol, upgrade, rest,
                max_frame_bytes=self._context.settings.session.max_message_bytes, poller=self._poller,
                on_end=pending.on_end,
            )  # fmt: skip
            SelectorSocketTransport(self._poller, accepted, protocol)
        except OSError:
            pending.close()

    def _verdict(self, head: RequestHead, source: str) -> Accepted | Rejected:
        """Return the result of the handshake: by the address's rate, `HandshakePolicy`, and robots' bans."""
        now = self._context.clocks.monotonic()
        if self._sources.wait_s(source, now) > 0:
            return replace(self._handshake.too_fast, reason="address-rate")
        verdict = self._handshake.decide(
            head,
            is_full=len(self._dispatcher.connections) >= self._max_robots,
            anonymous=self._new_name(),
            now_s=self._context.clocks.wall(),
        )
        if isinstance(verdict, Accepted):
            banned_s = self._dispatcher.rates.banned_s(verdict.robot, now)
            if banned_s > 0:
                return banned_rejection(banned_s)
            if not head.websocket_key:
                return self._handshake.no_request
        return verdict


class RobotProtocol(picows.WSProtocol):  # type: ignore[misc]
    """Passes the bytes of one robot's socket to picows, up to the end of the first CLOSE frame.

    picows sends no pings and answers none: `RobotConnection` answers them.
    """

    def __init__(
        self,
        listener: Any,
        subprotocol: str,
        upgrade: bytes,
        rest: bytes,
        *,
        max_frame_bytes: int,
        poller: SocketPoller,
        on_end: Callable[[], None],
    ) -> None:
        """Wait for the transport.

        Args:
            listener: The `Listener`, which gets the frames.
            subprotocol: The sub-protocol that was agreed in the handshake; "" for none.
            upgrade: The request that picows gets instead of the robot's request.
            rest: Bytes that were read behind the robot's request.
            max_frame_bytes: A frame with a longer payload closes the connection.
            poller: Reads the sockets of robots; after `_MAX_READ_BYTES` of one socket it reads others first.
            on_end: Called when the socket is closed.
        """
        answer = picows.WSUpgradeResponseWithListener(_Upgrade(subprotocol), listener)
        auto_ping = (False, 20.0, 20.0, picows.WSAutoPingStrategy.PING_WHEN_IDLE)
        disconnect_on_exception, auto_pong, handshake_timeout, extra_headers = True, False, None, None
        super().__init__(
            None, None, False, lambda _: answer, _NO_LOGGER, disconnect_on_exception, handshake_timeout,
            *auto_ping, auto_pong, max_frame_bytes, extra_headers, _READ_BUFFER_BYTES,
        )  # fmt: skip
        self._request = (upgrade, rest)
        self._listener = listener
        self._poller = poller
        self._is_made = False
        self._read_bytes = 0
        self._on_end = on_end
        self._border = CloseBorder(upgraded=True)
        self._buffer = memoryview(b"")

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        request, rest = self._request
        self._request = (b"", b"")
        super().get_buffer(-1)[: len(request)] = request
        super().buffer_updated(len(request))
        self.transport.request.headers = None  # picows keeps them as long as the connection
        while rest:
            size = min(len(self.get_buffer(-1)), len(rest))
            self._buffer[:size] = rest[:size]
            self.buffer_updated(size)
            rest = rest[size:]
        self._is_made = True

    def get_buffer(self, hint: int) -> memoryview:
        buffer: memoryview = super().get_buffer(hint)
        self._buffer = buffer if len(buffer) <= _MAX_READ_BYTES else buffer[:_MAX_READ_BYTES]
        return self._buffer

    def buffer_updated(self, n: int) -> None:
        """Pass the *n* new bytes, up to the end of a CLOSE frame, to picows.

        After `_MAX_READ_BYTES` of one message, let the poller read other sockets first.
        """
        if self.transport is not None and self.transport.is_close_frame_sent:
            return
        read_bytes = self._read_bytes + n if n == len(self._buffer) else 0
        size = self._border.bytes_to_close(self._buffer, n)
        if size:
            super().buffer_updated(size)
        if read_bytes >= _MAX_READ_BYTES and self._is_made:
            # Without this, the transport would read up to 256 KiB before the next socket is read.
            read_bytes = 0
            self._listener.hold()
            self._poller.read_after_others(self._listener.read_on)
        self._read_bytes = read_bytes

    def connection_lost(self, error: Exception | None) -> None:
        try:
            super().connection_lost(error)
        finally:
            self._on_end()


class Listener(picows.WSListener):  # type: ignore[misc]
    """Passes the frames of one robot's socket to its `RobotConnection`, and writes for it as its `Wire`."""

    def __init__(self, dispatcher: Dispatcher, accepted: Accepted, number: int) -> None:
        self._dispatcher = dispatcher
        self._loop = dispatcher.context.loop
        self._accepted = accepted
        self._number = number
        self._transport: Any = None
        self._connection: RobotConnection | None = None
        self._cut: asyncio.TimerHandle | None = None
        self._pause: asyncio.TimerHandle | None = None
        self._paused_until_s = 0.0
        self._linger: asyncio.TimerHandle | None = None
        self._holds = 0

    def on_ws_connected(self, transport: Any) -> None:
        self._transport = transport
        transport.underlying_transport.set_write_buffer_limits(
            high=WRITE_BUFFER_BYTES, low=WRITE_BUFFER_BYTES // 4
        )
        if self._accepted.claims is not None:
            self._dispatcher.context.crash.enter(self._number, self._accepted.robot)
        self._connection = self._dispatcher.connect(self, self._accepted, self._number)

    def on_ws_frame(self, transport: Any, frame: Any) -> None:
        if self._connection is not None:
            rsv = bool(frame.rsv1 or frame.rsv2 or frame.rsv3)
            payload = frame.get_payload_as_bytes()
            self._connection.receive_frame(frame.msg_type, bool(frame.fin), rsv, payload)

    def on_ws_disconnected(self, transport: Any) -> None:
        for timer in (self._cut, self._pause, self._linger):
            if timer is not None:
                timer.cancel()
        if self._connection is not None:
            self._dispatcher.disconnect(self._connection)
            self._connection = None

    def pause_writing(self) -> None:
        """Read nothing more, and disconnect the robot if it does not read its answers in time.

        The transport calls this when its write buffer is full, and `resume_writing` when it is not any more.
        """
        if self._cut is None:
            self._cut = self._loop.call_later(
                self._dispatcher.context.settings.serving.slow_reader_timeout_s, self._cut_off
            )
            # No further commands are read from a robot that does not read its answers.
            self.hold()

    def resume_writing(self) -> None:
        if self._cut is not None:
            self._cut.cancel()
            self._cut = None
            self.read_on()

    def send(self, data: bytes, is_text: bool) -> None:
        if self._connection is not None:
            self._transport.send(_TEXT if is_text else _BINARY, data)

    def unsent_bytes(self) -> int:
        if self._connection is None:
            return 0
        size: int = self._transport.underlying_transport.get_write_buffer_size()
        return size

    def bound_unsent(self, max_bytes: int) -> None:
        accepted = self._transport.underlying_transport.get_extra_info("socket")
        if accepted is not None:
            accepted.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, max_bytes)

    def send_pong(self, data: bytes) -> None:
        self._transport.send_pong(data)

    def pause(self, seconds: float) -> None:
        until_s = self._loop.time() + seconds
        if self._pause is None:
            self.hold()
        elif self._paused_until_s >= until_s:
            return
        else:
            self._pause.cancel()
        self._paused_until_s = until_s
        self._pause = self._loop.call_later(seconds, self._end_pause)

    def _end_pause(self) -> None:
        self._pause = None
        self.read_on()

    def hold(self) -> None:
        self._holds += 1
        self._transport.underlying_transport.pause_reading()

    def read_on(self) -> None:
        self._holds -= 1
        if self._connection is not None and not self._holds:
            self._transport.underlying_transport.resume_reading()

    def close(self, code: int, reason: str) -> None:
        self._transport.send_close(code, reason.encode()[:_MAX_CLOSE_REASON_BYTES])
        # Only this side is closed now: closing the socket with unread bytes would reset the connection, and
        # the robot would not get the close code.
        with contextlib.suppress(OSError):  # the robot has reset the connection, unnoticed by the event loop
            self._transport.underlying_transport.write_eof()
        if self._linger is None:
            self._linger = self._loop.call_later(_LINGER_S, self._transport.disconnect, False)

    def _cut_off(self) -> None:
        """Disconnect a robot that has not read its answers within ``serving.slow_reader_timeout_s``."""
        self._dispatcher.context.metrics.closed["slow-reader"] += 1
        self._transport.disconnect(False)
