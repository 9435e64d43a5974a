"""Read a recording: the commands of robots with their answers, in the order in which they were answered.

A recording is a file, or a folder of files that are read in the order of their times.  A file that was cut
off is read up to its last whole chunk.  What is in a file may come from a stranger: sizes are judged before
anything is decompressed or decoded.  Nothing here solves or writes.
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
from typing import Annotated, Any, NamedTuple, cast

import msgspec
import numpy as np

from rse_pf.config import SessionSettings
from rse_pf.errors import BadMessage, BadRequest, LimitExceeded, RsePfError, UnsupportedProtocol, UsageError
from rse_pf.extensions.recording import file_format
from rse_pf.extensions.recording.summary import ChunkPlan, Wanted, plan_of, robot_of
from rse_pf.geometry import Array
from rse_pf.limits.budget import Budget, check_size, inflate_within
from rse_pf.wire import CODECS, Codec, Command, Failure, Result, make_codec
from rse_pf.wire.messages import Identifier

__all__ = [
    "Odometry", "RecordedCommand", "WireRecording", "open_recording", "recording_files",
]  # fmt: skip

"""Metadata record of a file that was exported for one of its commands."""

_MAGIC = b"\x89MCAP0\r\n"
_MAX_RECORD_BYTES = 64 << 20
_MAX_CHUNK_BYTES = 32 << 20
"""Writers end a chunk at 1 MiB and one message."""
_MAX_WAITING = 4096
"""Commands without an answer that are kept in mind; of more, the oldest count as unanswered."""
_MAX_CONNECTIONS = 100_000
_MAX_STREAMS = 128
"""Recorders whose files are read at the same time."""
_KEPT_SIGHTS, _SIGHT_AGE_NS = 32, 500_000_000
"""Thumbnails and poses of odometry of a robot, and how old the one of a command may be."""
_DAMAGE = (struct.error, ValueError, OverflowError)
"""What the library raises for records that are no records, beside its own errors."""
_COMMAND_ID = re.compile(r"[0-9a-f]{16}:\d{1,16}")


class Odometry(msgspec.Struct, frozen=True, kw_only=True):
    """Where a robot thought it was: ``T_odom_camera`` ``(4, 4)``, at *timestamp_s* of its own clock."""

    number: int
    timestamp_s: float
    T_odom_camera: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class RecordedCommand:
    """One command and its answer, as they were on the wire.

    Attributes:
        id: ``CONNECTION:ID``.
        robot: A pseudonym.
        tenant: A pseudonym.
        server: Which server wrote it down, "" where it is not known.
        codec: ``zlib``, ``json`` or ``bin``.
        service: Which one was asked.
        sent_ns: When it was recorded, Unix time, nanoseconds.
        answered_ns: When its answer was recorded, None if it has none.
        thumbnail: A small JPEG of the frame, if the robot allowed it.
        odometry: Of the frame, if the robot recorded it.
        about: What its file says of itself: ``version``, ``side`` (``server`` or ``robot``), ``engine`` ...
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
        """When it was recorded, Unix time."""
        return self.sent_ns / 1e9

    @property
    def answered_s(self) -> float | None:
        """When its answer was recorded, Unix time."""
        return None if self.answered_ns is None else self.answered_ns / 1e9

    @property
    def round_trip_ms(self) -> float | None:
        """Time to the answer, as the recording side saw it."""
        return None if self.answered_ns is None else (self.answered_ns - self.sent_ns) / 1e6

    @cached_property
    def command(self) -> Command:
        """The decoded command; raises BadMessage or LimitExceeded."""
        message = _codec(self.codec, self.session).decode_from_robot(self.command_bytes)
        if not isinstance(message, Command):
            raise BadMessage("a recorded message is no command", hint="record again")
        return message

    @cached_property
    def reply(self) -> Result | Failure | None:
        """The decoded answer, None if there is none; raises BadMessage or LimitExceeded."""
        if self.reply_bytes is None:
            return None
        message = _codec(self.codec, self.session).decode_from_server(self.reply_bytes)
        if not isinstance(message, Result | Failure):
            raise BadMessage("a recorded message is no answer", hint="record again")
        return message


