"""Messages between processes of the platform, on stream sockets.

A message is a length and a body in MessagePack.  Child processes and their parents use this format, and also
servers that forward commands of live maps to each other.  Modules that need numpy are imported at the first
message, because a data server uses this package but starts without numpy.
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

_HEADER = struct.Struct("<I")  # the length of a message in bytes, before its body
_PIECE_BYTES = 1 << 18  # most bytes that one call receives from a socket with a time limit


class _Coding(NamedTuple):
    """The functions that encode and decode a body, and that check its size before it is decoded."""

    encode: Callable[[Any], bytes]
    decode: Callable[[bytes], Any]
    check: Callable[[bytes], object]


@cache
def _coding() -> _Coding:
    """Return the functions for bodies; import the modules for that at the first call only.

    The import statements would otherwise take 7 us of each call of a sandbox.
    """
    from rse_pf.limits import budget
    from rse_pf.wire.arrays import binary_encode_hook, extension_hook

    return _Coding(
        msgspec.msgpack.Encoder(enc_hook=binary_encode_hook).encode,
        msgspec.msgpack.Decoder(ext_hook=extension_hook).decode,
        lambda body: budget.check_msgpack(body, budget.SERVICE_REPLY),
    )


def encode_message(message: Any) -> bytes:
    """Return *message* encoded, with its length before it."""
    body = _coding().encode(message)
    return _HEADER.pack(len(body)) + body


def encode_reply(message: Any) -> bytes:
    """Return *message*, a reply of a sandbox, encoded with its length before it.

    Raises:
        LimitExceeded: It has more values or levels of nesting than the worker would accept.
    """
    data = encode_message(message)
    _coding().check(data[_HEADER.size :])
    return data


def receive(connection: socket.socket, until: float | None = None) -> Any:
    """Return the next message on a blocking socket; None if the other side has closed it.

    Args:
        connection: The socket.  Its other side is trusted, so there is no limit for the size of a message.
        until: Monotonic time in seconds after which TimeoutError is raised; None waits for ever.
    """
    header = receive_bytes(connection, _HEADER.size, until)
    if len(header) < _HEADER.size:
        return None
    (length,) = _HEADER.unpack(header)
    body = receive_bytes(connection, length, until)
    return _decode(body) if len(body) == length else None


def receive_bytes(connection: socket.socket, size: int, until: float | None = None) -> bytes:
    """Return the next *size* bytes on a blocking socket; fewer if the other side has closed it.

    Raises:
        TimeoutError: The monotonic time *until* (s) has passed; None waits for ever.
    """
    received = bytearray()
    with suppress(ConnectionResetError):  # the other side exited, and left bytes unread
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
    """Splits a stream from a process that is not trusted into messages of at most *max_bytes*."""

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes = max_bytes
        self._received = bytearray()

    def feed(self, data: bytes) -> Iterator[Any]:
        """Add *data*, and yield each message that is complete now.

        Raises:
            LimitExceeded: A message is longer than *max_bytes*, or holds too many values or levels.
            BadMessage: The body of a message is not MessagePack.
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
