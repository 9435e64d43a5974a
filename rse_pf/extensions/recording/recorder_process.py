"""The recorder of one server: reads what workers deliver, and writes it to files.

It ends when no worker is left, after it finished its file.  It has a lower priority than the workers: robots
come first, and what it cannot keep up with is dropped in the workers and counted.
"""

from __future__ import annotations

import json
import os
import secrets
import selectors
import socket
import struct
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec

from rse_pf.config import SessionSettings
from rse_pf.extensions.recording.file_format import (
    EVENT_SCHEMA,
    EVENTS_TOPIC,
    POSE_SCHEMA,
    POSES_PREFIX,
    WIRE_ENCODING,
    Direction,
    WireChannel,
    wire_metadata,
    wire_topic,
)
from rse_pf.extensions.recording.poses import inverse, pose_in_frame, read_answered_pose
from rse_pf.extensions.recording.redact import KEY_BYTES, ConnectionRedactor, Kept, Pseudonyms
from rse_pf.extensions.recording.tap import (
    CLOSED,
    DOWN,
    LOST,
    OPENED,
    PLAIN,
    POSE,
    UP,
    Handed,
    PipeReader,
    plain_parts,
    pose_parts,
)
from rse_pf.extensions.recording.writer import RecordingWriter
from rse_pf.identity import RobotId
from rse_pf.processes.ipc import receive
from rse_pf.processes.start import Child, ChildPlan, start_child
from rse_pf.wire import make_codec

__all__ = [
    "MessageRecorder", "PipeRecorder", "RecordedConnection", "RecorderPlan", "run", "start_recorder",
]  # fmt: skip

_READ_BYTES = 1 << 15
"""Read at a time: half a millisecond of work, after which a robot's command may have the processor."""
_GATHER_S = 0.1
"""To be woken and to find cold caches costs more than what a few messages do."""
_FLUSH_S = 0.2
_MOST_FDS = 4
_CHILD = ChildPlan(
    target=f"{__name__}:run", name="rse-pf recorder", policy="batch", nice=5, outlives_parent=True
)
_TOLD = frozenset({PLAIN, POSE})
_HEX_BYTES = 8


class RecorderPlan(msgspec.Struct, frozen=True, kw_only=True):
    """What a recorder process is told at its start.

    Attributes:
        started_ns: When the server's first recorder was started, Unix time.
        from_workers: Socket from which it takes its ends of the workers' pipes, until no worker is left.
        restarts: How many recorders of this server ended before.
        key: File of the key of the pseudonyms, "" for the one that it is told with the plan.
    """

    folder: str
    server: str
    version: str
    started_ns: int
    from_workers: int
    restarts: int = 0
    max_bytes: int
    session: dict[str, Any] = {}
    metadata: dict[str, str] = {}
    key: str = ""


class RecordedConnection:
    """One connection of a recording: its channels, and what may be stored of its messages."""

    def __init__(self, redactor: ConnectionRedactor, *, identity: str, codec: str, server: str) -> None:
        self.redactor = redactor
        self.identity = identity
        self.codec = codec
        self.server = server
        self.channels: dict[Direction, int] = {}

    def wire_channel(self, direction: Direction) -> WireChannel:
        """Return what the channel of one direction says."""
        return WireChannel(
            self.identity, direction, self.codec, self.server, self.redactor.robot, self.redactor.tenant
        )


