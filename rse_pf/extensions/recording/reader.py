"""Read a recording: the commands of robots with their answers, in the order of the answers.

A recording is a file, or a folder of files that are read in the order of their times.  A truncated file is
read up to its last complete chunk.  Files are untrusted input: sizes are checked before anything is
decompressed or decoded.  This module neither solves commands nor writes files.
"""

from __future__ import annotations

import base64
import binascii
import heapq
import importlib
import itertools
import os
import re
import struct
import zlib
from collections import OrderedDict, deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple, cast

import msgspec
import numpy as np

from rse_pf.config import SessionSettings
from rse_pf.errors import BadMessage, BadRequest, LimitExceeded, RsePfError, UnsupportedProtocol, UsageError
from rse_pf.extensions.recording import file_format
from rse_pf.extensions.recording.summary import ChunkPlan, Wanted, plan_of, robot_of
from rse_pf.geometry import Array
from rse_pf.limits.budget import Budget, check_size, inflate_within
from rse_pf.wire import CODECS, Codec, Command, Failure, Result, make_codec

__all__ = [
    "Odometry", "RecordedCommand", "WireRecording", "open_recording", "recording_files",
]  # fmt: skip

_MAGIC = b"\x89MCAP0\r\n"  # first bytes of an MCAP file
_MAX_RECORD_BYTES = 64 << 20  # largest MCAP record that is read: bounds the memory for a malformed file
_MAX_CHUNK_BYTES = 32 << 20
"""Largest uncompressed size of a chunk that is read.  Writers close a chunk once it exceeds 1 MiB, so that it
holds at most 1 MiB and one message."""
_MAX_WAITING = 4096
"""Largest number of commands that wait for their answers in memory; beyond it the oldest counts as
unanswered."""
_MAX_CONNECTIONS = 100_000  # largest number of channels of a file, and of robots with images: bounds memory
_MAX_STREAMS = 128
"""Largest number of recorders whose files are merged by time, which opens a file of each; beyond it all files
are read one after another."""
_MAX_KEPT_IMAGES = 32
"""Number of thumbnails, and of odometry poses, of each robot that are kept while reading, the newest ones:
those of a command are searched among them."""
_MAX_IMAGE_AGE_NS = 500_000_000  # largest age, ns, of the thumbnail or odometry that belongs to a command
_DAMAGE = (struct.error, ValueError, OverflowError)
"""Exceptions that the library `mcap` raises for malformed records, in addition to McapError."""
_COMMAND_ID = re.compile(r"[0-9a-f]{16}:\d{1,16}")  # ``CONNECTION:ID``