class WireRecording:
    """The files of one recording, and what is said about them at their start.

    Attributes:
        files: In the order in which they are read.
        metadata: Of the first file of a server or robot: ``version``, ``side``, ``engine`` ...
        cut: Files that end within a record, once they have been read.
        left_out: Messages that could not be decoded, or whose file has more connections than are read.
    """

    def __init__(self, files: tuple[Path, ...], session: SessionSettings) -> None:
        self.files = files
        self.metadata: dict[str, str] = {}
        self.cut: list[Path] = []
        self.left_out = 0
        self._session = session
        self._budget = Budget.of_messages(session)

    def read_head(self) -> None:
        """Read what is said before the first message; raises what `commands` raises."""
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
        """Yield every command when it was answered, and at the end those without an answer.

        With *wanted*, parts of finished files that hold nothing of it are not read; commands of other times
        may be among those that are yielded.

        Raises:
            BadRequest: A file is no recording.
            UnsupportedProtocol: It is of a newer version.
        """
        self.cut = []
        self.left_out = 0
        waiting: OrderedDict[str, RecordedCommand] = OrderedDict()
        sights: dict[str, _Sights] = {}
        for sight in self._merge(wanted):
            if isinstance(sight.of, file_format.WireChannel):
                yield from self._pair(sight, sight.of, waiting, sights)
            elif len(sights) < _MAX_CONNECTIONS:
                sights.setdefault(sight.of[1], _Sights()).add(sight)
        yield from (self._with_sights(command, sights) for command in waiting.values())

    def find(self, identity: str) -> RecordedCommand:
        """Return the command ``CONNECTION:ID``, or the only one whose name ends in *identity*.

        Raises:
            BadRequest: There is none, or there are several.
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
                    f"several commands are called {identity[:40]!r}",
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
        """Return what is read to find a command, None if no summary knows its robot."""
        topic = file_format.wire_topic(identity.partition(":")[0], "up")
        robots = (robot_of(path, topic) for path in self.files)
        robot = next((candidate for candidate in robots if candidate), None)
        return None if robot is None else Wanted(robot=robot)

    def _merge(self, wanted: Wanted | None) -> Iterator[_Sight]:
        """Yield the messages of all files; those of several recorders by their times."""
        streams = [list(files) for _, files in itertools.groupby(self.files, key=_recorder)]
        if len(streams) > _MAX_STREAMS:
            streams = [list(self.files)]
        of_file = partial(self._messages, wanted=wanted)
        messages = [itertools.chain.from_iterable(map(of_file, files)) for files in streams]
        yield from heapq.merge(*messages, key=lambda sight: sight.time_ns)

    def _messages(self, path: Path, wanted: Wanted | None) -> Iterator[_Sight]:
        """Yield the messages of one file; in a folder, one that was never begun does not end the others."""
        try:
            yield from _messages(path, self.cut, wanted)
        except BadRequest:
            if len(self.files) == 1:
                raise
            self.cut.append(path)

    def _pair(
        self,
        message: _Sight,
        channel: file_format.WireChannel,
        waiting: OrderedDict[str, RecordedCommand],
        sights: dict[str, _Sights],
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
                yield self._with_sights(waiting.popitem(last=False)[1], sights)
        elif channel.direction == "down" and kind in ("result", "failure") and identity in waiting:
            asked = waiting.pop(identity)
            yield self._with_sights(
                replace(asked, answered_ns=message.time_ns, reply_bytes=message.data), sights
            )
        elif channel.direction == "down" and kind == "refused":
            for number, data in self._failures(channel.codec, message.data):
                refused = waiting.pop(f"{channel.connection}:{number}", None)
                if refused is not None:
                    yield self._with_sights(
                        replace(refused, answered_ns=message.time_ns, reply_bytes=data), sights
                    )

    def _failures(self, codec: str, data: bytes) -> list[tuple[int, bytes]]:
        """Return the id of each command that one message ends, and its own failure as a message.

        Servers before version 0.3.0 could end many commands with one message; recordings of them hold it.
        """
        try:
            if codec == "bin":
                refused = msgspec.msgpack.decode(data, type=_Refused)
            else:
                text = inflate_within(data, self._budget) if codec == "zlib" else data
                refused = msgspec.json.decode(text, type=_Refused)
        except (msgspec.DecodeError, ValueError):
            self.left_out += 1
            return []
        encode = _codec(codec, self._session).encode
        fields = {name: getattr(refused, name) for name in _Refused.__struct_fields__ if name != "ids"}
        return [(number, encode(Failure(id=number, **fields))) for number in dict.fromkeys(refused.ids)]

    def _envelope(self, codec: str, data: bytes) -> tuple[str, int | None, str]:
        """Return the type, the id and the service of a message, "" for one that cannot be read."""
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
    def _with_sights(command: RecordedCommand, sights: dict[str, _Sights]) -> RecordedCommand:
        seen = sights.get(command.robot)
        if seen is None:
            return command
        return _add_images(command, seen.of("frames", command), seen.of("odometry", command))


def open_recording(path: Path, session: SessionSettings | None = None) -> WireRecording:
    """Return the recording at *path*: a file, or a folder with files; nothing but its start is read.

    Args:
        path: Of a file, or of a folder.
        session: Limits of messages, None for the defaults.

    Raises:
        UsageError: There is no such file, or no recording in the folder.
        BadRequest: The first file is no recording.
        UnsupportedProtocol: It is of a newer version.
    """
    files = recording_files(path)
    recording = WireRecording(files, session or SessionSettings())
    recording.read_head()
    return recording


def recording_files(path: Path) -> tuple[Path, ...]:
    """Return the files of the recording at *path* in their order; a file is opened only for its first bytes.

    Raises:
        UsageError: There is no such file, or no recording in the folder.
        BadRequest: A file that is not in a folder of others is no recording.
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
    if not path.is_file():  # nobody waits for what a pipe brings
        raise _no_recording(path)
    with path.open("rb") as file:
        start = file.read(len(_MAGIC))
    if not start:
        raise BadRequest(f"{path} is empty", hint="record again; it holds nothing")
    if start != _MAGIC:
        raise _no_recording(path)
    return (path,)


