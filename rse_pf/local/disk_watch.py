"""Watch the disks of a local platform: warn before one is full, and keep the reserve of the control files.

Servers are neither started nor replaced while the disk of the state folder is full: their logs and
announcements could not be written.
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
from rse_pf.disk_reserve import SPARE_BYTES, SpareFiles, is_full
from rse_pf.errors import RsePfError
from rse_pf.object_store import DirectoryStore

__all__ = [
    "DISK_WARNING_BYTES",
    "LOOK_S", "DiskSpace", "DiskWatch", "access_control_store", "disk_level", "disk_line", "disk_spaces",
    "folders_of",
]  # fmt: skip

Level = Literal["ok", "low", "full"]

LOOK_S = 0.5
"""Time between two looks; what waits for space goes on so soon after there is some."""
DISK_WARNING_BYTES = 1 << 30
"""Less free space than this on the disk of the state folder or of the store is reported."""
_FULL_BYTES = 1 << 20
_HYSTERESIS = 1.1
_DIRECTORY = "dir:"
_MIB = 1 << 20


@dataclass(frozen=True, slots=True, kw_only=True)
class DiskSpace:
    """The file system of *folder*, in bytes; what only root may still use is not free."""

    folder: str
    free_bytes: int
    total_bytes: int
    level: Level


def disk_level(free_bytes: int, low_bytes: int, before: Level = "ok") -> Level:
    """Return whether a disk is full or nearly so; it has to gain a tenth before it is called better."""
    if free_bytes < _FULL_BYTES * (_HYSTERESIS if before == "full" else 1):
        return "full"
    return "low" if free_bytes < low_bytes * (1 if before == "ok" else _HYSTERESIS) else "ok"


def folders_of(state: Path, store: str) -> list[Path]:
    """Return the folders on which a platform depends: its state, and its store if that is a folder."""
    return [state] + ([Path(store.removeprefix(_DIRECTORY))] if store.startswith(_DIRECTORY) else [])


def disk_spaces(folders: Iterable[Path], low_bytes: int) -> list[DiskSpace]:
    """Return the file systems of *folders*, each once; a folder that is missing counts as its parent."""
    spaces: dict[int, DiskSpace] = {}
    for folder in folders:
        there = next(path for path in (folder, *folder.parents) if path.exists())
        about = os.statvfs(there)
        free = about.f_bavail * about.f_frsize
        space = DiskSpace(
            folder=str(folder),
            free_bytes=free,
            total_bytes=about.f_blocks * about.f_frsize,
            level=disk_level(free, low_bytes),
        )
        spaces.setdefault(there.stat().st_dev, space)
    return list(spaces.values())


def disk_line(space: DiskSpace) -> str:
    """Return *space* as a line for a person; empty if there is enough."""
    sizes = f"{space.free_bytes // _MIB} of {space.total_bytes // _MIB} MiB"
    sentence = f"{sizes} are free on the disk of {space.folder}"
    return {
        "ok": "",
        "low": f"little space: {sentence}",
        "full": f"disk full: {sentence}; servers are not started, and little is recorded: free some space",
    }[space.level]


def access_control_store(state: Path) -> AccessControlStore:
    """Return the roster and the deny list of the platform in *state*; they can be changed on a full disk."""
    return AccessControlStore(DirectoryStore(state, _spares(state)))


class DiskWatch:
    """The disks of one platform, as they were at the last look."""

    def __init__(self, state: Path, store: str, *, emit: Callable[..., None]) -> None:
        """Look at nothing yet.

        Args:
            state: Folder of the platform.
            store: Location of its store, such as ``dir:PATH``.
            emit: Gets ``disk-full``, ``disk-low`` and ``disk-ok``, with ``reason`` and the bytes.
        """
        self.spaces: list[DiskSpace] = []
        self.on_space: Callable[[], None] = lambda: None
        self._state = state
        self._folders = folders_of(state, store)
        self._emit = emit
        self._levels: dict[str, Level] = {}
        self._reserve_problem = ""

    def is_full(self) -> bool:
        """Return whether the disk of the state folder is full now."""
        with contextlib.suppress(OSError):
            self._take(disk_spaces(self._folders, DISK_WARNING_BYTES))
        return self._levels.get(str(self._state)) == "full"

    def prepare(self) -> None:
        """Make the files that an operator changes, and the reserve, as far as there is space."""
        self.is_full()
        try:
            access_control_store(self._state).create_missing()
        except RsePfError as error:
            self._emit("not-written", reason=error.message)
        self._refill()

    async def watch(self) -> None:
        """Look until cancelled; make the reserve anew whenever there is space."""
        while True:
            await asyncio.sleep(LOOK_S)
            with contextlib.suppress(OSError):  # the folder was removed
                self._take(await asyncio.to_thread(disk_spaces, self._folders, DISK_WARNING_BYTES))
            if self._levels.get(str(self._state)) != "full":
                await asyncio.to_thread(self._refill)

    def document(self) -> list[dict[str, Any]]:
        """Return the disks as plain JSON values."""
        return [asdict(space) for space in self.spaces]

    def _take(self, spaces: list[DiskSpace]) -> None:
        self.spaces = spaces
        for space in spaces:
            before = self._levels.get(space.folder, "ok")
            level = disk_level(space.free_bytes, DISK_WARNING_BYTES, before)
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
        sizes = [2 * _size(self._state / name) for name in (DENY_NAME, ROBOTS_NAME)]
        try:
            _spares(self._state).refill(max(SPARE_BYTES, *sizes))
            self._reserve_problem = ""
        except OSError as error:
            problem = f"no reserve for a full disk: {error.strerror}"
            if not is_full(error) and problem != self._reserve_problem:
                self._reserve_problem = problem
                self._emit("not-written", reason=problem)


def _spares(state: Path) -> SpareFiles:
    return SpareFiles(state / "reserve")


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0