class Odometry(msgspec.Struct, frozen=True, kw_only=True):
    """The odometry pose ``T_odom_camera`` ``(4, 4)``, metres, of a frame.

    ``number`` is the number of the frame, ``timestamp_s`` its time by the robot's clock.
    """

    number: int
    timestamp_s: float
    T_odom_camera: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class RecordedCommand:
    """A recorded command and its answer, encoded as they were sent.

    Attributes:
        id: ``CONNECTION:ID``: the random identifier of the connection, and the id of the command on it.
        robot: Pseudonym of the robot.
        tenant: Pseudonym of its tenant.
        server: Name of the server; "" if it is not known.
        codec: Codec of the messages: ``zlib``, ``json`` or ``bin``.
        service: Name of the service that the command asks.
        sent_ns: Unix time, ns, at which the command was recorded.
        command_bytes: The message of the command.
        answered_ns: Unix time, ns, at which the answer was recorded; None without an answer.
        reply_bytes: The message of the answer; None without an answer.
        thumbnail: A small JPEG of the camera image; None if none was recorded.
        odometry: The odometry pose of the frame; None if none was recorded.
        about: Metadata of the file, such as ``version``, ``side`` (``server`` or ``robot``) and ``engine``.
        session: Limits of messages that apply when the command or its answer is decoded.
    """

    id: str
    robot: str
    tenant: str
    server: str
    codec: str
    service: str
    sent_ns: int
    command_bytes: bytes
    answered_ns: int | None = None
    reply_bytes: bytes | None = None
    thumbnail: bytes | None = None
    odometry: Odometry | None = None
    about: Mapping[str, str] = field(default_factory=dict, repr=False)
    session: SessionSettings = field(default_factory=SessionSettings, repr=False)

    @property
    def sent_s(self) -> float:
        """Unix time at which the command was recorded, seconds."""
        return self.sent_ns / 1e9

    @property
    def answered_s(self) -> float | None:
        """Unix time at which the answer was recorded, seconds; None without an answer."""
        return None if self.answered_ns is None else self.answered_ns / 1e9

    @property
    def round_trip_ms(self) -> float | None:
        """Time between the recording of the command and of its answer, ms; None without an answer.

        In a recording of a robot it includes the network; in one of a server only the work of the server.
        """
        return None if self.answered_ns is None else (self.answered_ns - self.sent_ns) / 1e6

    @cached_property
    def command(self) -> Command:
        """The decoded command.

        Raises:
            BadMessage: The recorded bytes are malformed, or another message than a command.
            LimitExceeded: The message is larger than the limits allow.
        """
        message = _codec(self.codec, self.session).decode_from_robot(self.command_bytes)
        if not isinstance(message, Command):
            raise BadMessage("a recorded message is no command", hint="record again")
        return message

    @cached_property
    def reply(self) -> Result | Failure | None:
        """The decoded answer; None without an answer.

        Raises:
            BadMessage: The recorded bytes are malformed, or another message than an answer.
            LimitExceeded: The message is larger than the limits allow.
        """
        if self.reply_bytes is None:
            return None
        message = _codec(self.codec, self.session).decode_from_server(self.reply_bytes)
        if not isinstance(message, Result | Failure):
            raise BadMessage("a recorded message is no answer", hint="record again")
        return message


