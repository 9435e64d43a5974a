"""Read a ROS bag as a stream of raw messages: ROS 1 bag, ROS 2 sqlite3, ROS 2 MCAP, compressed or not.

Damaged files raise UsageError when they are opened, and BrokenMessage later.
"""

from __future__ import annotations

import struct
import weakref
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from client_sdk.auto_close import AutoClose
from client_sdk.bag_paths import is_bag, only_bag_of
from client_sdk.bags.decompression import Allowance, bound_reader, charge
from client_sdk.bags.message_types import load_types
from rse_pf.errors import MissingExtra, UsageError

__all__ = ["BagFile", "BrokenMessage", "RawMessage", "Topic", "open_bag_file"]

_FAULTS = (
    ArithmeticError, AssertionError, AttributeError, EOFError, LookupError, MemoryError, OSError,
    RuntimeError, TypeError, ValueError, struct.error,
)  # fmt: skip
"""Exceptions that the readers raise for malformed bags, in addition to their own ones."""
# Action for a bag that cannot be read.
_REPAIR_HINT = "repair it: rosbag reindex (ROS 1), ros2 bag reindex, or mcap recover; or copy it again"


class BrokenMessage(ValueError):
    """A message of a bag is malformed; other messages of the bag may be valid."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Topic:
    """A topic of a bag: name, type of its messages as ROS 2 names it (*kind*), and number of messages."""

    name: str
    kind: str
    messages: int


@dataclass(frozen=True, slots=True, kw_only=True)
class RawMessage:
    """An encoded message with its topic, its type (*kind*), and its time of writing to the bag (ns)."""

    topic: str
    kind: str
    log_ns: int
    data: bytes


def open_bag_file(path: Path) -> BagFile:
    """Open a ``.bag``, ``.db3`` or ``.mcap`` file, or the folder of a ROS 2 bag.

    Raises:
        UsageError: There is no such bag, or it cannot be read.
        MissingExtra: ``rosbags`` is not installed.
    """
    if not path.exists():
        raise UsageError(f"there is no bag {path}", hint="name a .bag, .db3 or .mcap file, or a bag's folder")
    if not is_bag(path):
        raise UsageError(
            f"{path} is not a ROS bag", hint="name a .bag, .db3 or .mcap file, or a bag's folder"
        )
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        path = only_bag_of(path) or path
    is_ros1 = path.suffix == ".bag" and path.is_file()
    store = load_types(is_ros1=is_ros1)
    reader = _reader(path, is_ros1)
    size_bytes = _size_bytes(path)
    try:
        charge(Allowance(size_bytes))
        reader.open()
    except _all_faults() as error:
        raise UsageError(
            f"{path} cannot be read as a bag: {_said(error)}", hint=_hint(path, error)
        ) from error
    return BagFile(path, reader, store, size_bytes=size_bytes, is_ros1=is_ros1)


class BagFile(AutoClose):
    """An open bag, whose topics are in ``topics``; a context manager that closes the bag."""

    def __init__(self, path: Path, reader: Any, store: Any, *, size_bytes: int, is_ros1: bool) -> None:
        self.path = path
        self._reader = reader
        self._release = weakref.finalize(self, reader.close)
        self._store = store
        self._size_bytes = size_bytes
        self._is_ros1 = is_ros1
        counts: dict[tuple[str, str], int] = {}
        for connection in reader.connections:
            key = (connection.topic, connection.msgtype)
            counts[key] = counts.get(key, 0) + connection.msgcount
        self.topics = tuple(
            Topic(name=name, kind=kind, messages=count) for (name, kind), count in sorted(counts.items())
        )

    def messages(self, names: Collection[str], start_ns: int | None = None) -> Iterator[RawMessage]:
        """Yield the messages of the topics *names* in the order of the bag.

        *start_ns* is the time of writing, nanoseconds, of the first message; None begins at the start.  Only
        one such iterator of a bag may be in use at a time.

        Raises:
            BrokenMessage: The bag is damaged, and cannot be read further.
        """
        wanted = [connection for connection in self._reader.connections if connection.topic in names]
        if not wanted:
            return
        allowance = Allowance(self._size_bytes)
        messages = self._reader.messages(wanted, start=start_ns)
        try:
            while True:
                charge(allowance)
                message = next(messages, None)
                if message is None:
                    return
                connection, log_ns, data = message
                yield RawMessage(topic=connection.topic, kind=connection.msgtype, log_ns=log_ns, data=data)
        except _all_faults() as error:
            raise BrokenMessage(_said(error)) from error

    def stamp_ns(self, raw: RawMessage) -> int:
        """Return the time stamp in the header of a message that begins with one, nanoseconds.

        Raises:
            BrokenMessage: The message is too short for a header.
        """
        try:
            if self._is_ros1:
                seconds, nanoseconds = struct.unpack_from("<II", raw.data, 4)
            else:
                order = "<" if raw.data[1] & 1 else ">"
                seconds, nanoseconds = struct.unpack_from(f"{order}iI", raw.data, 4)
        except (struct.error, IndexError) as error:
            raise BrokenMessage(f"a message of {len(raw.data)} bytes has no header") from error
        return int(seconds) * 1_000_000_000 + int(nanoseconds)

    def parse(self, raw: RawMessage) -> Any:
        """Decode a message; its arrays are views of the bytes.

        Raises:
            BrokenMessage: The bytes are not a message of the stated type.
        """
        try:
            if self._is_ros1:
                return self._store.deserialize_ros1(raw.data, raw.kind)
            # Pass a view: given bytes, the library would copy everything after the four bytes of the head.
            return self._store.deserialize_cdr(memoryview(raw.data), raw.kind)
        except _all_faults() as error:
            raise BrokenMessage(_said(error)) from error

    def close(self) -> None:
        """Release the file; no message can be read any more."""
        self._release()


def _reader(path: Path, is_ros1: bool) -> Any:
    try:
        from rosbags.rosbag1 import Reader as Reader1
        from rosbags.rosbag2 import Reader as Reader2
    except ImportError as error:
        raise MissingExtra("rosbags", "bags") from error
    bound_reader()
    return Reader1(path) if is_ros1 else Reader2(path)


def _size_bytes(path: Path) -> int:
    """Return the size of a bag: of its file, or of the files in its folder."""
    files = path.iterdir() if path.is_dir() else (path,)
    return sum(file.stat().st_size for file in files if file.is_file())


def _all_faults() -> tuple[type[Exception], ...]:
    from apsw import Error
    from rosbags.rosbag1 import ReaderError as ReaderError1
    from rosbags.rosbag2 import ReaderError as ReaderError2
    from rosbags.rosbag2.reader import zstd  # type: ignore[attr-defined]  # the module with which it decompresses
    from rosbags.serde import SerdeError
    from rosbags.typesys import TypesysError

    return (*_FAULTS, ReaderError1, ReaderError2, SerdeError, TypesysError, Error, zstd.ZstdError)


def _said(error: BaseException) -> str:
    text = " ".join(str(argument) for argument in error.args) or type(error).__name__
    return " ".join(text.split())[:160].rstrip(".")


def _hint(path: Path, error: BaseException) -> str:
    if path.suffix == ".mcap" and "rofile" in str(error):
        return "a recording of this platform is read by rse-pf replay; ROS 1 in MCAP: convert it to .bag"
    return _REPAIR_HINT
