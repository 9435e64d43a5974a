"""Messages between processes of the platform, on stream sockets.

A message is its length and its MessagePack body.  Child processes and their parents use this format, and
servers that pass commands of live maps on.  What needs numpy is imported with the first message: a data
server starts processes, and starts without it.
"""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache
from typing import Any, NamedTuple

import msgspec

from rse_pf.errors import BadMessage, LimitExceeded, RsePfError

__all__ = ["FrameReader", "encode_message", "encode_reply", "receive", "receive_bytes"]

_HEADER = struct.Struct("<I")
_PIECE_BYTES = 1 << 18


class _Coding(NamedTuple):
    encode: Callable[[Any], bytes]
    decode: Callable[[bytes], Any]
    check: Callable[[bytes], object]


@cache
def _coding() -> _Coding:
    """Import once what needs numpy: six imports a call were 7 us of a sandbox's call."""
    from rse_pf.limits import budget
    from rse_pf.wire.arrays import binary_encode_hook, extension_hook

    return _Coding(
        msgspec.msgpack.Encoder(enc_hook=binary_encode_hook).encode,
        msgspec.msgpack.Decoder(ext_hook=extension_hook).decode,
        lambda body: budget.check_msgpack(body, budget.SERVICE_REPLY),
    )


def encode_message(message: Any) -> bytes:
    """Return *message* with its length before it."""
    body = _coding().encode(message)
    return _HEADER.pack(len(body)) + body


def encode_reply(message: Any) -> bytes:
    """Return *message* of a sandbox with its length before it.

    Raises:
        LimitExceeded: The worker would refuse it for its values or levels.
    """
    data = encode_message(message)
    _coding().check(data[_HEADER.size :])
    return data


def receive(connection: socket.socket, until: float | None = None) -> Any:
    """Return the next message on a blocking socket, None at its end.

    Args:
        connection: Its other side is trusted: no limit holds.
        until: Monotonic time, s, after which TimeoutError is raised; None waits for ever.
    """
    header = receive_bytes(connection, _HEADER.size, until)
    if len(header) < _HEADER.size:
        return None
    (length,) = _HEADER.unpack(header)
    body = receive_bytes(connection, length, until)
    return _decode(body) if len(body) == length else None


def receive_bytes(connection: socket.socket, size: int, until: float | None = None) -> bytes:
    """Return the next *size* bytes on a blocking socket, fewer at its end.

    Raises:
        TimeoutError: The monotonic time *until*, s, has passed.
    """
    received = bytearray()
    with suppress(ConnectionResetError):  # it ended and left bytes unread
        if until is None:
            return connection.recv(size, socket.MSG_WAITALL)
        while len(received) < size:
            connection.settimeout(max(1e-6, until - time.monotonic()))
            piece = connection.recv(min(size - len(received), _PIECE_BYTES))
            if not piece:
                break
            received += piece
    return bytes(received)


class FrameReader:
    """Splits the bytes of a stream into messages of at most *max_bytes*."""

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes = max_bytes
        self._received = bytearray()

    def feed(self, data: bytes) -> Iterator[Any]:
        """Yield every message that *data* completes.

        Raises:
            LimitExceeded: A message is longer than the limit, or holds too many values or levels.
            BadMessage: A body is not MessagePack.
        """
        self._received += data
        while len(self._received) >= _HEADER.size:
            (length,) = _HEADER.unpack_from(self._received)
            if length > self._max_bytes:
                raise LimitExceeded(f"a message of {length} bytes is longer than {self._max_bytes}")
            end = _HEADER.size + length
            if len(self._received) < end:
                return
            body = bytes(self._received[_HEADER.size : end])
            del self._received[:end]
            _coding().check(body)
            yield _decode(body)


def _decode(body: bytes) -> Any:
    try:
        return _coding().decode(body)
    except RsePfError:
        raise
    except (msgspec.DecodeError, TypeError, ValueError, LookupError, RecursionError) as error:
        raise BadMessage(f"not MessagePack: {error}") from error
