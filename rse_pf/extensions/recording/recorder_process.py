"""The recorder process of a server: reads messages from the pipes of the workers, and writes them to files.

The process finishes its file and exits when no worker is left.  It has a lower priority than the workers; if
it cannot keep up, the workers drop and count messages.
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
    ANSWER_WITH_POSE,
    CLOSED,
    DECODED_COMMAND,
    DOWN,
    LOST,
    OPENED,
    UP,
    PipeEntry,
    PipeReader,
    split_answer_with_pose,
    split_decoded_command,
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
"""Largest number of bytes that are read at a time: half a millisecond of work, after which the process yields
the processor to a worker."""
_READ_INTERVAL_S = 0.1
"""Pause, seconds, after the pipes were read empty: waking up for each message costs more than its work."""
_FLUSH_INTERVAL_S = 0.2  # longest time, seconds, between two calls of `RecordingWriter.flush`
_MAX_RECEIVED_FDS = 4  # largest number of file descriptors that are received with one message
# How a recorder process is started.
_CHILD = ChildPlan(
    target=f"{__name__}:run", name="rse-pf recorder", policy="batch", nice=5, outlives_parent=True
)
# kinds whose id, texts or pose were decoded by a worker
_DECODED_KINDS = frozenset({DECODED_COMMAND, ANSWER_WITH_POSE})
_CONNECTION_ID_BYTES = 8  # random bytes of the identifier of a connection, 16 hex digits


class RecorderPlan(msgspec.Struct, frozen=True, kw_only=True):
    """The configuration of a recorder process.

    Attributes:
        folder: Folder for the files.
        server: Name of the server.
        version: Version of the software.
        started_ns: Unix time, ns, at which the first recorder of the server was started.
        from_workers: Descriptor of the socket from which the recorder receives its ends of the workers'
            pipes, until no worker is left.
        restarts: Number of recorders of this server that exited before.
        max_bytes: Size of all recordings in the folder, bytes, above which the oldest ones are deleted.
        session: Limits of messages, the fields of `SessionSettings`.
        metadata: Further values for the metadata record of each file.
        key: File with the key of the pseudonyms; "" for the key that is sent with this plan.
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
    """A connection of a recording: its redactor, its random identifier, and its channels by direction."""

    def __init__(self, redactor: ConnectionRedactor, *, identity: str, codec: str, server: str) -> None:
        self.redactor = redactor
        self.identity = identity
        self.codec = codec
        self.server = server
        self.channels: dict[Direction, int] = {}

    def wire_channel(self, direction: Direction) -> WireChannel:
        """Return the description of the channel for the messages of this connection in one direction."""
        return WireChannel(
            self.identity, direction, self.codec, self.server, self.redactor.robot, self.redactor.tenant
        )