class WireRecording:
    """The files of one recording.

    Attributes:
        files: The files in the order in which they are read.
        metadata: Metadata of the first file that a server or robot wrote, such as ``version``, ``side`` and
            ``engine``; see `read_head`.
        cut: Truncated or damaged files that `commands` has read so far.
        left_out: Number of messages that `commands` could not decode so far.
    """

    def __init__(self, files: tuple[Path, ...], session: SessionSettings) -> None:
        self.files = files
        self.metadata: dict[str, str] = {}
        self.cut: list[Path] = []
        self.left_out = 0
        self._session = session
        self._budget = Budget.of_messages(session)

    def read_head(self) -> None:
        """Read the metadata that precedes the first message of a file, and set `metadata`.

        Raises:
            BadRequest: The only file is not a recording.
            UnsupportedProtocol: A file has a newer format.
        """
        for path in self.files:
            try:
                head = _head(path)
            except BadRequest:
                if len(self.files) == 1:
                    raise
                continue
            about = head.get(file_format.METADATA_NAME, {})
            if about.get("side") in ("server", "robot"):
                self.metadata = about
                return
            self.metadata = self.metadata or about

    def commands(self, wanted: Wanted | None = None) -> Iterator[RecordedCommand]:
        """Yield each command once its answer is read, and at the end the commands without an answer.

        *wanted* selects a robot and a time span: chunks of finished files outside the span are not read.
        Commands of other times may still be yielded, but no other robot's.  None yields all commands.

        Raises:
            BadRequest: The only file is not a recording.
            UnsupportedProtocol: A file has a newer format.
            LimitExceeded: A chunk is too large, or has an unknown compression.
        """
        self.cut = []
        self.left_out = 0
        waiting: OrderedDict[str, RecordedCommand] = OrderedDict()
        images: dict[str, _RobotImages] = {}
        for message in self._merge(wanted):
            if isinstance(message.of, file_format.WireChannel):
                yield from self._pair(message, message.of, waiting, images)
            elif len(images) < _MAX_CONNECTIONS:
                images.setdefault(message.of[1], _RobotImages()).add(message)
        yield from (self._with_images(command, images) for command in waiting.values())

    def find(self, identity: str) -> RecordedCommand:
        """Return the command with the id *identity*.

        *identity* is ``CONNECTION:ID``, or ``ID`` alone if only one connection has a command with this id.

        Raises:
            BadRequest: No command, or more than one, has this id.
        """
        exact = bool(_COMMAND_ID.fullmatch(identity))
        found: RecordedCommand | None = None
        for command in self.commands(self._plan_search(identity) if exact else None):
            if command.id == identity:
                return command
            if exact or not command.id.endswith(f":{identity}"):
                continue
            if found is not None:
                raise BadRequest(
                    f"several commands have the id {identity[:40]!r}",
                    hint=f"give the connection, too: {found.id} or {command.id}",
                )
            found = command
        if found is None:
            raise BadRequest(
                f"the recording has no command {identity[:40]!r}",
                hint="rse-pf replay FILE lists those that went wrong",
            )
        return found

    def _plan_search(self, identity: str) -> Wanted | None:
        """Return the robot that sent the command *identity* as a selection of messages.

        None if no summary of a file names the connection of the command: then everything is read.
        """
        topic = file_format.wire_topic(identity.partition(":")[0], "up")
        robots = (robot_of(path, topic) for path in self.files)
        robot = next((candidate for candidate in robots if candidate), None)
        return None if robot is None else Wanted(robot=robot)

    def _merge(self, wanted: Wanted | None) -> Iterator[_ChannelMessage]:
        """Yield the messages of all files; the messages of different recorders are merged by time."""
        streams = [list(files) for _, files in itertools.groupby(self.files, key=_recorder)]
        if len(streams) > _MAX_STREAMS:
            streams = [list(self.files)]
        of_file = partial(self._messages, wanted=wanted)
        messages = [itertools.chain.from_iterable(map(of_file, files)) for files in streams]
        yield from heapq.merge(*messages, key=lambda message: message.time_ns)

    def _messages(self, path: Path, wanted: Wanted | None) -> Iterator[_ChannelMessage]:
        """Yield the messages of one file.

        Raises BadRequest for a file without a valid header, except in a folder of several files, where it
        only counts as truncated.
        """
        try:
            yield from _messages(path, self.cut, wanted)
        except BadRequest:
            if len(self.files) == 1:
                raise
            self.cut.append(path)

    def _pair(
        self,
        message: _ChannelMessage,
        channel: file_format.WireChannel,
        waiting: OrderedDict[str, RecordedCommand],
        images: dict[str, _RobotImages],
    ) -> Iterator[RecordedCommand]:
        kind, number, service = self._envelope(channel.codec, message.data)
        identity = f"{channel.connection}:{number}"
        if channel.direction == "up" and kind == "command":
            former = waiting.pop(identity, None)
            if former is not None:
                yield former
            waiting[identity] = RecordedCommand(
                id=identity, robot=channel.robot, tenant=channel.tenant, server=channel.server,
                codec=channel.codec, service=service, sent_ns=message.time_ns, command_bytes=message.data,
                about=message.about, session=self._session,
            )  # fmt: skip
            if len(waiting) > _MAX_WAITING:
                yield self._with_images(waiting.popitem(last=False)[1], images)
        elif channel.direction == "down" and kind in ("result", "failure") and identity in waiting:
            asked = waiting.pop(identity)
            yield self._with_images(
                replace(asked, answered_ns=message.time_ns, reply_bytes=message.data), images
            )

    def _envelope(self, codec: str, data: bytes) -> tuple[str, int | None, str]:
        """Return type, id and service of a message; ``("", None, "")`` if it cannot be decoded."""
        try:
            if codec == "bin":
                check_size(data, self._budget)
                envelope = _decode_binary(data)
            elif codec in CODECS:
                check_size(data, self._budget)
                envelope = _decode_json(inflate_within(data, self._budget) if codec == "zlib" else data)
            else:
                raise BadMessage(f"no codec named {codec[:20]!r}")
        except (RsePfError, msgspec.DecodeError, ValueError, RecursionError):
            self.left_out += 1
            return "", None, ""
        return envelope.type, envelope.id, envelope.service

    @staticmethod
    def _with_images(command: RecordedCommand, images: dict[str, _RobotImages]) -> RecordedCommand:
        seen = images.get(command.robot)
        if seen is None:
            return command
        return _add_images(command, seen.of("frames", command), seen.of("odometry", command))


