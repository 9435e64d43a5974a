"""The format of a recording: names of files, channels, encodings and schemas, and how to parse them.

A recording is one or more MCAP files.  This module neither reads nor writes files.

Source:
    MCAP specification, version 0 (mcap.dev/spec); Foxglove's message schemas (docs.foxglove.dev).
"""

from __future__ import annotations

import json
import re
from datetime import datetime, timezone
from typing import Any, Final, Literal, NamedTuple

import msgspec

__all__ = [
    "EVENTS_TOPIC", "EVENT_SCHEMA", "FORMAT_VERSION", "FRAMES_PREFIX", "IMAGE_SCHEMA", "JSON_ENCODING",
    "JSON_SCHEMA_ENCODING", "LIBRARY", "MAP_TOPIC", "METADATA_NAME", "ODOMETRY_PREFIX", "ODOMETRY_SCHEMA",
    "POINTS_SCHEMA", "POSES_PREFIX", "POSE_SCHEMA", "PROFILE", "SAMPLES_TOPIC", "SAMPLE_SCHEMA", "SCHEMAS",
    "SUFFIX", "WIRE_ENCODING", "Direction", "FileName", "WireChannel", "encode_json", "wire_channel",
    "wire_metadata", "wire_topic",
]  # fmt: skip

PROFILE: Final = "rse-pf"
"""The profile in the header of every file of a recording."""
LIBRARY: Final = "rse-pf"
"""Name of the library in the header of a file; a space and the version of the software follow."""
FORMAT_VERSION: Final = 1
"""Version of the format that this module describes; a reader rejects files with a higher one."""
METADATA_NAME: Final = "rse_pf"
"""Name of the metadata record at the start of every file; its values are strings."""
SUFFIX: Final = ".mcap"  # ending of the names of files

WIRE_ENCODING: Final = "rse-pf-wire"
"""Message encoding of the channels that hold the bytes of WebSocket messages as they were sent."""
# Message encoding of the channels with JSON messages.
JSON_ENCODING: Final = "json"
# Encoding of the schemas of JSON messages.
JSON_SCHEMA_ENCODING: Final = "jsonschema"

EVENTS_TOPIC: Final = "/platform/events"  # events of the platform, and of the recorder itself
SAMPLES_TOPIC: Final = "/platform/samples"  # samples of the platform's monitor
POSES_PREFIX: Final = "/poses/"  # poses in the answers to a robot, whose pseudonym follows
FRAMES_PREFIX: Final = "/frames/"  # thumbnails of a robot's frames; its pseudonym follows
ODOMETRY_PREFIX: Final = "/odometry/"  # odometry poses of a robot's frames; its pseudonym follows
MAP_TOPIC: Final = "/map"  # points of the maps of a robot

# Names of the schemas of JSON messages.
EVENT_SCHEMA: Final = "rse_pf.Event"
SAMPLE_SCHEMA: Final = "rse_pf.Sample"
ODOMETRY_SCHEMA: Final = "rse_pf.Odometry"
POSE_SCHEMA: Final = "foxglove.PoseInFrame"
POINTS_SCHEMA: Final = "foxglove.PointCloud"
IMAGE_SCHEMA: Final = "foxglove.CompressedImage"

Direction = Literal["up", "down"]
"""Direction of a message: ``up`` from the robot to the server, ``down`` from the server to the robot."""

_WIRE_TOPIC = re.compile(r"/wire/([0-9a-f]{16})/(up|down)")  # topic of a channel: connection and direction
_FILE_NAME = re.compile(
    r"(\d{8}T\d{6}Z)-(.+)-(\d{4,})"
)  # name of a file without its suffix: start, server, number
# Characters of a server's name that are replaced in the name of a file.
_REPLACED_CHARACTERS = re.compile(r"[^A-Za-z0-9_.-]")
_MAX_SERVER_LETTERS = 64  # largest number of characters of a server's name in a file name
_TIME_FORMAT = "%Y%m%dT%H%M%SZ"  # format of the start of the recorder in a file name, UTC


class WireChannel(NamedTuple):
    """The description of a channel that holds the messages of one connection in one direction.

    Attributes:
        connection: Random identifier of the connection, 16 hex digits; the same for both directions.
        direction: ``up`` or ``down``.
        codec: Codec of the connection: ``zlib``, ``json`` or ``bin``.
        server: Identifier of the server; "" if it is not known.
        robot: Pseudonym ``robot-XXXXXXXX``, the same for all connections of a robot in one recording.
        tenant: Pseudonym ``tenant-XXXXXXXX``.
    """

    connection: str
    direction: Direction
    codec: str
    server: str
    robot: str
    tenant: str


