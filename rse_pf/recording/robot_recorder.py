"""The recording of a robot: what it said and heard, thumbnails of its frames and its odometry, in a folder.

A thread writes; the robot only puts bytes into a bounded queue, and what does not fit is dropped and counted.
A disk that is full costs the recording, never a pose.
"""

from __future__ import annotations

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
from rse_pf.identity import DEFAULT_TENANT, RobotId
from rse_pf.recording.file_format import (
    FRAMES_PREFIX,
    IMAGE_SCHEMA,
    MAP_TOPIC,
    ODOMETRY_PREFIX,
    ODOMETRY_SCHEMA,
    POINTS_SCHEMA,
    Direction,
)
from rse_pf.recording.poses import image, point_cloud
from rse_pf.recording.recorder_process import MessageRecorder, RecordedConnection
from rse_pf.recording.redact import KEY_BYTES, Pseudonyms
from rse_pf.recording.writer import RecordingWriter, make_folder
from rse_pf.wire import PROTOCOL_VERSION, Codec, Welcome

__all__ = ["RobotRecorder"]

_MAX_WAITING = 2000
_FLUSH_S = 0.2
_END_S = 5.0
_MAX_UNNAMED = 16
_THUMBNAIL_PX = 160
_JPEG_QUALITY = 70
_MAX_POINTS = 100_000


class _Said(NamedTuple):
    connection: int
    direction: Direction
    time_ns: int
    data: bytes


class _Opened(NamedTuple):
    connection: int
    codec: Codec
    token: str


class _Closed(NamedTuple):
    connection: int


class _Seen(NamedTuple):
    """A frame: its number, the robot's time of it, a small picture, and where odometry says that it was."""

    time_ns: int
    number: int
    timestamp_s: float
    rgb: npt.NDArray[np.uint8] | None
    T_odom_camera: Sequence[float] | None


class _Mapped(NamedTuple):
    time_ns: int
    points: bytes


_Entry = _Said | _Opened | _Closed | _Seen | _Mapped


class _Connection:
    """A connection before and after its Welcome, which names the robot."""

    def __init__(self, opened: _Opened) -> None:
        self.opened = opened
        self.unnamed: list[_Said] = []
        self.recorded: RecordedConnection | None = None


