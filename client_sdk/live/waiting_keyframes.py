"""The keyframes of a robot that a live map has not acknowledged: in order, none lost, none twice.

They are kept in memory, or in a folder that survives a restart of the robot: a file holds the bytes of one
keyframe, as they are sent, and its name is ``INDEX-SEGMENT.keyframe``.  One program at a time uses a folder:
two would remove each other's keyframes.  Numbers that the map knows are given when a keyframe is sent: a
robot that is offline does not know the first of them yet.
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
from rse_pf.files import TEMPORARY_PREFIX, replace_file

__all__ = ["Base", "WaitingKeyframe", "WaitingKeyframes", "rebase"]

_SUFFIX = ".keyframe"
_STATE = "state.json"
_LOCK = ".lock"
_MEMORY_BYTES = 64 << 20
_DISK_BYTES = 1 << 30


@dataclass(frozen=True, slots=True)
class WaitingKeyframe:
    """A keyframe that waits; ``index`` and ``segment`` count from the start of this robot's records.

    ``data`` is what `rse_pf.slam.keyframe.encode_keyframe` returned.
    """

    index: int
    segment: int
    data: bytes


@dataclass(frozen=True, slots=True)
class _Held:
    """A keyframe of the queue; ``data`` is None if its file holds it."""

    index: int
    segment: int
    size_bytes: int
    data: bytes | None


@dataclass(frozen=True, slots=True)
class Base:
    """What the map calls keyframe 0 and segment 0 of this robot's records."""

    number: int
    segment: int


class WaitingKeyframes:
    """Keyframes in the order in which they were made."""

    def __init__(self, folder: Path | None, *, max_bytes: int | None = None) -> None:
        """Describe the queue; `open` reads what an earlier run left.

        Args:
            folder: Keeps the keyframes of one robot and one map; None keeps them in memory.
            max_bytes: `add` refuses more; None means 64 MiB in memory, 1 GiB in a folder.
        """
        self._folder = folder
        self._max_bytes = max_bytes or (_MEMORY_BYTES if folder is None else _DISK_BYTES)
        self._held: deque[_Held] = deque()
        self._bytes = 0
        self._next_index = 0
        self._first_segment = 0
        self._base: Base | None = None
        self._lock = -1

    def __len__(self) -> int:
        return len(self._held)

    @property
    def base(self) -> Base | None:
        """What the map calls keyframe 0 and segment 0; None until it was asked."""
        return self._base

    @property
    def first_index(self) -> int:
        """The index of the keyframe that is sent next."""
        return self._held[0].index if self._held else self._next_index

    @property
    def next_index(self) -> int:
        """The index of the keyframe that is added next."""
        return self._next_index

    def open(self) -> int:
        """Take over what an earlier run left; return the segment that this run begins with.

        Raises:
            UsageError: The folder cannot be read or written, or another program uses it.
        """
        folder = self._folder
        if folder is None:
            return 0
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._take_lock(folder)
            for part in folder.glob(f"{TEMPORARY_PREFIX}*"):
                part.unlink()
            for path in sorted(folder.glob(f"*{_SUFFIX}")):
                index, segment = map(int, path.name.removesuffix(_SUFFIX).split("-"))
                self._held.append(_Held(index, segment, path.stat().st_size, None))
            if not self._held:
                (folder / _STATE).unlink(missing_ok=True)
                return 0
            self._bytes = sum(held.size_bytes for held in self._held)
            self._next_index = self._held[-1].index + 1
            if (folder / _STATE).exists():
                self._base = Base(**json.loads((folder / _STATE).read_text(encoding="utf-8")))
            self._first_segment = self._held[-1].segment + 1
        except (OSError, ValueError, TypeError) as error:
            self.close()
            raise UsageError(
                f"cannot use the keyframes in {folder}: {error}", hint="name another folder as spool"
            ) from error
        return self._first_segment

    def close(self) -> None:
        """Let another program use the folder; what waits stays there."""
        if self._lock >= 0:
            os.close(self._lock)
        self._lock = -1

    def add(self, keyframe: WaitingKeyframe) -> bool:
        """Keep *keyframe*, whose index is `next_index`; return False if there is no space for it.

        Raises:
            UsageError: The folder cannot be written.
        """
        size_bytes = len(keyframe.data)
        if self._bytes + size_bytes > self._max_bytes:
            return False
        if self._folder is not None:
            try:
                replace_file(_path(self._folder, keyframe.index, keyframe.segment), keyframe.data)
            except OSError as error:
                raise UsageError(
                    f"cannot keep a keyframe in {self._folder}: {error.strerror}",
                    hint="free space on this disk",
                ) from error
        data = keyframe.data if self._folder is None else None
        self._held.append(_Held(keyframe.index, keyframe.segment, size_bytes, data))
        self._bytes += size_bytes
        self._next_index = keyframe.index + 1
        return True

    def first(self) -> WaitingKeyframe:
        """Return the oldest keyframe; raises UsageError if its file is gone."""
        held, data = self._held[0], self._held[0].data
        if data is None:
            assert self._folder is not None
            try:
                data = _path(self._folder, held.index, held.segment).read_bytes()
            except OSError as error:
                raise UsageError(
                    f"keyframe {held.index} in {self._folder} cannot be read: {error}",
                    hint="leave the spool alone",
                ) from error
        return WaitingKeyframe(held.index, held.segment, data)

    def remove_first(self) -> None:
        """Forget the oldest keyframe: the map has it, or refused it for good."""
        held = self._held.popleft()
        self._bytes -= held.size_bytes
        if self._folder is not None:
            with contextlib.suppress(OSError):
                _path(self._folder, held.index, held.segment).unlink()

    def set_base(self, base: Base) -> None:
        """Keep what the map calls keyframe 0 and segment 0; raises UsageError."""
        self._base = base
        if self._folder is not None:
            text = json.dumps({"number": base.number, "segment": base.segment})
            try:
                replace_file(self._folder / _STATE, text)
            except OSError as error:
                raise UsageError(
                    f"cannot write {self._folder}: {error.strerror}", hint="free space on this disk"
                ) from error

    def _take_lock(self, folder: Path) -> None:
        """Lock the folder; Linux unlocks it however this program ends."""
        self._lock = os.open(folder / _LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            self.close()
            raise UsageError(
                f"another program keeps its keyframes in {folder}", hint="give each robot a spool of its own"
            ) from error


def _path(folder: Path, index: int, segment: int) -> Path:
    """Return the file of a keyframe; names sort by index."""
    return folder / f"{index:012d}-{segment}{_SUFFIX}"


def rebase(base: Base | None, first: Base, end: int, wanted: Base) -> tuple[Base, int]:
    """Return the base to send with, and how many of the oldest waiting keyframes the map has already.

    Args:
        base: The present one.
        first: Index and segment of the keyframe that is sent next.
        end: The index of the keyframe that is added next.
        wanted: What the map expects next: a number, and a segment that it does not know.
    """
    if base is not None and base.number + first.number <= wanted.number <= base.number + end:
        return base, wanted.number - base.number - first.number
    return Base(wanted.number - first.number, wanted.segment - first.segment), 0