def open_recording(path: Path, session: SessionSettings | None = None) -> WireRecording:
    """Return the recording at *path*; only the metadata at the start of its files is read.

    Args:
        path: Path of a file, or of a folder of files.
        session: Limits of messages; None for the defaults.

    Raises:
        UsageError: The file does not exist, or the folder holds no recording.
        BadRequest: The file is not a recording.
        UnsupportedProtocol: A file has a newer format.
    """
    files = recording_files(path)
    recording = WireRecording(files, session or SessionSettings())
    recording.read_head()
    return recording


def recording_files(path: Path) -> tuple[Path, ...]:
    """Return the files of the recording at *path*, by start of the recorder, server and number.

    A single file is opened, and its first bytes are checked; files of a folder are only listed.

    Raises:
        UsageError: The file does not exist, or the folder holds no recording.
        BadRequest: The file at *path* is empty, or not a recording.
    """
    if path.is_dir():
        files = tuple(sorted(path.glob(f"*{file_format.SUFFIX}"), key=_file_order))
        if not files:
            raise UsageError(
                f"there is no recording in {path}", hint=f"its files end in {file_format.SUFFIX}"
            )
        return files
    if not path.exists():
        raise UsageError(f"there is no file {path}", hint="give a file or a folder of rse-pf local --record")
    if not path.is_file():  # reading a pipe or a device could block forever
        raise _no_recording(path)
    with path.open("rb") as file:
        start = file.read(len(_MAGIC))
    if not start:
        raise BadRequest(f"{path} is empty", hint="record again; it holds nothing")
    if start != _MAGIC:
        raise _no_recording(path)
    return (path,)


# --- reading the records of MCAP files ---


class _ChannelMessage(NamedTuple):
    """One message of a file.

    ``of`` is the source of the message: a connection, or a pair of ``frames`` (thumbnail) or ``odometry`` and
    the pseudonym of the robot.  ``time_ns`` is the Unix time, ``about`` the metadata of the file.
    """

    of: file_format.WireChannel | tuple[str, str]
    time_ns: int
    data: bytes
    about: Mapping[str, str]


class _RobotImages:
    """The newest 32 thumbnails and the newest 32 odometry poses of one robot."""

    def __init__(self) -> None:
        self._kept: dict[str, deque[_ChannelMessage]] = {}

    def add(self, message: _ChannelMessage) -> None:
        self._kept.setdefault(message.of[0], deque(maxlen=_MAX_KEPT_IMAGES)).append(message)

    def of(self, kind: str, command: RecordedCommand) -> bytes | None:
        """Return the JSON of the thumbnail (*kind* ``frames``) or the odometry (``odometry``) of *command*.

        The result is the entry that names the command, or else the newest entry of the last 0.5 s before the
        command; None without such an entry.
        """
        images = self._kept.get(kind, ())
        mark = f'"command":"{command.id}"'.encode()
        named = next((message.data for message in images if mark in message.data), None)
        if named is not None:
            return named
        near = [
            message
            for message in images
            if 0 <= command.sent_ns - message.time_ns <= _MAX_IMAGE_AGE_NS
            and b'"command":' not in message.data
        ]
        return max(near, key=lambda each: each.time_ns).data if near else None


class _Envelope(msgspec.Struct):
    type: str = ""
    id: int | None = None
    service: str = ""


class _Image(msgspec.Struct):
    data: str


class _Pose(msgspec.Struct):
    T_odom_camera: list[float]
    number: int = 0
    timestamp_s: float = 0.0


_decode_binary = msgspec.msgpack.Decoder(_Envelope).decode
_decode_json = msgspec.json.Decoder(_Envelope).decode
_decode_image = msgspec.json.Decoder(_Image).decode
_decode_pose = msgspec.json.Decoder(_Pose).decode