class RobotRecorder:
    """Records one robot between `start` and `stop`."""

    def __init__(
        self, folder: str | Path, *, thumbnails: bool, session: SessionSettings, version: str = ""
    ) -> None:
        """Record nothing yet.

        Args:
            folder: For the files; made if it is missing.
            thumbnails: Whether pictures of frames are recorded, at most 160 px wide.
            session: Limits of messages.
            version: Of the robot's software.
        """
        self.dropped = 0
        """Messages and frames that were dropped, because the disk is too slow."""
        self.thumbnails = thumbnails
        self._folder = Path(folder)
        self._session = session
        self._version = version
        self._waiting: queue.Queue[_Entry | None] = queue.Queue(_MAX_WAITING)
        self._thread: threading.Thread | None = None
        self._connections = self._frames = 0

    def start(self) -> None:
        """Begin to record.

        Raises:
            MissingExtra: mcap, or Pillow for thumbnails, is not installed.
            UsageError: Recordings cannot be written there.
        """
        if importlib.util.find_spec("mcap") is None:
            raise MissingExtra("mcap", "vision")
        if self.thumbnails and importlib.util.find_spec("PIL") is None:
            raise MissingExtra("pillow", "local")
        folder = make_folder(self._folder)
        self._thread = threading.Thread(target=self._run, args=(folder,), name="recorder", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Finish the file; what waits is written first."""
        thread, self._thread = self._thread, None
        if thread is not None:
            self._waiting.put(None)
            thread.join(_END_S)

    def opened(self, codec: Codec, token: str | None) -> int:
        """Return the number of a new connection; no message that holds *token* is recorded."""
        self._connections += 1
        self._enqueue(_Opened(self._connections, codec, token or ""))
        return self._connections

    def said(self, connection: int, direction: Direction, data: bytes) -> None:
        """Record a message of *connection*."""
        self._enqueue(_Said(connection, direction, time.time_ns(), data))

    def closed(self, connection: int) -> None:
        """Take that *connection* is over."""
        self._enqueue(_Closed(connection))

    def frame(
        self,
        timestamp_s: float,
        rgb: npt.NDArray[np.uint8] | None = None,
        T_odom_camera: npt.NDArray[np.float64] | None = None,
    ) -> None:
        """Record a thumbnail of an image ``(h, w, 3)``, if allowed, and a pose ``(4, 4)`` by odometry."""
        self._frames += 1
        small = None if rgb is None or not self.thumbnails else _small(rgb)
        pose = None if T_odom_camera is None else np.asarray(T_odom_camera, dtype=float).reshape(16).tolist()
        if small is not None or pose is not None:
            self._enqueue(_Seen(time.time_ns(), self._frames, timestamp_s, small, pose))

    def map(self, points: npt.NDArray[np.float32]) -> None:
        """Record the ``(n, 3)`` points of a map, metres; of more than 100,000 every so-many-th."""
        thinned = points[:: 1 + len(points) // _MAX_POINTS]
        self._enqueue(_Mapped(time.time_ns(), thinned.astype("<f4").tobytes()))

    def _enqueue(self, entry: _Entry) -> None:
        if self._thread is None:
            return
        try:
            self._waiting.put_nowait(entry)
        except queue.Full:
            self.dropped += 1

    def _run(self, folder: Path) -> None:
        """Write until `stop`, in a thread."""
        bounds = RecordingSettings()
        writer = RecordingWriter(
            folder, "robot", started_ns=time.time_ns(),
            max_bytes=bounds.max_bytes,
            metadata={"side": "robot", "protocol": str(PROTOCOL_VERSION), "version": self._version},
        )  # fmt: skip
        thread = _Thread(
            MessageRecorder(writer, Pseudonyms(secrets.token_bytes(KEY_BYTES)), self._session, "")
        )
        while True:
            try:
                entry = self._waiting.get(timeout=_FLUSH_S)
                if entry is None:
                    break
                thread.take(entry)
            except queue.Empty:
                pass
            writer.flush(time.time_ns())
        thread.end(time.time_ns())
        writer.close()


class _Thread:
    """What the thread of a recorder knows."""

    def __init__(self, recorder: MessageRecorder) -> None:
        self._recorder = recorder
        self._connections: dict[int, _Connection] = {}
        self._robot = "robot"

    def take(self, entry: _Entry) -> None:
        if isinstance(entry, _Said):
            self._said(entry)
        elif isinstance(entry, _Opened):
            self._connections[entry.connection] = _Connection(entry)
        elif isinstance(entry, _Seen):
            self._record_image(entry)
        elif isinstance(entry, _Mapped):
            cloud = point_cloud(entry.points, entry.time_ns)
            self._recorder.writer.add_json(MAP_TOPIC, POINTS_SCHEMA, entry.time_ns, cloud)
        else:
            connection = self._connections.pop(entry.connection, None)
            if connection is not None and connection.recorded is not None:
                self._recorder.close(connection.recorded)

    def end(self, now_ns: int) -> None:
        self._recorder.event(now_ns, "recording-over", left_out=self._recorder.left_out)

    def _said(self, said: _Said) -> None:
        connection = self._connections.get(said.connection)
        if connection is None:
            return
        if connection.recorded is not None:
            self._recorder.take(connection.recorded, said.direction, said.time_ns, said.data)
        elif len(connection.unnamed) < _MAX_UNNAMED:
            connection.unnamed.append(said)
            if said.direction == "down":
                self._name(connection, said.data)

    def _name(self, connection: _Connection, data: bytes) -> None:
        """Take who the robot is from a Welcome; its tenant is in the token."""
        opened = connection.opened
        try:
            welcome = opened.codec.decode_from_server(data)
        except RsePfError:
            return
        if not isinstance(welcome, Welcome):
            return
        robot = RobotId(_tenant(opened.token), welcome.robot)
        made = connection.recorded = self._recorder.open(opened.codec.name, robot, (opened.token,))
        made.server = welcome.server
        self._robot = made.redactor.robot
        unnamed, connection.unnamed = connection.unnamed, []
        for said in unnamed:
            self._recorder.take(made, said.direction, said.time_ns, said.data)

    def _record_image(self, seen: _Seen) -> None:
        writer = self._recorder.writer
        if seen.rgb is not None:
            image_message = image(_jpeg(seen.rgb), seen.time_ns)
            writer.add_json(f"{FRAMES_PREFIX}{self._robot}", IMAGE_SCHEMA, seen.time_ns, image_message)
        if seen.T_odom_camera is not None:
            value = {
                "number": seen.number,
                "timestamp_s": seen.timestamp_s,
                "T_odom_camera": seen.T_odom_camera,
            }
            writer.add_json(f"{ODOMETRY_PREFIX}{self._robot}", ODOMETRY_SCHEMA, seen.time_ns, value)


def _small(rgb: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Return a copy with every so-many-th pixel: at most twice the width of a thumbnail."""
    step = max(1, rgb.shape[1] // (2 * _THUMBNAIL_PX))
    return np.ascontiguousarray(rgb[::step, ::step])


def _jpeg(rgb: npt.NDArray[np.uint8]) -> bytes:
    from PIL import Image

    picture = Image.fromarray(rgb)
    picture.thumbnail((_THUMBNAIL_PX, 10 * _THUMBNAIL_PX))
    written = BytesIO()
    picture.save(written, "JPEG", quality=_JPEG_QUALITY)
    return written.getvalue()


def _tenant(token: str) -> str:
    """Return the tenant that a token names, without judging the token."""
    try:
        body = token.split(".")[1]
        claims: Any = json.loads(base64.urlsafe_b64decode(body + "=" * (-len(body) % 4)))
        return str(claims.get("tenant", DEFAULT_TENANT))
    except (IndexError, ValueError, AttributeError):
        return DEFAULT_TENANT
