"""A WebSocket of a client on the standard library: one handshake, whole binary messages, a time limit.

For the canary, whose package stays small.  It sends unfragmented messages, answers pings, and treats anything
else than RFC 6455 allows as the end of the connection.
"""

from __future__ import annotations

import base64
import contextlib
import hashlib
import os
import socket
import ssl
import struct
from types import TracebackType
from urllib.parse import urlsplit

from rse_pf.errors import ConnectError

__all__ = ["WebSocket"]

_GUID = "258EAFA5-E914-47DA-95CA-C5AB0DC85B11"
_CONTINUATION, _CLOSE, _PING, _PONG = 0x0, 0x8, 0x9, 0xA
_BINARY = 0x2
_MAX_HEAD_BYTES, _MAX_MESSAGE_BYTES = 16_384, 1 << 20
_SWITCHING = 101
_HINT = "look at the load balancer's target groups and the servers' journals"


class WebSocket:
    """One connection; a context manager."""

    def __init__(self, stream: socket.socket) -> None:
        """Take over a connected *stream* after the handshake; see `dial`."""
        self._stream = stream
        self._buffer = b""

    @classmethod
    def dial(cls, url: str, *, subprotocol: str, token: str, timeout_s: float) -> WebSocket:
        """Connect to *url*, such as ``wss://robots.example.org/ws``; every later wait has the time limit.

        Raises:
            ConnectError: No server answers, or it refuses the handshake.
        """
        parts = urlsplit(url)
        tls = parts.scheme == "wss"
        host, port = parts.hostname or "", parts.port or (443 if tls else 80)
        where = f"{host}:{port}"
        with contextlib.ExitStack() as opened:
            try:
                stream = opened.enter_context(socket.create_connection((host, port), timeout=timeout_s))
                if tls:
                    context = ssl.create_default_context()
                    stream = opened.enter_context(context.wrap_socket(stream, server_hostname=host))
                connection = cls(stream)
                connection._shake_hands(where, parts.path or "/", subprotocol, token)
            except OSError as error:
                raise ConnectError(f"no server answers at {where}: {error}", hint=_HINT) from error
            opened.pop_all()
        return connection

    def __enter__(self) -> WebSocket:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stream.close()

    def send(self, message: bytes, *, opcode: int = _BINARY) -> None:
        """Send one message; raises ConnectError."""
        size, mask = len(message), os.urandom(4)
        head = struct.pack("!B", 0x80 | opcode)
        if size < 126:
            head += struct.pack("!B", 0x80 | size)
        elif size < 1 << 16:
            head += struct.pack("!BH", 0x80 | 126, size)
        else:
            head += struct.pack("!BQ", 0x80 | 127, size)
        masks = (mask * (size // 4 + 1))[:size]
        masked = (int.from_bytes(message, "big") ^ int.from_bytes(masks, "big")).to_bytes(size, "big")
        try:
            self._stream.sendall(head + mask + masked)
        except OSError as error:
            raise ConnectError(f"the server left: {error}", hint=_HINT) from error

    def receive(self) -> bytes:
        """Return the next whole message; raises ConnectError if the server leaves or takes too long."""
        message = b""
        while True:
            opcode, is_last, payload = self._receive_frame()
            if opcode == _CLOSE:
                reason = payload[2:].decode("utf-8", "replace")
                raise ConnectError(f"the server closed the connection: {reason[:200]}", hint=_HINT)
            if opcode == _PING:
                self.send(payload, opcode=_PONG)
            elif opcode != _PONG:
                message += payload
                if len(message) > _MAX_MESSAGE_BYTES:
                    raise ConnectError(f"a message of over {_MAX_MESSAGE_BYTES} bytes", hint=_HINT)
                if is_last:
                    return message

    def _shake_hands(self, host: str, path: str, subprotocol: str, token: str) -> None:
        key = base64.b64encode(os.urandom(16)).decode()
        lines = (
            f"GET {path} HTTP/1.1", f"Host: {host}", "Upgrade: websocket", "Connection: Upgrade",
            f"Sec-WebSocket-Key: {key}", "Sec-WebSocket-Version: 13",
            f"Sec-WebSocket-Protocol: {subprotocol}", f"Authorization: Bearer {token}", "", "",
        )  # fmt: skip
        self._stream.sendall("\r\n".join(lines).encode())
        while b"\r\n\r\n" not in self._buffer:
            if len(self._buffer) > _MAX_HEAD_BYTES:
                raise ConnectError("the answer to the handshake has no end", hint=_HINT)
            self._receive_more()
        head, _, self._buffer = self._buffer.partition(b"\r\n\r\n")
        first, *rest = head.decode("latin-1").split("\r\n")
        status = first.split(" ", 2)[1:2]
        if status != [str(_SWITCHING)]:
            body = self._buffer[:200].decode("utf-8", "replace")
            raise ConnectError(f"the handshake was answered by {first[:100]}: {body}", hint=_HINT)
        fields = {
            name.strip().lower(): value.strip() for name, _, value in (line.partition(":") for line in rest)
        }
        expected = base64.b64encode(
            hashlib.sha1((key + _GUID).encode(), usedforsecurity=False).digest()
        ).decode()
        if fields.get("sec-websocket-accept") != expected:
            raise ConnectError("the answer to the handshake is none of a WebSocket", hint=_HINT)

    def _receive_frame(self) -> tuple[int, bool, bytes]:
        first, second = self._take_bytes(2)
        size = second & 0x7F
        if size == 126:
            (size,) = struct.unpack("!H", self._take_bytes(2))
        elif size == 127:
            (size,) = struct.unpack("!Q", self._take_bytes(8))
        if size > _MAX_MESSAGE_BYTES or second & 0x80:
            raise ConnectError("a frame that no server may send", hint=_HINT)
        return first & 0x0F, bool(first & 0x80), self._take_bytes(size)

    def _take_bytes(self, count: int) -> bytes:
        while len(self._buffer) < count:
            self._receive_more()
        data, self._buffer = self._buffer[:count], self._buffer[count:]
        return data

    def _receive_more(self) -> None:
        try:
            data = self._stream.recv(65_536)
        except OSError as error:
            raise ConnectError(f"the server does not answer: {error}", hint=_HINT) from error
        if not data:
            raise ConnectError("the server left", hint=_HINT)
        self._buffer += data