@cache
def _codec(name: str, session: SessionSettings) -> Codec:
    return make_codec(name, session)


def _add_images(command: RecordedCommand, image: bytes | None, pose: bytes | None) -> RecordedCommand:
    """Return *command* with thumbnail and odometry from their JSON; malformed ones are left out."""
    thumbnail = None
    odometry = None
    try:
        if image is not None:
            thumbnail = base64.b64decode(_decode_image(image).data, validate=True)
        if pose is not None:
            read = _decode_pose(pose)
            T_odom_camera = np.array(read.T_odom_camera)
            if T_odom_camera.size == 16 and np.isfinite(T_odom_camera).all():
                odometry = Odometry(
                    number=read.number, timestamp_s=read.timestamp_s,
                    T_odom_camera=T_odom_camera.reshape(4, 4),
                )  # fmt: skip
    except (msgspec.DecodeError, binascii.Error, RecursionError, ValueError):
        pass
    return replace(command, thumbnail=thumbnail, odometry=odometry)


def _file_order(path: Path) -> tuple[str, str, int]:
    name = file_format.FileName.parse(path.name)
    return ("~", path.name, 0) if name is None else (name.started.isoformat(), name.server, name.number)


def _recorder(path: Path) -> tuple[str, str]:
    """Return a key that is equal for all files that one recorder wrote."""
    name = file_format.FileName.parse(path.name)
    return ("", path.name) if name is None else (name.started.isoformat(), name.server)


def _head(path: Path) -> dict[str, dict[str, str]]:
    """Return the metadata records before the first message of a file, by name."""
    from mcap.records import Chunk, Message, Metadata

    metadata_by_name = {}
    for record in _records(path, []):
        if isinstance(record, Chunk | Message):
            break
        if isinstance(record, Metadata):
            metadata_by_name[record.name] = dict(record.metadata)
    return metadata_by_name


def _messages(path: Path, cut: list[Path], wanted: Wanted | None) -> Iterator[_ChannelMessage]:
    """Yield the messages of connections, thumbnails and odometry of one file that *wanted* selects.

    A truncated or damaged file is appended to *cut*.
    """
    from mcap.records import Channel, Message, Metadata

    about: Mapping[str, str] = {}
    channels: dict[int, file_format.WireChannel | tuple[str, str]] = {}

    def add(number: int, topic: str, metadata: dict[str, str]) -> None:
        of = _channel(topic, metadata) if len(channels) < _MAX_CONNECTIONS else None
        if of is not None and (wanted is None or wanted.robot in ("", _robot_of(topic, metadata))):
            channels[number] = of

    plan = None if wanted is None else plan_of(path, wanted, _robot_of)
    for number, channel in ({} if plan is None else plan.channels).items():
        add(number, *channel)
    for record in _flat(path, cut, plan):
        if isinstance(record, Message):
            of = channels.get(record.channel_id)
            if of is not None:
                yield _ChannelMessage(of, record.log_time, record.data, about)
        elif isinstance(record, Channel):
            add(record.id, record.topic, record.metadata)
        elif isinstance(record, Metadata) and record.name == file_format.METADATA_NAME:
            about = dict(record.metadata)


def _robot_of(topic: str, metadata: dict[str, str]) -> str | None:
    of = _channel(topic, metadata)
    return of.robot if isinstance(of, file_format.WireChannel) else of and of[1]


def _channel(topic: str, metadata: dict[str, str]) -> file_format.WireChannel | tuple[str, str] | None:
    for prefix in (file_format.FRAMES_PREFIX, file_format.ODOMETRY_PREFIX):
        if topic.startswith(prefix):
            return prefix.strip("/"), topic.removeprefix(prefix)
    return file_format.wire_channel(topic, metadata)


