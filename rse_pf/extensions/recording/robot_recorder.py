"""Record a robot: its messages, thumbnails of its frames, its odometry, and the points of its maps.

The robot puts entries into a bounded queue, and a thread writes them into a folder.  Entries that do not fit
are dropped and counted, so that a slow or full disk never delays the robot.
"""

from __future__ import annotations

import asyncio
import base64
import importlib.util
import json
import queue
import secrets
import threading
import time
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from rse_pf.config import RecordingSettings, SessionSettings
from rse_pf.errors import MissingExtra, RsePfError
from rse_pf.extensions.recording.file_format import (
    FRAMES_PREFIX,
    IMAGE_SCHEMA,
    MAP_TOPIC,
    ODOMETRY_PREFIX,
    ODOMETRY_SCHEMA,
    POINTS_SCHEMA,
    Direction,
)
from rse_pf.extensions.recording.poses import image, point_cloud
from rse_pf.extensions.recording.recorder_process import MessageRecorder, RecordedConnection
from rse_pf.extensions.recording.redact import KEY_BYTES, Pseudonyms
from rse_pf.extensions.recording.writer import RecordingWriter, make_folder
from rse_pf.identity import DEFAULT_TENANT, RobotId
from rse_pf.wire import PROTOCOL_VERSION, Codec, Welcome

__all__ = ["RobotRecorder"]

MAX_QUEUED_ENTRIES = 2000
"""Largest number of entries that wait for the thread: bounds the memory when the disk is slow."""
FLUSH_INTERVAL_S = 0.2
"""Longest time, seconds, between two calls of `RecordingWriter.flush`: a crash then loses little."""
STOP_TIMEOUT_S = 5.0
"""Longest time, seconds, that `RobotRecorder.stop` waits until the thread has written the queued entries."""
MAX_MESSAGES_BEFORE_WELCOME = 16
"""Messages of a connection that are kept until its Welcome names the robot; further ones are not recorded."""
THUMBNAIL_WIDTH_PX = 160  # largest width of a recorded thumbnail
JPEG_QUALITY = 70
"""Quality of thumbnails (0..95 of Pillow): small files in which people still recognise the scene."""
MAX_MAP_POINTS = 100_000
"""Most points of a map that are recorded, so that one map does not fill the recording."""


class _MessageEntry(NamedTuple):
    connection: int
    direction: Direction
    time_ns: int
    data: bytes


class _OpenEntry(NamedTuple):
    connection: int
    codec: Codec
    token: str


class _CloseEntry(NamedTuple):
    connection: int


class _FrameEntry(NamedTuple):
    """A frame: Unix time (ns), number, time by the robot's clock, small image, odometry pose (row-major)."""

    time_ns: int
    number: int
    timestamp_s: float
    rgb: npt.NDArray[np.uint8] | None
    T_odom_camera: Sequence[float] | None


class _MapEntry(NamedTuple):
    time_ns: int
    points: bytes


# An entry of the queue of the recorder.
_Entry = _MessageEntry | _OpenEntry | _CloseEntry | _FrameEntry | _MapEntry


class _Connection:
    """A connection: its messages until a Welcome names the robot, and its channels in the file from then on.

    ``recorded`` is None until that Welcome.
    """

    def __init__(self, entry: _OpenEntry) -> None:
        self.codec = entry.codec
        self.token = entry.token
        self.before_welcome: list[_MessageEntry] = []
        self.recorded: RecordedConnection | None = None


