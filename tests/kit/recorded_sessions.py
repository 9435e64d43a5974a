"""Recordings made by a test: robots that send seeded problems, and a server that answers them."""

from __future__ import annotations

import base64
import dataclasses
import io
import itertools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from rse_pf.config import PlatformSettings
from rse_pf.extensions.recording import file_format
from rse_pf.extensions.recording.writer import RecordingWriter
from rse_pf.pnp.problems import PnpProblem, make_problem
from rse_pf.service import dispatch
from rse_pf.services.builtin import builtin_services
from rse_pf.services.pnp import make_request
from rse_pf.wire import Command, make_codec

__all__ = ["START_NS", "Made", "jpeg"]

START_NS = 1_790_000_000_000_000_000
_PERIOD_NS = 200_000_000


def jpeg(width: int = 160, height: int = 120, *, comment: bytes = b"") -> bytes:
    """Return a picture with a pattern, and a comment in it."""
    rng = np.random.default_rng(3)
    image = Image.fromarray(rng.integers(0, 255, (height, width, 3), dtype=np.uint8))
    file = io.BytesIO()
    image.save(file, format="JPEG", comment=comment)
    return file.getvalue()


class Made:
    """One recording of one server; time passes by 200 ms with every command."""

    def __init__(
        self,
        folder: Path,
        *,
        server: str = "server-1",
        start_ns: int = START_NS,
        side: str = "server",
        settings: PlatformSettings | None = None,
        max_file_bytes: int = 1 << 30,
        edit: Callable[[str, Any], Any] = lambda kind, written: written,
    ) -> None:
        """Begin a recording.

        Args:
            folder: Of its files.
            server: Which records.
            start_ns: Of the first command.
            side: Which end of the connections records.
            settings: Of the solver.
            max_file_bytes: A larger file is followed by another one.
            edit: Returns what is written instead: the bytes of a message ("up", "down"), or the JSON value
                of "frames" and "odometry".
        """
        folder.mkdir(exist_ok=True)
        settings = settings or PlatformSettings()
        self.folder, self.server, self.now_ns = folder, server, start_ns
        self.writer = RecordingWriter(
            folder, server, started_ns=start_ns, max_file_bytes=max_file_bytes, max_bytes=1 << 40,
            metadata={
                "version": "9.9.9",
                "side": side, "engine": settings.pnp.engine,
                "pnp": json.dumps(dataclasses.asdict(settings.pnp)),
            },
        )  # fmt: skip
        self._edit = edit
        self._registry = builtin_services(settings)
        self._channels: dict[tuple[int, str, str], int] = {}
        self._ids = itertools.count()

    def send(
        self,
        problem: PnpProblem | int,
        *,
        robot: int = 0,
        codec: str = "bin",
        took_ns: int = 3_000_000,
        answer: Any = None,
        is_answered: bool = True,
        thumbnail: bytes | None = None,
        T_odom_camera: Any = None,
        **fields: Any,
    ) -> str:
        """Record a command of *problem*, or of the one with that seed, and its answer; return its id."""
        if isinstance(problem, int):
            problem = make_problem(seed=problem, n=60)
        payload = make_request(problem.points_world, problem.pixels, problem.camera, binary=codec == "bin")
        identity = next(self._ids)
        fields = {"service": "pnp", "payload": payload, **fields}
        command = make_codec(codec).encode(Command(id=identity, **fields))
        self.now_ns += _PERIOD_NS
        name = f"{robot:016x}:{identity}"
        if thumbnail is not None:
            self._json(file_format.FRAMES_PREFIX, file_format.IMAGE_SCHEMA, robot, {
                "timestamp": {"sec": 0, "nsec": 0}, "frame_id": "camera", "format": "jpeg",
                "data": base64.b64encode(thumbnail).decode(),
            })  # fmt: skip
        if T_odom_camera is not None:
            self._json(file_format.ODOMETRY_PREFIX, file_format.ODOMETRY_SCHEMA, robot, {
                "command": name, "number": identity, "timestamp_s": self.now_ns / 1e9 - 0.01,
                "T_odom_camera": np.asarray(T_odom_camera).ravel().tolist(),
            })  # fmt: skip
        self.writer.add(self._channel(robot, "up", codec), self.now_ns, self._edit("up", command))
        if is_answered:
            codecs = make_codec(codec)
            message = codecs.decode_from_robot(command)
            assert isinstance(message, Command)
            clock = itertools.count(100.0).__next__
            answered = answer or dispatch(self._registry, message, clock, server=self.server, received_s=99.5)
            reply = self._edit("down", codecs.encode(answered))
            self.writer.add(self._channel(robot, "down", codec), self.now_ns + took_ns, reply)
        self.writer.flush(self.now_ns)
        return name

    def close(self) -> Path:
        """Finish the recording and return its folder."""
        self.writer.close()
        return self.folder

    def file(self) -> Path:
        """Finish the recording and return its only file."""
        self.writer.close()
        (path,) = self.folder.glob("*.mcap")
        return path

    def _json(self, prefix: str, schema: str, robot: int, value: object) -> None:
        kind = "frames" if prefix == file_format.FRAMES_PREFIX else "odometry"
        self.writer.add_json(f"{prefix}robot-{robot:08x}", schema, self.now_ns, self._edit(kind, value))

    def _channel(self, robot: int, direction: file_format.Direction, codec: str) -> int:
        key = robot, direction, codec
        if key not in self._channels:
            connection = f"{robot:016x}"
            wire = file_format.WireChannel(
                connection, direction, codec, self.server, f"robot-{robot:08x}", "tenant-00000000"
            )
            self._channels[key] = self.writer.channel(
                file_format.wire_topic(connection, direction), file_format.WIRE_ENCODING,
                file_format.wire_metadata(wire),
            )  # fmt: skip
        return self._channels[key]