class MessageRecorder:
    """Write the messages of connections, and the poses in the answers, with a `RecordingWriter`."""

    def __init__(
        self, writer: RecordingWriter, pseudonyms: Pseudonyms, session: SessionSettings, server: str
    ) -> None:
        self.writer = writer
        self.left_out = 0
        """Number of messages that were left out by `ConnectionRedactor`."""
        self._pseudonyms = pseudonyms
        self._session = session
        self._server = server
        self._codecs: dict[str, Any] = {}

    def open(self, codec: str, robot: RobotId, secrets_: tuple[str, ...] = ()) -> RecordedConnection:
        """Return a new connection of *robot*; messages that contain one of *secrets_* are not recorded."""
        if codec not in self._codecs:
            self._codecs[codec] = make_codec(codec, self._session)
        redactor = ConnectionRedactor(
            self._codecs[codec], robot, self._pseudonyms,
            max_inflated_bytes=self._session.max_inflated_bytes, secrets=secrets_,
        )  # fmt: skip
        identity = secrets.token_hex(_CONNECTION_ID_BYTES)
        return RecordedConnection(redactor, identity=identity, codec=codec, server=self._server)

    def take(self, connection: RecordedConnection, direction: Direction, time_ns: int, data: bytes) -> None:
        """Write a message unless the redactor leaves it out, and the pose of a `pnp` result."""
        redactor = connection.redactor
        stored = redactor.up(data) if direction == "up" else redactor.down(data)
        self._write(connection, direction, time_ns, stored)
        if stored is not None and stored.type == "result" and stored.service == "pnp":
            self._add_pose(
                connection, time_ns, read_answered_pose(stored.text, is_binary=connection.codec == "bin")
            )

    def record_decoded_command(self, connection: RecordedConnection, time_ns: int, data: bytes) -> None:
        """Write the command in *data*, the data of a ``DECODED_COMMAND`` entry."""
        self._write(
            connection, "up", time_ns, connection.redactor.decoded_command(*split_decoded_command(data))
        )

    def record_answer_with_pose(self, connection: RecordedConnection, time_ns: int, data: bytes) -> None:
        """Write the answer and the pose in *data*, the data of an ``ANSWER_WITH_POSE`` entry."""
        identity, pose, message = split_answer_with_pose(data)
        stored = connection.redactor.answer_with_pose(identity, message)
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
        """Remove the channels of a connection after its last message."""
        for channel in connection.channels.values():
            self.writer.forget(channel)

    def event(self, time_ns: int, kind: str, **fields: Any) -> None:
        """Write an event about the recording, such as ``recording-started``, to the channel of events."""
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
    """Record the entries from the pipe of one worker."""

    def __init__(self, recorder: MessageRecorder) -> None:
        """Start without connections."""
        self._recorder = recorder
        self._reader = PipeReader()
        self._connections: dict[int, RecordedConnection] = {}
        self._lost = 0

    def read(self, data: bytes) -> None:
        """Record the entries that are complete after *data*, the next bytes of the pipe."""
        for entry in self._reader.entries(data):
            self._take(entry)

    def end(self) -> None:
        """Close all connections of the worker, which has exited."""
        for connection in self._connections.values():
            self._recorder.close(connection)

    def _take(self, entry: PipeEntry) -> None:
        if entry.kind in _DECODED_KINDS:
            connection = self._connections.get(entry.connection)
            take = (
                self._recorder.record_decoded_command
                if entry.kind == DECODED_COMMAND
                else self._recorder.record_answer_with_pose
            )
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
    """Start a recorder process with *plan* and the random *key* of its pseudonyms; raises OSError.

    Its log lines go to the standard error of this process.
    """
    child = start_child(_CHILD, descriptors=(plan.from_workers,))
    child.say([msgspec.to_builtins(plan), key])
    child.connection.close()  # otherwise workers, which are forked from this process, would inherit it
    return child


def run(server: socket.socket) -> None:
    """Run the recorder process until no worker is left; its plan and key are received from *server*."""
    with server:
        order = receive(server)
    if order is None:
        return
    plan, key = msgspec.convert(order[0], RecorderPlan), order[1]
    session = SessionSettings(**plan.session)
    with suppress(OSError):  # the writer reports why it cannot write
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
    buffer = bytearray(_READ_BYTES)  # one buffer for all reads: allocating it costs more than a message
    view = memoryview(buffer)
    while selector.get_map():
        has_more = False
        for key, _ in selector.select(_FLUSH_INTERVAL_S):
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
            time.sleep(_READ_INTERVAL_S)


def _take_pipes(
    selector: selectors.BaseSelector, from_workers: socket.socket, recorder: MessageRecorder
) -> None:
    """Receive ends of pipes from workers, and read them from now on.

    Once no worker has the other end of *from_workers*, this socket is removed from *selector*.
    """
    try:
        data, fds, _, _ = socket.recv_fds(from_workers, 1, _MAX_RECEIVED_FDS)
    except BlockingIOError:
        return
    except OSError:
        data, fds = b"", []
    for fd in fds:
        selector.register(fd, selectors.EVENT_READ, PipeRecorder(recorder))
    if not data:
        selector.unregister(from_workers)


def _log(server: str, problem: str, dropped: int) -> None:
    """Write a log line in the format of a server: recording stopped by *problem*, or resumed for "".

    *dropped* is the number of messages that were dropped so far.
    """
    line: dict[str, Any] = {"time": time.time(), "level": "warning", "event": "recording-resumed"}
    line |= {"server": server, "dropped": dropped}
    if problem:
        hint = "robots are served on; free some space, or record to another folder"
        line |= {"event": "recording-stopped", "reason": problem, "hint": hint}
    with suppress(OSError):
        os.write(2, json.dumps(line).encode() + b"\n")


def _key(file: str, default: bytes) -> bytes:
    """Return the key of the pseudonyms from *file*; *default* if "" or if the file has no valid key."""
    if file:
        with suppress(OSError):
            key = Path(file).read_bytes()
            if len(key) >= KEY_BYTES:
                return key
    return default
