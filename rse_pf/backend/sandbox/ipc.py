"""The bytes between a worker and one environment: whole messages out and in, and what the service prints.

Promises that neither a slow nor a hostile environment blocks the loop or fills the worker's memory: messages
have a largest size, printed lines a number and a length.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Callable
from typing import Any, Protocol

import msgspec

from rse_pf.backend.sandbox.child import HEADER, decoded
from rse_pf.errors import RsePfError

__all__ = ["FdWatcher", "IpcChannel"]

_READ_BYTES = 1 << 18
_MAX_LINES = 200
_MAX_LINE = 256


class FdWatcher(Protocol):
    """What watches descriptors, for both directions."""

    def add_reader(self, fd: int, callback: Callable[..., object], *args: Any) -> None:
        """Call *callback* whenever *fd* can be read."""

    def remove_reader(self, fd: int) -> bool:
        """Stop that."""

    def add_writer(self, fd: int, callback: Callable[..., object], *args: Any) -> None:
        """Call *callback* whenever *fd* can be written."""

    def remove_writer(self, fd: int) -> bool:
        """Stop that."""


class IpcChannel:
    """Ends of a socket and of a pipe; ``theirs`` go to the environment, then `begin`."""

    def __init__(
        self,
        loop: FdWatcher,
        *,
        max_bytes: int,
        on_message: Callable[[list[Any]], None],
        on_fault: Callable[[str], None],
        on_line: Callable[[str], None],
    ) -> None:
        """Open both.

        Args:
            loop: Of the worker.
            max_bytes: Of one message from the environment.
            on_message: Told each message.
            on_fault: Told once, when the other side is gone ("") or said something that is no message.
            on_line: Told what the service printed, line by line, as long as there are not too many.
        """
        self._loop = loop
        self._max_bytes = max_bytes
        self._on_message = on_message
        self._on_fault = on_fault
        self._on_line = on_line
        self._socket, self.theirs = socket.socketpair()
        self._output, self.their_output = os.pipe()
        self._received = bytearray()
        self._unsent = bytearray()
        self._lines = 0
        self._closed = False
        self._socket.setblocking(False)
        os.set_blocking(self._output, False)

    def begin(self) -> None:
        """Forget the environment's ends, which it has by now, and listen."""
        self.theirs.close()
        os.close(self.their_output)
        self._loop.add_reader(self._socket.fileno(), self._readable)
        self._loop.add_reader(self._output, self._printed)

    def send(self, data: bytes) -> None:
        """Write *data* as soon as it fits."""
        self._unsent += data
        self._flush()

    def close(self) -> None:
        """Take what was printed last, and close both."""
        if self._closed:
            return
        self._printed()
        self._closed = True
        self._loop.remove_reader(self._output)
        self._loop.remove_reader(self._socket.fileno())
        self._loop.remove_writer(self._socket.fileno())
        self._socket.close()
        os.close(self._output)

    def _flush(self) -> None:
        if self._closed:
            return
        try:
            del self._unsent[: self._socket.send(self._unsent)]
        except BlockingIOError:
            pass
        except OSError:
            self._unsent.clear()  # it is gone, and reading says so
        if self._unsent:
            self._loop.add_writer(self._socket.fileno(), self._flush)
        else:
            self._loop.remove_writer(self._socket.fileno())

    def _readable(self) -> None:
        try:
            data = self._socket.recv(_READ_BYTES)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._end("")
            return
        self._received += data
        while not self._closed and len(self._received) >= HEADER.size:
            (length,) = HEADER.unpack_from(self._received)
            if length > self._max_bytes:
                self._end(f"it sent a message of {length} bytes")
                return
            end = HEADER.size + length
            if len(self._received) < end:
                return
            body = bytes(self._received[HEADER.size : end])
            del self._received[:end]
            try:
                self._on_message(decoded(body))
            except (msgspec.DecodeError, RsePfError, TypeError, ValueError, LookupError):
                self._end("it sent something that is no message")
                return

    def _end(self, fault: str) -> None:
        self._loop.remove_reader(self._socket.fileno())
        self._on_fault(fault)

    def _printed(self) -> None:
        if self._closed:
            return
        try:
            text = os.read(self._output, _READ_BYTES)
        except BlockingIOError:
            return
        except OSError:
            text = b""
        if not text:
            self._loop.remove_reader(self._output)
            return
        for line in text.decode("utf-8", "replace").splitlines():
            self._lines += 1
            if self._lines <= _MAX_LINES:
                self._on_line(line[:_MAX_LINE])
