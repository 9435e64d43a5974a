"""Queue the keyframes that a live map has not acknowledged yet, in memory or in a folder.

The queue is first in, first out, and holds each keyframe until the map has acknowledged or refused it.  In a
folder it survives a restart of the robot's program: ``INDEX-SEGMENT.keyframe`` holds the encoded bytes of one
keyframe, ``state.json`` the `NumberOffset`, and ``.lock`` is locked while a program uses the folder, because
two programs would remove each other's keyframes.

Keyframes and segments have two numberings.  The robot counts both from 0 in its own count, also while it is
offline.  The map counts the keyframes and segments of all runs of this robot.  When a keyframe is sent, a
`NumberOffset` is added to the robot's numbers; only the map can state it.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
from collections import deque
from dataclasses import dataclass
from pathlib import Path

from rse_pf.errors import UsageError
from rse_pf.storage.files import TEMPORARY_PREFIX, replace_file

__all__ = ["KeyframeQueue", "NumberOffset", "QueuedKeyframe", "choose_number_offset"]

_KEYFRAME_SUFFIX = ".keyframe"
_STATE_FILE = "state.json"
_LOCK_FILE = ".lock"
_MAX_MEMORY_BYTES = 64 << 20
"""Most bytes of the keyframes that wait in memory, about 2,000 keyframes of 34 kB; `KeyframeQueue.add`
refuses further ones."""
_MAX_FOLDER_BYTES = 1 << 30
"""Most bytes of the keyframes that wait in a folder, about 30,000 keyframes of 34 kB; `KeyframeQueue.add`
refuses further ones."""


@dataclass(frozen=True, slots=True)
class QueuedKeyframe:
    """A keyframe that waits to be sent.

    Attributes:
        index: Number of the keyframe in the robot's own count, from 0.
        segment: Number of its odometry segment in the robot's own count, from 0.
        data: The keyframe as `rse_pf.slam.keyframe.encode_keyframe` returns it.
    """

    index: int
    segment: int
    data: bytes


@dataclass(frozen=True, slots=True)
class _Entry:
    """A keyframe of the queue; ``data`` is None if the keyframe is in a file."""

    index: int
    segment: int
    size_bytes: int
    data: bytes | None


@dataclass(frozen=True, slots=True)
class NumberOffset:
    """Numbers that the map gives to keyframe 0 and to segment 0 of the robot's own count.

    The map's number of a keyframe is ``number`` plus the robot's index of it; the map's number of a segment
    is ``segment`` plus the robot's number of it.  Both may be negative: if a map is started again while the
    robot makes keyframe 500, the new map expects number 0 for it, so ``number`` is -500.
    """

    number: int
    segment: int


class KeyframeQueue:
    """First-in, first-out queue of keyframes with a limit of bytes; no keyframe is dropped to make space."""

    def __init__(self, folder: Path | None, *, max_bytes: int | None = None) -> None:
        """Store the arguments; `open` locks the folder and reads the keyframes of an earlier run.

        Args:
            folder: Folder for the keyframes of one robot in one map; None keeps them in memory.
            max_bytes: Most bytes of all queued keyframes together; `add` refuses a keyframe that would exceed
                it.  None means 64 MiB in memory and 1 GiB in a folder.
        """
        self._folder = folder
        self._max_bytes = max_bytes or (_MAX_MEMORY_BYTES if folder is None else _MAX_FOLDER_BYTES)
        self._entries: deque[_Entry] = deque()
        self._queued_bytes = 0
        self.next_index = 0
        """Index in the robot's own count that the next added keyframe gets."""
        self.offset: NumberOffset | None = None
        """Offset from the robot's numbers to those of the map; None until `set_offset` or `open` has set
        it."""
        self._lock_descriptor = -1

    def __len__(self) -> int:
        return len(self._entries)

    @property
    def first_index(self) -> int:
        """The robot's index of the oldest queued keyframe; `next_index` if the queue is empty."""
        return self._entries[0].index if self._entries else self.next_index

    def open(self) -> int:
        """Lock the folder and read the queue of an earlier run; return the first segment of this run.

        It is 0 for an empty queue, else one more than the segment of the newest queued keyframe, because a
        program that starts again does not know where the robot is in the earlier odometry frame.

        Raises:
            UsageError: The folder cannot be read or written, holds a file with an invalid name, or is used by
                another program.
        """
        folder = self._folder
        if folder is None:
            return 0
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._lock(folder)
            for partial_file in folder.glob(f"{TEMPORARY_PREFIX}*"):
                partial_file.unlink()
            for path in sorted(folder.glob(f"*{_KEYFRAME_SUFFIX}")):
                index, segment = map(int, path.name.removesuffix(_KEYFRAME_SUFFIX).split("-"))
                self._entries.append(_Entry(index, segment, path.stat().st_size, None))
            if not self._entries:
                (folder / _STATE_FILE).unlink(missing_ok=True)
                return 0
            self._queued_bytes = sum(entry.size_bytes for entry in self._entries)
            self.next_index = self._entries[-1].index + 1
            if (folder / _STATE_FILE).exists():
                self.offset = NumberOffset(**json.loads((folder / _STATE_FILE).read_text(encoding="utf-8")))
        except (OSError, ValueError, TypeError) as error:
            self.close()
            raise UsageError(
                f"cannot use the keyframes in {folder}: {error}", hint="name another folder as spool"
            ) from error
        return self._entries[-1].segment + 1

    def close(self) -> None:
        """Unlock the folder, so that another program may use it; queued keyframes stay there."""
        if self._lock_descriptor >= 0:
            os.close(self._lock_descriptor)
        self._lock_descriptor = -1

    def add(self, keyframe: QueuedKeyframe) -> bool:
        """Append a keyframe whose index is `next_index`; return False if the byte limit forbids it.

        If it returns False or raises, the queue has not changed, and the keyframe never gets to the map.

        Raises:
            UsageError: The file of the keyframe cannot be written, for example because the disk is full.
        """
        size_bytes = len(keyframe.data)
        if self._queued_bytes + size_bytes > self._max_bytes:
            return False
        if self._folder is not None:
            try:
                replace_file(_keyframe_path(self._folder, keyframe.index, keyframe.segment), keyframe.data)
            except OSError as error:
                raise UsageError(
                    f"cannot write a keyframe to {self._folder}: {error.strerror}",
                    hint="free space on this disk",
                ) from error
        data = keyframe.data if self._folder is None else None
        self._entries.append(_Entry(keyframe.index, keyframe.segment, size_bytes, data))
        self._queued_bytes += size_bytes
        self.next_index = keyframe.index + 1
        return True

    def first(self) -> QueuedKeyframe:
        """Return the oldest keyframe, which stays in the queue.

        Raises:
            IndexError: The queue is empty.
            UsageError: The file of the keyframe cannot be read.
        """
        entry = self._entries[0]
        data = entry.data
        if data is None:
            assert self._folder is not None
            try:
                data = _keyframe_path(self._folder, entry.index, entry.segment).read_bytes()
            except OSError as error:
                raise UsageError(
                    f"keyframe {entry.index} in {self._folder} cannot be read: {error}",
                    hint="let no other program change or remove files in the spool folder",
                ) from error
        return QueuedKeyframe(entry.index, entry.segment, data)

    def remove_first(self) -> None:
        """Remove the oldest keyframe, after the map has acknowledged it or refused its content."""
        entry = self._entries.popleft()
        self._queued_bytes -= entry.size_bytes
        if self._folder is not None:
            with contextlib.suppress(OSError):
                _keyframe_path(self._folder, entry.index, entry.segment).unlink()

    def set_offset(self, offset: NumberOffset) -> None:
        """Store the offset from the robot's numbers to those of the map, in the folder, too, if there is one.

        Raises:
            UsageError: The state file cannot be written.
        """
        self.offset = offset
        if self._folder is not None:
            text = json.dumps({"number": offset.number, "segment": offset.segment})
            try:
                replace_file(self._folder / _STATE_FILE, text)
            except OSError as error:
                raise UsageError(
                    f"cannot write {self._folder / _STATE_FILE}: {error.strerror}",
                    hint="free space on this disk",
                ) from error

    def _lock(self, folder: Path) -> None:
        """Lock the folder for this process; the kernel unlocks it when the process exits or is killed."""
        self._lock_descriptor = os.open(folder / _LOCK_FILE, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        try:
            fcntl.flock(self._lock_descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            self.close()
            raise UsageError(
                f"another program keeps its keyframes in {folder}", hint="give each robot a spool of its own"
            ) from error


def _keyframe_path(folder: Path, index: int, segment: int) -> Path:
    """Return the file of a keyframe; the names of files sort by index."""
    return folder / f"{index:012d}-{segment}{_KEYFRAME_SUFFIX}"


def choose_number_offset(
    current: NumberOffset | None,
    *,
    first_index: int,
    first_segment: int,
    next_index: int,
    next_number: int,
    unused_segment: int,
) -> tuple[NumberOffset, int]:
    """Return the offset for all queued keyframes, and how many of the oldest of them the map already has.

    The current offset stays in use if it gives the number *next_number* to a queued keyframe or to the
    keyframe that is added next: the map has stored the queued keyframes before it, and only their
    acknowledgements were lost.  Otherwise the map is new, or has keyframes of this robot that this program
    does not know.  The new offset then gives *next_number* and *unused_segment* to the oldest queued
    keyframe; the later keyframes and segments follow in the robot's order.

    Args:
        current: The offset in use; None if the map was not asked before.
        first_index: Index of the oldest queued keyframe in the robot's own count; *next_index* without any.
        first_segment: The robot's number of the segment of that keyframe; the present one without any.
        next_index: Index that the next added keyframe gets in the robot's own count.
        next_number: The number that the map expects of this robot's next keyframe.
        unused_segment: The smallest segment number that no keyframe of this robot in the map has.
    """
    if current is not None and current.number + first_index <= next_number <= current.number + next_index:
        return current, next_number - current.number - first_index
    return NumberOffset(next_number - first_index, unused_segment - first_segment), 0