def _flat(path: Path, cut: list[Path], plan: ChunkPlan | None) -> Iterator[Any]:
    """Yield the records of a file and of those of its chunks that *plan* selects (None for all).

    Reading ends at the first damaged record, and the file is then appended to *cut*.
    """
    from mcap.exceptions import McapError
    from mcap.records import Chunk
    from mcap.stream_reader import breakup_chunk

    is_read = itertools.chain(() if plan is None else plan.is_read, itertools.repeat(True))
    for record in _records(path, cut):
        if not isinstance(record, Chunk):
            yield record
            continue
        if not next(is_read):
            continue
        try:
            data = _decompress(record)
            record.compression = ""
            record.data = data
            yield from cast("list[Any]", breakup_chunk(record))
        except (McapError, *_DAMAGE):
            cut.append(path)
            return


def _decompress(chunk: Any) -> bytes:
    """Return the uncompressed records of a chunk.

    Raises:
        ValueError: The chunk is damaged.
        LimitExceeded: It is too large, or has an unknown compression.
    """
    size: int = chunk.uncompressed_size
    if size > _MAX_CHUNK_BYTES:
        raise LimitExceeded(
            f"a chunk of {size} bytes is above {_MAX_CHUNK_BYTES}", hint="give a file that rse-pf recorded"
        )
    data: bytes = chunk.data
    if chunk.compression == "lz4":
        try:
            data = (
                importlib.import_module("lz4.frame")
                .LZ4FrameDecompressor()
                .decompress(data, max_length=size + 1)
            )
        except RuntimeError as error:
            raise ValueError("a chunk is damaged") from error
    elif chunk.compression:
        raise LimitExceeded(
            f"chunks compressed with {chunk.compression[:20]!r} are not read",
            hint="convert the file to lz4 or none",
        )
    if len(data) != size or (chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc):
        raise ValueError("a chunk is damaged")
    return data


def _records(path: Path, cut: list[Path]) -> Iterator[Any]:
    """Yield the records of a file without opening its chunks, up to the footer.

    Reading ends at the first truncated or damaged record, and the file is then appended to *cut*.

    Raises:
        BadRequest: The file is empty, or not a recording.
        UnsupportedProtocol: The file has a newer format.
    """
    from mcap.exceptions import McapError
    from mcap.records import Footer, Header, Metadata
    from mcap.stream_reader import StreamReader

    if path.stat().st_size == 0:
        raise BadRequest(f"{path} is empty", hint="record again; it holds nothing")
    with path.open("rb") as file:
        stream = cast("Any", _Bounded(file))
        records = iter(StreamReader(stream, emit_chunks=True, record_size_limit=_MAX_RECORD_BYTES).records)
        for count in itertools.count():
            try:
                record = next(records)
            except StopIteration:
                return
            except (McapError, *_DAMAGE) as error:
                if count == 0:
                    raise _no_recording(path) from error
                cut.append(path)
                return
            if count == 0 and (not isinstance(record, Header) or record.profile != file_format.PROFILE):
                raise _no_recording(path)
            if isinstance(record, Metadata) and record.name == file_format.METADATA_NAME:
                _check_version(path, record.metadata)
            if isinstance(record, Footer):
                return
            yield record


class _Bounded:
    """A file that is read with at most as many bytes at a time as remain in it.

    The length of a malformed record may be huge; a plain read would allocate that much memory.
    """

    def __init__(self, file: Any) -> None:
        self._file = file
        self._left = os.fstat(file.fileno()).st_size

    def read(self, size: int) -> bytes:
        """Return the next bytes: *size*, or fewer at the end."""
        data: bytes = self._file.read(min(size, self._left))
        self._left -= len(data)
        return data


def _no_recording(path: Path) -> BadRequest:
    return BadRequest(
        f"{path} is not a recording of rse-pf",
        hint="give a file that rse-pf local --record wrote",
    )


def _check_version(path: Path, metadata: dict[str, str]) -> None:
    text = metadata.get("format", "1")
    if not text.isascii() or not text.isdigit() or len(text) > 9:
        raise _no_recording(path)
    if int(text) > file_format.FORMAT_VERSION:
        raise UnsupportedProtocol(
            f"{path} has format {text}, and this version reads up to {file_format.FORMAT_VERSION}",
            hint="install a newer rse-pf",
        )