# --- files ------------------------------------------------------------------------------------------------


class _Sight(NamedTuple):
    """One message of a channel: a connection, or (``frames`` or ``odometry``, pseudonym of the robot)."""

    of: file_format.WireChannel | tuple[str, str]
    time_ns: int
    data: bytes
    about: Mapping[str, str]


class _Sights:
    """The newest thumbnails and poses of odometry of one robot."""

    def __init__(self) -> None:
        self._kept: dict[str, deque[_Sight]] = {}

    def add(self, sight: _Sight) -> None:
        self._kept.setdefault(sight.of[0], deque(maxlen=_KEPT_SIGHTS)).append(sight)

    def of(self, kind: str, command: RecordedCommand) -> bytes | None:
        """Return the JSON of what belongs to *command*: what names it, else the newest before it."""
        sights = self._kept.get(kind, ())
        mark = f'"command":"{command.id}"'.encode()
        named = next((sight.data for sight in sights if mark in sight.data), None)
        if named is not None:
            return named
        near = [
            sight
            for sight in sights
            if 0 <= command.sent_ns - sight.time_ns <= _SIGHT_AGE_NS and b'"command":' not in sight.data
        ]
        return max(near, key=lambda each: each.time_ns).data if near else None


class _Envelope(msgspec.Struct):
    type: str = ""
    id: int | None = None
    service: str = ""


class _Refused(msgspec.Struct):
    """A failure of each of its commands, of which one message names at most 64."""

    ids: Annotated[list[Identifier], msgspec.Meta(max_length=64)]
    code: str
    message: str
    hint: str = ""
    retry_after_ms: float | None = None
    server: str = ""


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
    """Return *command* with what was seen; what cannot be read is left out."""
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
    """Return what is the same for the files that one recorder wrote one after the other."""
    name = file_format.FileName.parse(path.name)
    return ("", path.name) if name is None else (name.started.isoformat(), name.server)


def _head(path: Path) -> dict[str, dict[str, str]]:
    """Return the metadata of a file by name."""
    from mcap.records import Chunk, Message, Metadata

    metadata_by_name = {}
    for record in _records(path, []):
        if isinstance(record, Chunk | Message):
            break
        if isinstance(record, Metadata):
            metadata_by_name[record.name] = dict(record.metadata)
    return metadata_by_name


def _messages(path: Path, cut: list[Path], wanted: Wanted | None) -> Iterator[_Sight]:
    """Yield the messages of connections, thumbnails and odometry of one file."""
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
                yield _Sight(of, record.log_time, record.data, about)
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
    """Yield the records of a file, those in its chunks of *plan* included, up to where it is cut off."""
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
    """Return the content of a chunk; raises ValueError if it is damaged, or longer than it may be."""
    size: int = chunk.uncompressed_size
    if size > _MAX_CHUNK_BYTES:
        raise LimitExceeded(
            f"a chunk of {size} bytes is above {_MAX_CHUNK_BYTES}", hint="this is no recording of rse-pf"
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
    """Yield the records of a file with whole chunks; a file that ends within one ends there, too.

    Raises:
        BadRequest: It is no recording.
        UnsupportedProtocol: It is of a newer version.
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
    """A file whose reads ask for no more memory than the file has bytes."""

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
