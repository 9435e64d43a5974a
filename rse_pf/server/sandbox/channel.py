"""The worker's side of the channel to one sandbox: a socket for messages and a pipe for printed output.

A hostile service can send any bytes to the worker.  Neither a hostile nor a slow service can block the event
loop or fill the worker's memory: size, number of values and nesting depth of a message are limited, and so
are number and length of printed lines.  `outcome_of` checks the types in each message.
"""

from __future__ import annotations

import math
import os
import socket
from asyncio import AbstractEventLoop
from collections.abc import Callable
from typing import Any, TypeGuard

from rse_pf.errors import BadMessage, RsePfError, error_from_code
from rse_pf.processes.ipc import FrameReader
from rse_pf.server.sandbox.policy import SandboxReply
from rse_pf.services.custom.output import OutputLines

__all__ = ["MAX_COMPUTE_MS", "IpcChannel", "is_ready", "outcome_of"]

MAX_COMPUTE_MS = 86_400_000.0  # longest computing time in a reply: one day; a longer one is malformed
_MAX_TEXT = 500  # longest message and longest hint of a service's failure in characters; longer ones are cut
_READ_BYTES = 1 << 18  # bytes read from the socket or the pipe at a time, so that the event loop stays free
_NO_MESSAGE = object()  # marks the end of the complete messages, because a message may be None


class IpcChannel:
    """A socket and an output pipe between the worker and one sandbox.

    The caller passes the sandbox's ends, ``theirs`` (socket) and ``their_output`` (descriptor of the pipe),
    to the sandbox and then calls `start`.
    """

    def __init__(
        self,
        loop: AbstractEventLoop,
        *,
        max_bytes: int,
        on_message: Callable[[Any], None],
        on_fault: Callable[[str], None],
        on_line: Callable[[str], None],
    ) -> None:
        """Open the socket and the pipe; nothing is read before `start`.

        Args:
            loop: Event loop of the worker.
            max_bytes: Largest message from the sandbox in bytes.
            on_message: Called with each decoded message.
            on_fault: Called at most once, after which no message is read: with a reason when the sandbox sent
                a message that is too large or not MessagePack, with "" when it closed the socket.
            on_line: Called with each line that the service printed; `OutputLines` limits length and rate.
        """
        self._loop = loop
        self._frames = FrameReader(max_bytes)
        self._on_message = on_message
        self._on_fault = on_fault
        self._on_line = on_line
        self._socket, self.theirs = socket.socketpair()
        self._output, self.their_output = os.pipe()
        self._unsent = bytearray()
        self._lines = OutputLines()
        self._is_reading = True
        self._socket.setblocking(False)
        os.set_blocking(self._output, False)

    def start(self) -> None:
        """Close the worker's copies of the sandbox's ends, and begin to read in the event loop."""
        self.theirs.close()
        os.close(self.their_output)
        self._loop.add_reader(self._socket.fileno(), self._read_messages)
        self._loop.add_reader(self._output, self._read_output)

    def send(self, data: bytes) -> None:
        """Send an encoded message without blocking; what the socket does not take now is sent later."""
        self._unsent += data
        self._flush()

    def stop_reading(self) -> None:
        """Ignore all further messages, including those already received, because the sandbox is being killed.

        Printed output is still read.
        """
        if self._is_reading:
            self._is_reading = False
            self._loop.remove_reader(self._socket.fileno())

    def close(self) -> None:
        """Read the rest of the printed output, and close socket and pipe; a second call does nothing."""
        if self._socket.fileno() < 0:
            return
        self.stop_reading()
        self._read_output()
        for line in self._lines.end(self._loop.time()):
            self._on_line(line)
        self._loop.remove_reader(self._output)
        self._loop.remove_writer(self._socket.fileno())
        self._socket.close()
        os.close(self._output)

    def _flush(self) -> None:
        if self._socket.fileno() < 0:
            return
        try:
            del self._unsent[: self._socket.send(self._unsent)]
        except BlockingIOError:
            pass
        except OSError:
            self._unsent.clear()  # the sandbox has exited; the next read of the socket reports that
        if self._unsent:
            self._loop.add_writer(self._socket.fileno(), self._flush)
        else:
            self._loop.remove_writer(self._socket.fileno())

    def _read_messages(self) -> None:
        try:
            data = self._socket.recv(_READ_BYTES)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        messages = self._frames.feed(data)
        while self._is_reading:
            try:
                message = next(messages, _NO_MESSAGE)
            except RsePfError as error:
                self._fail(f"it sent an invalid message: {error.message}")
                return
            if message is _NO_MESSAGE:
                break
            self._on_message(message)
        if not data and self._is_reading:
            self._fail("")

    def _fail(self, why: str) -> None:
        self.stop_reading()
        self._on_fault(why)

    def _read_output(self) -> None:
        if self._socket.fileno() < 0:
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
        for line in self._lines.feed(text, self._loop.time()):
            self._on_line(line)


def is_ready(message: object) -> bool:
    """Return whether *message* is ``["ready"]``: the sandbox is isolated, and takes requests."""
    match message:
        case [str(word)]:
            return word == "ready"
    return False


def outcome_of(message: object) -> SandboxReply | RsePfError:
    """Return the reply of a service in a sandbox's *message*, or the error with which the service failed.

    A message is ``[True, value, snapshot, ms]`` or ``[False, code, text, hint, ms]``, where *ms* is the
    computing time in milliseconds.

    Raises:
        BadMessage: The message has another form, or its time is not a number from 0 to `MAX_COMPUTE_MS`.
    """
    match message:
        case [True, value, (None | bytes()) as snapshot, compute_ms] if _is_time(compute_ms):
            return SandboxReply(value, float(compute_ms), snapshot)
        case [False, str(code), str(text), str(hint), compute_ms] if _is_time(compute_ms):
            return error_from_code(code, text[:_MAX_TEXT], hint=hint[:_MAX_TEXT])
    raise BadMessage("it sent a message of no known form")


def _is_time(value: object) -> TypeGuard[float]:
    if not isinstance(value, int | float) or isinstance(value, bool):
        return False
    return math.isfinite(value) and 0 <= value <= MAX_COMPUTE_MS