class FileName(NamedTuple):
    """The parts of the name of a file: start of the recorder, name of the server, and number of the file."""

    started: datetime
    server: str
    number: int

    def __str__(self) -> str:
        """Return the name with its suffix, ``START-SERVER-NNNN.mcap``, START in UTC."""
        started = self.started.astimezone(timezone.utc).strftime(_TIME_FORMAT)
        server = _REPLACED_CHARACTERS.sub("_", self.server)[:_MAX_SERVER_LETTERS] or "_"
        return f"{started}-{server}-{self.number:04d}{SUFFIX}"

    @classmethod
    def parse(cls, name: str) -> FileName | None:
        """Return the parts of the file name *name*; None if it is not the name of a recording."""
        match = _FILE_NAME.fullmatch(name.removesuffix(SUFFIX)) if name.endswith(SUFFIX) else None
        if match is None:
            return None
        try:
            started = datetime.strptime(match[1], _TIME_FORMAT).replace(tzinfo=timezone.utc)
        except ValueError:
            return None
        return cls(started, match[2], int(match[3]))


def wire_topic(connection: str, direction: Direction) -> str:
    """Return the topic of one direction of a *connection* (16 hex digits)."""
    return f"/wire/{connection}/{direction}"


def wire_metadata(channel: WireChannel) -> dict[str, str]:
    """Return the metadata of a channel; its topic holds connection and direction, see `wire_topic`."""
    return {
        "codec": channel.codec,
        "server": channel.server,
        "robot": channel.robot,
        "tenant": channel.tenant,
    }


def wire_channel(topic: str, metadata: dict[str, str]) -> WireChannel | None:
    """Return the description in *topic* and *metadata*; None if the channel holds no wire messages."""
    match = _WIRE_TOPIC.fullmatch(topic)
    if match is None:
        return None
    direction: Direction = "up" if match[2] == "up" else "down"
    codec, server = metadata.get("codec", ""), metadata.get("server", "")
    robot, tenant = metadata.get("robot", ""), metadata.get("tenant", "")
    return WireChannel(match[1], direction, codec, server, robot, tenant)


def _schema(title: str, **properties: Any) -> bytes:
    """Return the encoded JSON schema of an object with these properties."""
    return json.dumps({"title": title, "type": "object", "properties": properties}).encode()


def _object(**properties: Any) -> dict[str, Any]:
    return {"type": "object", "properties": properties}


# Parts of JSON schemas.
_NUMBER: Final = {"type": "number"}
_INTEGER: Final = {"type": "integer"}
_TEXT: Final = {"type": "string"}
_BYTES: Final = {"type": "string", "contentEncoding": "base64"}
_TIME: Final = _object(sec=_INTEGER, nsec=_INTEGER)
_POSE: Final = _object(
    position=_object(x=_NUMBER, y=_NUMBER, z=_NUMBER),
    orientation=_object(x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER),
)
_FIELD: Final = _object(name=_TEXT, offset=_INTEGER, type=_INTEGER)

SCHEMAS: Final[dict[str, bytes]] = {
    EVENT_SCHEMA: _schema(EVENT_SCHEMA, time_s=_NUMBER, kind=_TEXT),
    SAMPLE_SCHEMA: _schema(SAMPLE_SCHEMA, time_s=_NUMBER),
    ODOMETRY_SCHEMA: _schema(
        ODOMETRY_SCHEMA,
        number=_INTEGER,
        timestamp_s=_NUMBER,
        T_odom_camera={"type": "array", "items": _NUMBER, "minItems": 16, "maxItems": 16},
    ),
    POSE_SCHEMA: _schema(POSE_SCHEMA, timestamp=_TIME, frame_id=_TEXT, pose=_POSE),
    POINTS_SCHEMA: _schema(
        POINTS_SCHEMA,
        timestamp=_TIME,
        frame_id=_TEXT,
        pose=_POSE,
        point_stride=_INTEGER,
        fields={"type": "array", "items": _FIELD},
        data=_BYTES,
    ),
    IMAGE_SCHEMA: _schema(IMAGE_SCHEMA, timestamp=_TIME, frame_id=_TEXT, data=_BYTES, format=_TEXT),
}
"""The JSON schemas of all channels with the encoding `JSON_ENCODING`, by name of the schema."""


def encode_json(value: Any) -> bytes:
    """Encode *value* for a JSON channel; objects that JSON cannot hold are written as ``str(object)``."""
    return msgspec.json.encode(value, enc_hook=str)
