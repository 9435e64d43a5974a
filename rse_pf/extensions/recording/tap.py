"""Pass the messages of a worker to the recorder process, so that no robot waits for a recording.

While a command is processed, its bytes are only appended to a list.  Every 50 ms the list is written to a
non-blocking socket.  If the recorder is too slow or has exited, messages are dropped and counted.
"""

from __future__ import annotations

import errno
import json
import os
import socket
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import NamedTuple

import msgspec
import numpy as np

from rse_pf.identity import RobotId
from rse_pf.wire import Command, Failure, Result

__all__ = [
    "ANSWER_WITH_POSE", "CLOSED", "DECODED_COMMAND", "DOWN", "LOST", "OPENED", "UP", "PipeEntry",
    "PipeReader", "RecordingTap", "recording_pipe", "send_pipe", "split_answer_with_pose",
    "split_decoded_command",
]  # fmt: skip

# Kinds of the entries that a worker writes to the recorder process:
OPENED = 1  # kind of entry: a connection was opened
UP = 2  # kind of entry: a message was received from a robot
DOWN = 3  # kind of entry: a message was sent to a robot
CLOSED = 4  # kind of entry: a connection was closed
LOST = 5  # kind of entry: messages were dropped; the data are their total number
DECODED_COMMAND = 6  # kind of entry: as UP, for a command whose id and free texts precede the message
# Kind of entry: as DOWN, for a result whose command id and pose precede the message.
ANSWER_WITH_POSE = 7
_ENTRY = struct.Struct("<BIQI")
"""Head of an entry: its kind, the number of the connection, the Unix time in ns, and the number of bytes of
data that follow."""
_DECODED_HEAD = struct.Struct("<QB")
"""Head of the data of a ``DECODED_COMMAND``: the id of the command, and the number of bytes of its free
texts, ``stream`` and ``trace``.  The texts and the message follow."""
_MAX_TEXTS_BYTES = 255  # largest size of the free texts of a command: `_DECODED_HEAD` has one byte for it
_POSE_HEAD = struct.Struct("<Q16d")
"""Head of the data of an ``ANSWER_WITH_POSE``: the id of the command, and ``T_camera_world``, row-major.  The
message follows."""
_MESSAGE_KINDS = frozenset({UP, DOWN, DECODED_COMMAND, ANSWER_WITH_POSE})  # kinds that hold a message
_WRITE_INTERVAL_S = 0.05  # time, seconds, for which entries are collected before they are written together
_RETRY_S = 0.005  # time, seconds, until a socket that was full is written to again
# Requested size of the send buffer of the socket; the kernel's default is 200 kB, and it may give less.
_SOCKET_BUFFER_BYTES = 1 << 20
_MAX_WAITING_BYTES = 8 << 20
"""Largest number of bytes that wait in a worker for a slow recorder; further messages are dropped."""
# Bytes of entries after which a copy for the socket ends: bounds the time of one call of `flush`.
_MAX_COPIED_BYTES = 1 << 20


def recording_pipe() -> tuple[int, int]:
    """Return the file descriptors of the recorder's end and of a worker's end, which is non-blocking.

    They are sockets and not a pipe: the writer of a pipe waits for a lock that the reader holds while it
    copies, and the kernel may suspend the recorder meanwhile, which has the lower priority.
    """
    ours, theirs = socket.socketpair()
    theirs.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SOCKET_BUFFER_BYTES)
    theirs.setblocking(False)
    ours.setblocking(True)
    return ours.detach(), theirs.detach()


def send_pipe(to_recorder: int) -> int | None:
    """Make a `recording_pipe`, send its recorder's end to the recorder, and return the worker's end.

    None if the recorder's end cannot be sent, since there will be no recorder any more.

    Args:
        to_recorder: Socket from which the recorder receives its ends; a recorder that starts later also
            receives them.
    """
    ours, theirs = recording_pipe()
    try:
        with socket.socket(fileno=os.dup(to_recorder)) as sending:
            socket.send_fds(sending, [b"+"], [ours])
    except OSError:  # there will be no recorder any more
        os.close(theirs)
        return None
    finally:
        os.close(ours)
    return theirs