class MessageRecorder:
    """Writes messages of connections, and the poses that they tell, by a `RecordingWriter`."""

    def __init__(
        self, writer: RecordingWriter, pseudonyms: Pseudonyms, session: SessionSettings, server: str
    ) -> None:
        self.writer = writer
        self.left_out = 0
        """Messages that a recording does not hold by design."""
        self._pseudonyms = pseudonyms
        self._session = session
        self._server = server
        self._codecs: dict[str, Any] = {}

    def open(self, codec: str, robot: RobotId, secrets_: tuple[str, ...] = ()) -> RecordedConnection:
        """Return a new connection of *robot*; no message that holds one of *secrets_* is stored."""
        if codec not in self._codecs:
            self._codecs[codec] = make_codec(codec, self._session)
        redactor = ConnectionRedactor(
            self._codecs[codec], robot, self._pseudonyms,
            max_inflated_bytes=self._session.max_inflated_bytes, secrets=secrets_,
        )  # fmt: skip
        identity = secrets.token_hex(_HEX_BYTES)
        return RecordedConnection(redactor, identity=identity, codec=codec, server=self._server)

    def take(self, connection: RecordedConnection, direction: Direction, time_ns: int, data: bytes) -> None:
        """Write a message, unless it is one of those that are left out."""
        redactor = connection.redactor
        stored = redactor.up(data) if direction == "up" else redactor.down(data)
        self._write(connection, direction, time_ns, stored)
        if stored is not None and stored.type == "result" and stored.service == "pnp":
            self._add_pose(
                connection, time_ns, read_answered_pose(stored.text, is_binary=connection.codec == "bin")
            )

    def take_plain(self, connection: RecordedConnection, time_ns: int, data: bytes) -> None:
        """Write a command that its server has read, the data of a ``PLAIN`` entry."""
        self._write(connection, "up", time_ns, connection.redactor.plain(*plain_parts(data)))

    def take_pose(self, connection: RecordedConnection, time_ns: int, data: bytes) -> None:
        """Write an answer whose pose its server told, the data of a ``POSE`` entry."""
        identity, pose, message = pose_parts(data)
        stored = connection.redactor.pose(identity, message)
        self._write(connection, "down", time_ns, stored)
        if stored is not None:
            self._add_pose(connection, time_ns, pose)

    def _write(
        self, connection: RecordedConnection, direction: Direction, time_ns: int, stored: Kept | None
    ) -> None:
        if stored is None:
            self.left_out += 1
            return
        channel = connection.channels.get(direction)
        if channel is None:
            described = connection.wire_channel(direction)
            channel = connection.channels[direction] = self.writer.channel(
                wire_topic(connection.identity, direction), WIRE_ENCODING, wire_metadata(described)
            )
        self.writer.add(channel, time_ns, stored.data)

    def close(self, connection: RecordedConnection) -> None:
        """Take that a connection is over."""
        for channel in connection.channels.values():
            self.writer.forget(channel)

    def event(self, time_ns: int, kind: str, **fields: Any) -> None:
        """Write an event of the recording itself."""
        value = {"time_s": time_ns / 1e9, "kind": kind, "server": self._server, **fields}
        self.writer.add_json(EVENTS_TOPIC, EVENT_SCHEMA, time_ns, value)

    def _add_pose(
        self, connection: RecordedConnection, time_ns: int, T_camera_world: Sequence[float] | None
    ) -> None:
        if T_camera_world is not None:
            frame_message = pose_in_frame(inverse(T_camera_world), time_ns)
            topic = f"{POSES_PREFIX}{connection.redactor.robot}"
            self.writer.add_json(topic, POSE_SCHEMA, time_ns, frame_message)


class PipeRecorder:
    """Records what comes out of the pipe of one worker."""

    def __init__(self, recorder: MessageRecorder) -> None:
        """Know no connection yet."""
        self._recorder = recorder
        self._reader = PipeReader()
        self._connections: dict[int, RecordedConnection] = {}
        self._lost = 0

    def read(self, data: bytes) -> None:
        """Take the next bytes of the pipe."""
        for entry in self._reader.entries(data):
            self._take(entry)

    def end(self) -> None:
        """Take that the worker is gone."""
        for connection in self._connections.values():
            self._recorder.close(connection)

    def _take(self, entry: Handed) -> None:
        if entry.kind in _TOLD:
            connection = self._connections.get(entry.connection)
            take = self._recorder.take_plain if entry.kind == PLAIN else self._recorder.take_pose
            if connection is not None:
                take(connection, entry.time_ns, entry.data)
        elif entry.kind == OPENED:
            codec, *robot = json.loads(entry.data)
            self._connections[entry.connection] = self._recorder.open(codec, RobotId(*robot))
        elif entry.kind == LOST:
            (lost,) = struct.unpack("<Q", entry.data)
            self._recorder.event(entry.time_ns, "recording-dropped", messages=lost - self._lost)
            self._lost = lost
        elif entry.kind == CLOSED:
            connection = self._connections.pop(entry.connection, None)
            if connection is not None:
                self._recorder.close(connection)
        elif entry.kind in (UP, DOWN):
            connection = self._connections.get(entry.connection)
            if connection is not None:
                direction: Direction = "up" if entry.kind == UP else "down"
                self._recorder.take(connection, direction, entry.time_ns, entry.data)


