"""The channel between a worker and one sandbox: messages, and what the sandbox prints.

A hostile service can send any message itself.  Neither it nor a slow one can block the event loop or fill the
worker's memory: the size of a message, its values and levels, and the number and length of printed lines have
limits, and `outcome_of` checks the form of each message.
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

MAX_COMPUTE_MS = 86_400_000.0  # a longer time in a reply is malformed: no command takes a day
_MAX_TEXT = 500  # characters of a failure's message and hint that reach the robot
_READ_BYTES = 1 << 18
_NO_MESSAGE = object()


class IpcChannel:
    """A socket and an output pipe to one sandbox; pass on ``theirs`` and ``their_output``, then `start`."""

    def __init__(
        self,
        loop: AbstractEventLoop,
        *,
        max_bytes: int,
        on_message: Callable[[Any], None],
        on_fault: Callable[[str], None],
        on_line: Callable[[str], None],
    ) -> None:
        """Open both.

        Args:
            loop: Event loop of the worker.
            max_bytes: Limit of one message from the sandbox.
            on_message: Called with each message.
            on_fault: Called once with the reason when the sandbox sent an invalid message, with "" when
                it closed the socket.
            on_line: Called with each line that the service printed, as `OutputLines` bounds them.
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
        """Close the sandbox's ends, which it has by now, and read from ours."""
        self.theirs.close()
        os.close(self.their_output)
        self._loop.add_reader(self._socket.fileno(), self._read_messages)
        self._loop.add_reader(self._output, self._read_output)

    def send(self, data: bytes) -> None:
        """Write an encoded message as soon as the socket takes it."""
        self._unsent += data
        self._flush()

    def stop_reading(self) -> None:
        """Take no further message, not even one that was received: the sandbox is being killed."""
        if self._is_reading:
            self._is_reading = False
            self._loop.remove_reader(self._socket.fileno())

    def close(self) -> None:
        """Read what was printed last, and close both."""
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
            self._unsent.clear()  # the sandbox has ended, which the reader reports
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
    """Return whether *message* reports that the sandbox has started."""
    match message:
        case [str(word)]:
            return word == "ready"
    return False


def outcome_of(message: object) -> SandboxReply | RsePfError:
    """Return the outcome of a request in *message*: a reply, or the typed failure of the service.

    Raises:
        BadMessage: Its parts have other types, or its time is not a number of milliseconds from 0 to
            `MAX_COMPUTE_MS`.
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