class RecordingTap:
    """Pass the messages of a worker's connections to the recorder process.

    Implements `rse_pf.server.worker_context.MessageTap`.
    """

    __slots__ = (
        "_call_later",
        "_connections",
        "_entries",
        "_fd",
        "_is_waiting",
        "_on_dead",
        "_open",
        "_renew",
        "_reported_dropped",
        "_rest",
        "_rest_messages",
        "_time_ns",
        "_waiting_bytes",
        "dropped",
        "is_dead",
    )

    def __init__(
        self,
        fd: int,
        *,
        call_later: Callable[[float, Callable[[], None]], object],
        on_dead: Callable[[], None] = lambda: None,
        renew: Callable[[], int | None] = lambda: None,
        time_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        """Prepare to write to the pipe; nothing is written yet.

        Args:
            fd: The worker's end of a `recording_pipe`.
            call_later: The method of the event loop that calls a function after some seconds.
            on_dead: Called once when the recorder has exited and no other one will start.
            renew: Called when the recorder has exited; returns the worker's end of a pipe to the next
                recorder, or None if there will be none.
            time_ns: Returns the Unix time in nanoseconds.
        """
        self.dropped = 0
        """Number of messages that no recording holds, because the recorder was too slow or had exited."""
        self.is_dead = False
        """Whether the recorder has exited and no other one will start; then nothing is recorded."""
        self._fd = fd
        self._call_later = call_later
        self._on_dead, self._renew = on_dead, renew
        self._open: dict[int, bytes] = {}
        self._time_ns = time_ns
        self._connections = self._reported_dropped = 0
        self._entries: list[tuple[int, int, int, bytes]] = []
        self._waiting_bytes = 0
        self._rest = memoryview(b"")
        self._rest_messages = 0
        self._is_waiting = False

    def open_connection(self, codec: str, robot: RobotId) -> int:
        """Record that *robot* opened a connection, and return its number for the other methods."""
        self._connections += 1
        described = self._open[self._connections] = json.dumps([codec, *robot]).encode()
        self._append(OPENED, self._connections, described)
        return self._connections

    def close_connection(self, connection: int) -> None:
        """Record that *connection* has ended."""
        self._open.pop(connection, None)
        self._append(CLOSED, connection, b"")

    def observe_received(self, connection: int, data: bytes) -> None:
        """Record a message from the robot; it is dropped if 8 MiB wait for the recorder already."""
        if self._waiting_bytes < _MAX_WAITING_BYTES and not self.is_dead:
            self._append(UP, connection, data)
        else:
            self.dropped += 1

    def observe_command(self, data: bytes, command: Command) -> None:
        """Put id and free texts of *command* before its message *data* in the entry that was recorded last.

        The recorder searches messages for tokens and names of robots.  With the free texts it can do so
        without inflating the message.  The entry stays as it is, and the recorder inflates the message, if
        the codec has not decoded the payload to a structure with known fields (then texts other than
        ``stream`` and ``trace`` may be free), or if both texts together exceed 255 bytes.  Nothing is done if
        *data* was dropped.
        """
        if isinstance(command.payload, msgspec.Struct):
            text = f"{command.stream} {command.trace}".encode()
            if len(text) <= _MAX_TEXTS_BYTES:
                self._describe_newest(DECODED_COMMAND, data, _DECODED_HEAD.pack(command.id, len(text)) + text)

    def observe_sent(self, connection: int, data: bytes) -> None:
        """Record a message to the robot; it is dropped if 8 MiB wait for the recorder already."""
        if self._waiting_bytes < _MAX_WAITING_BYTES and not self.is_dead:
            self._append(DOWN, connection, data)
        else:
            self.dropped += 1

    def observe_answer(self, data: bytes, command: Command, answer: Result | Failure) -> None:
        """Put the pose of *answer* before its message *data* in the entry that was recorded last.

        The recorder then does not have to inflate the message.  The entry stays as it is, and the recorder
        inflates the message, if the answer has no pose, or if the payload of the command was not decoded to a
        structure (the answer may then contain texts of the robot).  Nothing is done if *data* was dropped.
        """
        if not isinstance(command.payload, msgspec.Struct) or not isinstance(answer, Result):
            return
        pose = getattr(answer.reply, "T_camera_world", None)
        if isinstance(pose, np.ndarray) and pose.dtype == np.float64 and pose.size == 16:
            self._describe_newest(ANSWER_WITH_POSE, data, answer.id.to_bytes(8, "little") + pose.tobytes())

    def _describe_newest(self, kind: int, data: bytes, head: bytes) -> None:
        """Change the newest entry to *kind* and put *head* before its data, if its data is *data*."""
        if not self._entries:
            return
        _, connection, time_ns, taken = self._entries[-1]
        if taken is data:
            self._entries[-1] = kind, connection, time_ns, head + data
            self._waiting_bytes += len(head)

    def flush(self) -> None:
        """Write waiting entries to the pipe until it is full; write the others later."""
        self._is_waiting = False
        try:
            while True:
                if self._rest:
                    written = os.write(self._fd, self._rest)
                    self._waiting_bytes -= written
                    self._rest = self._rest[written:]
                elif self._entries:
                    self._rest = memoryview(self._pack())
                else:
                    return
        except BlockingIOError:
            self._wait(_RETRY_S)
        except OSError as error:
            if error.errno == errno.ENOBUFS:
                self._wait(_RETRY_S)
            else:
                self._replace_recorder()

    def _append(self, kind: int, connection: int, data: bytes) -> None:
        if self.is_dead:
            return
        self._entries.append((kind, connection, self._time_ns(), data))
        self._waiting_bytes += _ENTRY.size + len(data)
        if not self._is_waiting:
            self._wait()

    def _wait(self, seconds: float = _WRITE_INTERVAL_S) -> None:
        self._is_waiting = True
        self._call_later(seconds, self.flush)

    def _pack(self) -> bytes:
        """Remove the next entries, about 1 MiB at most, and return them in the format of the pipe.

        If no entry remains and messages were dropped since the last report, an entry ``LOST`` with their
        total number is added.
        """
        parts: list[bytes] = []
        size = count = messages = 0
        for kind, connection, time_ns, data in self._entries:
            parts += (_ENTRY.pack(kind, connection, time_ns, len(data)), data)
            size += len(data)
            count += 1
            messages += kind in _MESSAGE_KINDS
            if size >= _MAX_COPIED_BYTES:
                break
        del self._entries[:count]
        self._rest_messages = messages
        if self.dropped != self._reported_dropped and not self._entries:
            self._reported_dropped = self.dropped
            lost = _ENTRY.pack(LOST, 0, self._time_ns(), 8) + struct.pack("<Q", self.dropped)
            self._waiting_bytes += len(lost)
            parts.append(lost)
        return b"".join(parts)

    def _replace_recorder(self) -> None:
        """Connect to the next recorder after one has exited, or stop recording if there will be none.

        The next recorder first gets an ``OPENED`` entry for every open connection.
        """
        self.dropped += self._rest_messages  # an upper bound: the recorder may have received some of them
        self._rest, self._rest_messages = memoryview(b""), 0
        with suppress(OSError):
            os.close(self._fd)
        fd = self._renew()
        if fd is not None:
            self._fd = fd
            now = self._time_ns()
            waiting = [entry for entry in self._entries if entry[0] != OPENED or entry[1] not in self._open]
            self._entries = [(OPENED, number, now, data) for number, data in self._open.items()] + waiting
            self._waiting_bytes = sum(_ENTRY.size + len(data) for _, _, _, data in self._entries)
            self._wait(_RETRY_S)
            return
        self.is_dead = True
        self.dropped += sum(kind in _MESSAGE_KINDS for kind, _, _, _ in self._entries)
        self._entries.clear()
        self._open.clear()
        self._waiting_bytes = 0
        self._on_dead()


class PipeEntry(NamedTuple):
    """One entry of the pipe: its kind, the number of the connection, the Unix time in ns, and its data."""

    kind: int
    connection: int
    time_ns: int
    data: bytes


def split_decoded_command(data: bytes) -> tuple[int, bytes, bytes]:
    """Return the id of the command, its free texts, and the message in the data of a ``DECODED_COMMAND``."""
    identity, size = _DECODED_HEAD.unpack_from(data)
    end = _DECODED_HEAD.size + size
    return identity, data[_DECODED_HEAD.size : end], data[end:]


def split_answer_with_pose(data: bytes) -> tuple[int, tuple[float, ...], bytes]:
    """Return the id of the command, its ``T_camera_world``, and the message of an ``ANSWER_WITH_POSE``."""
    identity, *pose = _POSE_HEAD.unpack_from(data)
    return identity, tuple(pose), data[_POSE_HEAD.size :]


class PipeReader:
    """Split the bytes that come out of a pipe into entries."""

    def __init__(self) -> None:
        self._left = b""

    def entries(self, data: bytes) -> Iterator[PipeEntry]:
        """Yield the entries that are complete after *data*; the rest is kept for the next call."""
        whole = self._left + data if self._left else data
        at, end, head = 0, len(whole), _ENTRY.size
        while end - at >= head:
            kind, connection, time_ns, size = _ENTRY.unpack_from(whole, at)
            if end - at - head < size:
                break
            yield PipeEntry(kind, connection, time_ns, whole[at + head : at + head + size])
            at += head + size
        self._left = whole[at:]