def start_recorder(plan: RecorderPlan, key: bytes) -> Child:
    """Return the process of a new recorder with the key of its pseudonyms; raises OSError.

    Its log lines go where those of this process go.
    """
    child = start_child(_CHILD, descriptors=(plan.from_workers,))
    child.say([msgspec.to_builtins(plan), key])
    child.connection.close()  # workers are forked from this process, and would have it
    return child


def run(server: socket.socket) -> None:
    """Record until no worker is left."""
    with server:
        order = receive(server)
    if order is None:
        return
    plan, key = msgspec.convert(order[0], RecorderPlan), order[1]
    session = SessionSettings(**plan.session)
    with suppress(OSError):  # the writer says why it cannot write
        Path(plan.folder).mkdir(parents=True, exist_ok=True)
    writer = RecordingWriter(
        Path(plan.folder), plan.server, started_ns=plan.started_ns,
        max_bytes=plan.max_bytes, metadata={**plan.metadata, "version": plan.version},
    )  # fmt: skip
    recorder = MessageRecorder(writer, Pseudonyms(_key(plan.key, key)), session, plan.server)
    recorder.event(time.time_ns(), "recording-started", restarts=plan.restarts)
    with (
        selectors.DefaultSelector() as selector,
        socket.socket(fileno=plan.from_workers) as from_workers,
    ):
        from_workers.setblocking(False)
        selector.register(from_workers, selectors.EVENT_READ)
        _loop(selector, from_workers, recorder, plan)
    recorder.event(time.time_ns(), "recording-over", left_out=recorder.left_out)
    writer.close()


def _loop(
    selector: selectors.BaseSelector,
    from_workers: socket.socket,
    recorder: MessageRecorder,
    plan: RecorderPlan,
) -> None:
    writer, problem = recorder.writer, ""
    buffer = bytearray(_READ_BYTES)  # a new one for each read would cost more than what it holds
    view = memoryview(buffer)
    while selector.get_map():
        has_more = False
        for key, _ in selector.select(_FLUSH_S):
            if key.fileobj is from_workers:
                _take_pipes(selector, from_workers, recorder)
                continue
            try:
                size = os.readv(key.fd, [buffer])
            except ConnectionResetError:
                size = 0
            if size:
                key.data.read(bytes(view[:size]))
                has_more = has_more or size == _READ_BYTES
                os.sched_yield()
            else:
                selector.unregister(key.fd)
                os.close(key.fd)
                key.data.end()
        writer.flush(time.time_ns())
        if writer.problem != problem:
            problem = writer.problem
            _log(plan.server, problem, writer.dropped)
        if not has_more:
            time.sleep(_GATHER_S)


def _take_pipes(
    selector: selectors.BaseSelector, from_workers: socket.socket, recorder: MessageRecorder
) -> None:
    """Take the ends of pipes that workers sent; leave *selector* once there is no worker any more."""
    try:
        data, fds, _, _ = socket.recv_fds(from_workers, 1, _MOST_FDS)
    except BlockingIOError:
        return
    except OSError:
        data, fds = b"", []
    for fd in fds:
        selector.register(fd, selectors.EVENT_READ, PipeRecorder(recorder))
    if not data:
        selector.unregister(from_workers)


def _log(server: str, problem: str, dropped: int) -> None:
    """Write a log line about the disk, as a server writes its own."""
    line: dict[str, Any] = {"time": time.time(), "level": "warning", "event": "recording-resumed"}
    line |= {"server": server, "dropped": dropped}
    if problem:
        hint = "robots are served on; free some space, or record to another folder"
        line |= {"event": "recording-stopped", "reason": problem, "hint": hint}
    with suppress(OSError):
        os.write(2, json.dumps(line).encode() + b"\n")


def _key(file: str, told: bytes) -> bytes:
    """Return the key of the pseudonyms of this recording: that of *file*, or the one that was *told*."""
    if file:
        with suppress(OSError):
            key = Path(file).read_bytes()
            if len(key) >= KEY_BYTES:
                return key
    return told
