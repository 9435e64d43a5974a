"""Hand the messages of a worker over to the recorder process, so that a robot never waits for a recording.

In the path of a command nothing happens but that bytes are appended to a list.  Every 50 ms the list goes
into a channel that never blocks.  While the recorder is slow or dead, messages are dropped and counted.
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
    "CLOSED", "DOWN", "LOST", "OPENED", "PLAIN", "POSE", "UP", "Handed", "PipeReader", "RecordingTap",
    "hand_pipe", "plain_parts", "pose_parts", "recording_pipe",
]  # fmt: skip

OPENED, UP, DOWN, CLOSED, LOST, PLAIN, POSE = 1, 2, 3, 4, 5, 6, 7
"""What one entry of the pipe is about; ``PLAIN`` is an ``UP``, ``POSE`` a ``DOWN``, whose content is told."""
_ENTRY = struct.Struct("<BIQI")
"""Kind, number of the connection, Unix time in ns, bytes of data that follow."""
_PLAIN = struct.Struct("<QB")
"""Id of the command, and bytes of its words; both and the message follow."""
_MAX_WORDS_BYTES = 255
_POSE = struct.Struct("<Q16d")
"""Id of the command, and ``T_camera_world``, row-major; the message follows."""
_MESSAGES = frozenset({UP, DOWN, PLAIN, POSE})
_HAND_OVER_S = 0.05
_RETRY_S = 0.005
"""The kernel buffers 200 kB by default, which it may not take at once."""
_BUFFER_BYTES = 1 << 20
_MAX_WAITING_BYTES = 8 << 20
"""Bytes of messages that wait in a worker for a slow recorder; more are dropped."""
_COPIED_BYTES = 1 << 20


def recording_pipe() -> tuple[int, int]:
    """Return the descriptors of the recorder's end and of a worker's end, which never blocks.

    They are sockets: the writer of a pipe waits for a lock that its reader holds while it copies, and the
    recorder, which has the lower priority, may be taken off the processor meanwhile.
    """
    ours, theirs = socket.socketpair()
    theirs.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER_BYTES)
    theirs.setblocking(False)
    ours.setblocking(True)
    return ours.detach(), theirs.detach()


def hand_pipe(to_recorder: int) -> int | None:
    """Return a worker's end of a new `recording_pipe` whose other end the recorder gets, None if it cannot.

    Args:
        to_recorder: Socket on which a recorder takes its ends, also one that is yet to start.
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
    """Pass the messages of connections to the recorder; a `rse_pf.server.worker_context.MessageTap`."""

    __slots__ = (
        "_call_later",
        "_connections",
        "_entries",
        "_fd",
        "_is_waiting",
        "_on_dead",
        "_open",
        "_renew",
        "_rest",
        "_rest_messages",
        "_time_ns",
        "_told",
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
        """Hand nothing over yet.

        Args:
            fd: The worker's end of a `recording_pipe`.
            call_later: Of the event loop.
            on_dead: Called once when the recorder is gone, and there will be no other.
            renew: Returns the worker's end of a pipe to the next recorder when one is gone, None if there
                will be none.
            time_ns: Unix time.
        """
        self.dropped = 0
        """Messages that no recording will hold."""
        self.is_dead = False
        self._fd = fd
        self._call_later = call_later
        self._on_dead, self._renew = on_dead, renew
        self._open: dict[int, bytes] = {}
        self._time_ns = time_ns
        self._connections = self._told = 0
        self._entries: list[tuple[int, int, int, bytes]] = []
        self._waiting_bytes = 0
        self._rest = memoryview(b"")
        self._rest_messages = 0
        self._is_waiting = False

    def open_connection(self, codec: str, robot: RobotId) -> int:
        """Return the number of a new connection, for the other calls."""
        self._connections += 1
        described = self._open[self._connections] = json.dumps([codec, *robot]).encode()
        self._append(OPENED, self._connections, described)
        return self._connections

    def close_connection(self, connection: int) -> None:
        """Record that *connection* has ended."""
        self._open.pop(connection, None)
        self._append(CLOSED, connection, b"")

    def observe_received(self, connection: int, data: bytes) -> None:
        """Record a message from the robot."""
        if self._waiting_bytes < _MAX_WAITING_BYTES and not self.is_dead:
            self._append(UP, connection, data)
        else:
            self.dropped += 1

    def observe_command(self, data: bytes, command: Command) -> None:
        """Record what *data*, the message that was received last, was decoded to.

        The recorder then need not inflate it.  That is possible if the codec decoded the payload to a
        structure, which it does only if it knows all fields; its only texts are ``stream`` and ``trace``.
        """
        if isinstance(command.payload, msgspec.Struct):
            text = f"{command.stream} {command.trace}".encode()
            if len(text) <= _MAX_WORDS_BYTES:
                self._describe_newest(PLAIN, data, _PLAIN.pack(command.id, len(text)) + text)

    def observe_sent(self, connection: int, data: bytes) -> None:
        """Record a message to the robot."""
        if self._waiting_bytes < _MAX_WAITING_BYTES and not self.is_dead:
            self._append(DOWN, connection, data)
        else:
            self.dropped += 1

    def observe_answer(self, data: bytes, command: Command, answer: Result | Failure) -> None:
        """Record the pose in *data*, the message that was sent last, so that nobody inflates it again.

        Nothing is recorded if the answer has no pose, or may hold texts of the robot.
        """
        if not isinstance(command.payload, msgspec.Struct) or not isinstance(answer, Result):
            return
        pose = getattr(answer.reply, "T_camera_world", None)
        if isinstance(pose, np.ndarray) and pose.dtype == np.float64 and pose.size == 16:
            self._describe_newest(POSE, data, answer.id.to_bytes(8, "little") + pose.tobytes())

    def _describe_newest(self, kind: int, data: bytes, head: bytes) -> None:
        """Put *head* before the newest entry, if that is *data*."""
        if not self._entries:
            return
        _, connection, time_ns, taken = self._entries[-1]
        if taken is data:
            self._entries[-1] = kind, connection, time_ns, head + data
            self._waiting_bytes += len(head)

    def flush(self) -> None:
        """Write what waits into the pipe, as much as it takes now."""
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
                self._die()

    def _append(self, kind: int, connection: int, data: bytes) -> None:
        if self.is_dead:
            return
        self._entries.append((kind, connection, self._time_ns(), data))
        self._waiting_bytes += _ENTRY.size + len(data)
        if not self._is_waiting:
            self._wait()

    def _wait(self, seconds: float = _HAND_OVER_S) -> None:
        self._is_waiting = True
        self._call_later(seconds, self.flush)

    def _pack(self) -> bytes:
        """Return the next entries as they are in the pipe, a bounded copy of them."""
        parts: list[bytes] = []
        size = count = messages = 0
        for kind, connection, time_ns, data in self._entries:
            parts += (_ENTRY.pack(kind, connection, time_ns, len(data)), data)
            size += len(data)
            count += 1
            messages += kind in _MESSAGES
            if size >= _COPIED_BYTES:
                break
        del self._entries[:count]
        self._rest_messages = messages
        if self.dropped != self._told and not self._entries:
            self._told = self.dropped
            lost = _ENTRY.pack(LOST, 0, self._time_ns(), 8) + struct.pack("<Q", self.dropped)
            self._waiting_bytes += len(lost)
            parts.append(lost)
        return b"".join(parts)

    def _die(self) -> None:
        """Go on with the next recorder, which knows no connection yet, or with none."""
        self.dropped += self._rest_messages  # some of which it may have got
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
        self.dropped += sum(kind in _MESSAGES for kind, _, _, _ in self._entries)
        self._entries.clear()
        self._open.clear()
        self._waiting_bytes = 0
        self._on_dead()


class Handed(NamedTuple):
    """One entry of the pipe: its kind, the number of the connection, Unix time in ns, and the bytes."""

    kind: int
    connection: int
    time_ns: int
    data: bytes


def plain_parts(data: bytes) -> tuple[int, bytes, bytes]:
    """Return the id, the words and the message of a ``PLAIN`` entry."""
    identity, size = _PLAIN.unpack_from(data)
    end = _PLAIN.size + size
    return identity, data[_PLAIN.size : end], data[end:]


def pose_parts(data: bytes) -> tuple[int, tuple[float, ...], bytes]:
    """Return the id, ``T_camera_world`` and the message of a ``POSE`` entry."""
    identity, *pose = _POSE.unpack_from(data)
    return identity, tuple(pose), data[_POSE.size :]


class PipeReader:
    """Cuts what comes out of a pipe into entries."""

    def __init__(self) -> None:
        self._left = b""

    def entries(self, data: bytes) -> Iterator[Handed]:
        """Yield the entries that *data* completes."""
        whole = self._left + data if self._left else data
        at, end, head = 0, len(whole), _ENTRY.size
        while end - at >= head:
            kind, connection, time_ns, size = _ENTRY.unpack_from(whole, at)
            if end - at - head < size:
                break
            yield Handed(kind, connection, time_ns, whole[at + head : at + head + size])
            at += head + size
        self._left = whole[at:]