class RobotRecorder:
    """Record one robot into files; implements `client_sdk.recording.RobotRecorder`."""

    def __init__(
        self, folder: str | Path, *, thumbnails: bool, session: SessionSettings, version: str = ""
    ) -> None:
        """Describe the recording; `start` begins it.

        Args:
            folder: Folder for the files, which is created if it is missing.
            thumbnails: Whether images of frames are recorded, at most 160 px wide.
            session: Limits of messages.
            version: Version of the robot's software, which is written into the recording.
        """
        self.dropped = 0
        """Number of messages, frames and maps that were not recorded because the queue was full."""
        self.thumbnails = thumbnails
        self._folder = Path(folder)
        self._session = session
        self._version = version
        self._queue: queue.Queue[_Entry | None] = queue.Queue(MAX_QUEUED_ENTRIES)
        self._thread: threading.Thread | None = None
        self._connections = 0
        self._frames = 0

    def start(self) -> None:
        """Create the folder, and start the thread that writes the files.

        Raises:
            MissingExtra: The package mcap, or Pillow for thumbnails, is not installed.
            UsageError: Files cannot be written into the folder.
        """
        if importlib.util.find_spec("mcap") is None:
            raise MissingExtra("mcap", "vision")
        if self.thumbnails and importlib.util.find_spec("PIL") is None:
            raise MissingExtra("pillow", "local")
        folder = make_folder(self._folder)
        self._thread = threading.Thread(target=self._run, args=(folder,), name="recorder", daemon=True)
        self._thread.start()

    async def stop(self) -> None:
        """Write the queued entries and finish the file; give up after five seconds."""
        thread, self._thread = self._thread, None
        if thread is not None:
            await asyncio.to_thread(self._finish, thread)

    def _finish(self, thread: threading.Thread) -> None:
        self._queue.put(None)
        thread.join(STOP_TIMEOUT_S)

    def open_connection(self, codec: Codec, token: str | None) -> int:
        """Return the number of a new connection; messages that contain *token* are not recorded."""
        self._connections += 1
        self._enqueue(_OpenEntry(self._connections, codec, token or ""))
        return self._connections

    def observe_message(self, connection: int, direction: Direction, data: bytes) -> None:
        """Record the bytes of one message of *connection*, ``up`` to or ``down`` from the server."""
        self._enqueue(_MessageEntry(connection, direction, time.time_ns(), data))

    def close_connection(self, connection: int) -> None:
        """Record that *connection* has ended."""
        self._enqueue(_CloseEntry(connection))

    def record_frame(
        self,
        timestamp_s: float,
        rgb: npt.NDArray[np.uint8] | None = None,
        T_odom_camera: npt.NDArray[np.float64] | None = None,
    ) -> None:
        """Record a frame; a frame without thumbnail and odometry is only counted.

        Args:
            timestamp_s: Time of the frame by the robot's clock.
            rgb: ``(h, w, 3)``, of which a thumbnail is recorded if thumbnails are on; None without an image.
            T_odom_camera: ``(4, 4)``, from the camera frame to the odometry frame, metres; None if unknown.
        """
        self._frames += 1
        small = None if rgb is None or not self.thumbnails else _subsample(rgb)
        pose = None if T_odom_camera is None else np.asarray(T_odom_camera, dtype=float).reshape(16).tolist()
        if small is not None or pose is not None:
            self._enqueue(_FrameEntry(time.time_ns(), self._frames, timestamp_s, small, pose))

    def record_map(self, points: npt.NDArray[np.float32]) -> None:
        """Record the points of a map, ``(n, 3)``, metres, evenly thinned to at most 100,000."""
        thinned = points[:: 1 + len(points) // MAX_MAP_POINTS]
        self._enqueue(_MapEntry(time.time_ns(), thinned.astype("<f4").tobytes()))

    def _enqueue(self, entry: _Entry) -> None:
        if self._thread is None:
            return
        try:
            self._queue.put_nowait(entry)
        except queue.Full:
            self.dropped += 1

    def _run(self, folder: Path) -> None:
        """Write the entries of the queue until `stop`; this is the thread's function."""
        writer = RecordingWriter(
            folder,
            "robot",
            started_ns=time.time_ns(),
            max_bytes=RecordingSettings().max_bytes,
            metadata={"side": "robot", "protocol": str(PROTOCOL_VERSION), "version": self._version},
        )
        pseudonyms = Pseudonyms(secrets.token_bytes(KEY_BYTES))
        entries = _EntryWriter(MessageRecorder(writer, pseudonyms, self._session, ""))
        while True:
            try:
                entry = self._queue.get(timeout=FLUSH_INTERVAL_S)
                if entry is None:
                    break
                entries.write(entry)
            except queue.Empty:
                pass
            writer.flush(time.time_ns())
        entries.write_end(time.time_ns())
        writer.close()


class _EntryWriter:
    """Write entries into the recording, in the thread of the recorder."""

    def __init__(self, recorder: MessageRecorder) -> None:
        self._recorder = recorder
        self._connections: dict[int, _Connection] = {}
        self._robot = "robot"

    def write(self, entry: _Entry) -> None:
        if isinstance(entry, _MessageEntry):
            self._write_message(entry)
        elif isinstance(entry, _OpenEntry):
            self._connections[entry.connection] = _Connection(entry)
        elif isinstance(entry, _FrameEntry):
            self._write_frame(entry)
        elif isinstance(entry, _MapEntry):
            cloud = point_cloud(entry.points, entry.time_ns)
            self._recorder.writer.add_json(MAP_TOPIC, POINTS_SCHEMA, entry.time_ns, cloud)
        else:
            connection = self._connections.pop(entry.connection, None)
            if connection is not None and connection.recorded is not None:
                self._recorder.close(connection.recorded)

    def write_end(self, now_ns: int) -> None:
        self._recorder.event(now_ns, "recording-over", left_out=self._recorder.left_out)

    def _write_message(self, message: _MessageEntry) -> None:
        connection = self._connections.get(message.connection)
        if connection is None:
            return
        if connection.recorded is not None:
            self._recorder.take(connection.recorded, message.direction, message.time_ns, message.data)
        elif len(connection.before_welcome) < MAX_MESSAGES_BEFORE_WELCOME:
            connection.before_welcome.append(message)
            if message.direction == "down":
                self._read_welcome(connection, message.data)

    def _read_welcome(self, connection: _Connection, data: bytes) -> None:
        """Begin to record *connection* if *data* is its Welcome, which names the robot.

        The tenant of the robot is read from the token; names are recorded as pseudonyms.
        """
        try:
            welcome = connection.codec.decode_from_server(data)
        except RsePfError:
            return
        if not isinstance(welcome, Welcome):
            return
        robot = RobotId(_tenant_in_token(connection.token), welcome.robot)
        recorded = self._recorder.open(connection.codec.name, robot, (connection.token,))
        recorded.server = welcome.server
        connection.recorded = recorded
        self._robot = recorded.redactor.robot
        messages, connection.before_welcome = connection.before_welcome, []
        for message in messages:
            self._recorder.take(recorded, message.direction, message.time_ns, message.data)

    def _write_frame(self, frame: _FrameEntry) -> None:
        writer = self._recorder.writer
        if frame.rgb is not None:
            image_message = image(_encode_thumbnail(frame.rgb), frame.time_ns)
            writer.add_json(f"{FRAMES_PREFIX}{self._robot}", IMAGE_SCHEMA, frame.time_ns, image_message)
        if frame.T_odom_camera is not None:
            odometry = {
                "number": frame.number,
                "timestamp_s": frame.timestamp_s,
                "T_odom_camera": frame.T_odom_camera,
            }
            writer.add_json(f"{ODOMETRY_PREFIX}{self._robot}", ODOMETRY_SCHEMA, frame.time_ns, odometry)


def _subsample(rgb: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Return a copy of every n-th pixel, at least twice as wide as a thumbnail unless *rgb* is narrower."""
    step = max(1, rgb.shape[1] // (2 * THUMBNAIL_WIDTH_PX))
    return np.ascontiguousarray(rgb[::step, ::step])


def _encode_thumbnail(rgb: npt.NDArray[np.uint8]) -> bytes:
    """Return *rgb* as a JPEG that is at most `THUMBNAIL_WIDTH_PX` wide."""
    from PIL import Image

    picture = Image.fromarray(rgb)
    picture.thumbnail((THUMBNAIL_WIDTH_PX, 10 * THUMBNAIL_WIDTH_PX))
    encoded = BytesIO()
    picture.save(encoded, "JPEG", quality=JPEG_QUALITY)
    return encoded.getvalue()


def _tenant_in_token(token: str) -> str:
    """Return the tenant that an unverified token names, the default tenant if it names none."""
    try:
        body = token.split(".")[1]
        claims: Any = json.loads(base64.urlsafe_b64decode(body + "=" * (-len(body) % 4)))
        return str(claims.get("tenant", DEFAULT_TENANT))
    except (IndexError, ValueError, AttributeError):
        return DEFAULT_TENANT
