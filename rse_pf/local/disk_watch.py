"""Watch the disks of a local platform: warn before one is full, and refill the disk reserve.

The reserve is a file that keeps space for changes of the roster and the deny list, so that an operator can
still revoke a robot on a full disk.  Servers are neither started nor replaced while the disk of the state
folder is full: their logs and announcements could not be written.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from rse_pf.auth.trust_store import DENY_NAME, ROBOTS_NAME, AccessControlStore
from rse_pf.errors import RsePfError
from rse_pf.scaling.operator_alarms import LOW_DISK_PERCENT
from rse_pf.storage.disk_reserve import DiskReserve
from rse_pf.storage.files import replace_file
from rse_pf.storage.object_store import DirectoryStore

__all__ = [
    "LOOK_S", "DiskSpace", "DiskWatch", "access_control_store", "disk_level", "disk_line", "disk_spaces",
    "folders_of",
]  # fmt: skip

Level = Literal["ok", "low", "full"]

# Time between two checks of the disks, in seconds; files that could not be written are written at the next
# check.
LOOK_S = 0.5
# Free bytes below which a disk counts as full: a server that starts writes about as much.
_FULL_BYTES = 1 << 20
# A disk leaves the level low or full once its free space is this many times the level's threshold, so that
# the level does not alternate.
_HYSTERESIS = 1.1
# Prefix of the location of an object store that is a folder.
_DIRECTORY = "dir:"
_MIB = 1 << 20


@dataclass(frozen=True, slots=True, kw_only=True)
class DiskSpace:
    """Free and total bytes of the file system of ``folder``; space that only root may use is not free."""

    folder: str
    free_bytes: int
    total_bytes: int
    level: Level


def disk_level(free_bytes: int, total_bytes: int, before: Level = "ok") -> Level:
    """Return the level of a disk: ``ok``, ``low`` or ``full``.

    It is full below 1 MiB of free space, and low below `LOW_DISK_PERCENT` of its size.  *before* is its level
    at the last check: a low or full disk needs a tenth more free space to leave that level.
    """
    low_bytes = total_bytes * LOW_DISK_PERCENT / 100
    if free_bytes < _FULL_BYTES * (_HYSTERESIS if before == "full" else 1):
        return "full"
    return "low" if free_bytes < low_bytes * (1 if before == "ok" else _HYSTERESIS) else "ok"


def folders_of(state: Path, store: str) -> list[Path]:
    """Return the folders that a platform writes to: *state*, and PATH if *store* is ``dir:PATH``."""
    return [state] + ([Path(store.removeprefix(_DIRECTORY))] if store.startswith(_DIRECTORY) else [])


def disk_spaces(folders: Iterable[Path]) -> list[DiskSpace]:
    """Return the file systems of *folders*, each once; for a missing folder, that of its nearest parent.

    Their levels are without hysteresis, so they may differ from those of the events of `DiskWatch`.
    """
    spaces: dict[int, DiskSpace] = {}
    for folder in folders:
        there = next(path for path in (folder, *folder.parents) if path.exists())
        about = os.statvfs(there)
        free, total = about.f_bavail * about.f_frsize, about.f_blocks * about.f_frsize
        space = DiskSpace(
            folder=str(folder), free_bytes=free, total_bytes=total, level=disk_level(free, total)
        )
        spaces.setdefault(there.stat().st_dev, space)
    return list(spaces.values())


def disk_line(space: DiskSpace) -> str:
    """Return a warning about *space* as one line; "" if its level is ``ok``."""
    sizes = f"{space.free_bytes // _MIB} of {space.total_bytes // _MIB} MiB"
    sentence = f"{sizes} are free on the disk of {space.folder}"
    return {
        "ok": "",
        "low": f"little space: {sentence}",
        "full": f"disk full: {sentence}; servers are not started, and little is recorded: free some space",
    }[space.level]


def access_control_store(state: Path) -> AccessControlStore:
    """Return the store of roster and deny list of the platform in *state*.

    It uses the disk reserve, so both can be changed on a full disk.
    """
    return AccessControlStore(DirectoryStore(state, _reserve(state)))


class DiskWatch:
    """The disks of one platform, as they were at the last check: ``spaces``.

    ``on_space`` is called when a disk that was full has space again.
    """

    def __init__(self, state: Path, store: str, *, emit: Callable[..., None]) -> None:
        """Check nothing yet.

        Args:
            state: State folder of the platform.
            store: Location of its object store, such as ``dir:PATH``.
            emit: Called with an event and its details: ``disk-full``, ``disk-low`` and ``disk-ok`` when the
                level of a disk changes, ``not-written`` when a file cannot be written.
        """
        self.spaces: list[DiskSpace] = []
        self.on_space: Callable[[], None] = lambda: None
        self._state = state
        self._folders = folders_of(state, store)
        self._emit = emit
        self._levels: dict[str, Level] = {}
        self._unwritten: dict[Path, str] = {}

    def is_full(self) -> bool:
        """Check the disks now, emit changed levels, and return whether that of the state folder is full."""
        with contextlib.suppress(OSError):
            self._take(disk_spaces(self._folders))
        return self._levels.get(str(self._state)) == "full"

    def prepare(self) -> None:
        """Create missing files of roster and deny list, and the reserve, as far as there is space."""
        self.is_full()
        try:
            access_control_store(self._state).create_missing()
        except RsePfError as error:
            self._emit("not-written", reason=error.message)
        self._refill()

    async def watch(self) -> None:
        """Check the disks every `LOOK_S` until cancelled.

        While the state folder's disk is not full, files that `write` could not write are written, and the
        reserve is refilled.
        """
        while True:
            await asyncio.sleep(LOOK_S)
            with contextlib.suppress(OSError):  # the folder was removed
                self._take(await asyncio.to_thread(disk_spaces, self._folders))
            if self._levels.get(str(self._state)) != "full":
                for path, text in tuple(self._unwritten.items()):
                    self.write(path, text)
                await asyncio.to_thread(self._refill)

    def write(self, path: Path, text: str) -> None:
        """Replace the file *path* by *text* in one step, now or once that is possible; never raises OSError.

        The first failure emits ``not-written``; `watch` tries again, with the newest text for *path*.
        """
        try:
            replace_file(path, text)
            self._unwritten.pop(path, None)
        except OSError as error:
            if path not in self._unwritten:
                self._emit("not-written", reason=f"{path.name} cannot be written yet: {error.strerror}")
            self._unwritten[path] = text

    def document(self) -> list[dict[str, Any]]:
        """Return the disks at the last check as plain JSON values."""
        return [asdict(space) for space in self.spaces]

    def _take(self, spaces: list[DiskSpace]) -> None:
        """Store the newest state of the disks, and emit an event for each level that changed."""
        self.spaces = spaces
        for space in spaces:
            before = self._levels.get(space.folder, "ok")
            level = disk_level(space.free_bytes, space.total_bytes, before)
            self._levels[space.folder] = level
            if level != before:
                free, total = space.free_bytes, space.total_bytes
                self._emit(
                    f"disk-{level}", folder=space.folder, free_bytes=free, total_bytes=total,
                    reason=disk_line(space) or f"{free // _MIB} MiB are free on the disk of {space.folder}",
                )  # fmt: skip
                if before == "full":
                    self.on_space()

    def _refill(self) -> None:
        """Refill the reserve for the present size of roster and deny list."""
        with contextlib.suppress(OSError):  # the disk is full again, or the folder was removed
            sizes = ((self._state / name).stat().st_size for name in (ROBOTS_NAME, DENY_NAME))
            _reserve(self._state).fill(sum(sizes))


def _reserve(state: Path) -> DiskReserve:
    return DiskReserve(state / "disk-reserve")
