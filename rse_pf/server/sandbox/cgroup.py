"""Give each sandbox a cgroup with limits on memory, processes and CPU, where this process may make one.

A cgroup is made below the cgroup of this process only, and only in a hierarchy that belongs to the platform:
its cgroup is the root (a container's own), or a service manager has delegated it (systemd: `Delegate=yes`).
Cgroups of others are neither changed nor entered.  Sandboxes of a machine without such a hierarchy are held
by `limit_resources` and `watcher`.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

__all__ = ["CGROUP_CONTROLLERS", "Cgroups", "Hierarchy", "own_hierarchies"]

CGROUP_CONTROLLERS = ("memory", "pids", "cpu")
"""What a cgroup of a sandbox limits, where the hierarchy offers it."""

_PREFIX = "rse-pf-sandbox-"
_SERVER_GROUP = "rse-pf-server"
"""Cgroup (v2) of the server's own processes: one that holds processes cannot hold cgroups with limits."""
_DELEGATE_ATTRIBUTES = ("user.delegate", "trusted.delegate")
_SERVER_WEIGHT = 400  # CPU weight of the server: on a busy core it gets four times the time of one sandbox
_SANDBOX_WEIGHT = 100  # CPU weight of one sandbox, however many threads it has


@dataclass(frozen=True, slots=True)
class Hierarchy:
    """A folder below which sandboxes get cgroups; ``version`` is that of its interface, 1 or 2."""

    folder: Path
    version: int
    controllers: tuple[str, ...]


def own_hierarchies(proc: Path = Path("/proc/self")) -> list[Hierarchy]:
    """Return the hierarchies in which this process may make cgroups; empty if there are none.

    Args:
        proc: Folder of this process in procfs.
    """
    try:
        memberships = (proc / "cgroup").read_text().splitlines()
        mounts = (proc / "mountinfo").read_text().splitlines()
    except OSError:
        return []
    hierarchies: list[Hierarchy] = []
    for line in memberships:
        _, names, path = line.split(":", 2)
        version = 1 if names else 2
        place = _place(mounts, version, names.split(","), path)
        if place is None:
            continue
        if place.name == _SERVER_GROUP:  # this process was moved there by an earlier sandbox process
            place = place.parent
        elif path != "/" and not _is_delegated(place):
            continue
        offered = names.split(",") if version == 1 else _words(place / "cgroup.controllers")
        usable = tuple(name for name in CGROUP_CONTROLLERS if name in offered)
        if usable and os.access(place, os.W_OK):
            hierarchies.append(Hierarchy(place, version, usable))
    return hierarchies


class Cgroups:
    """The cgroups of the sandboxes of one zygote; ``controllers`` names what they limit."""

    def __init__(
        self, hierarchies: Sequence[Hierarchy], *, owner: int, memory_bytes: int, max_threads: int
    ) -> None:
        """Keep the limits; `prepare` makes the first change.

        Args:
            hierarchies: Where cgroups are made.
            owner: Process whose sandboxes these are; part of the names.
            memory_bytes: Memory of one sandbox, its scratch folder and what the kernel keeps for it included.
            max_threads: Threads and processes of one sandbox.
        """
        self.controllers: tuple[str, ...] = ()
        self._hierarchies = list(hierarchies)
        self._owner = owner
        self._memory_bytes = memory_bytes
        self._max_threads = max_threads
        self._unremoved: set[Path] = set()

    def prepare(self) -> None:
        """Remove what crashed servers left, and drop every hierarchy that does not take a cgroup."""
        usable = []
        for hierarchy in self._hierarchies:
            _remove_leftovers(hierarchy.folder)
            try:
                if hierarchy.version == 2:
                    _enable(hierarchy)
                trial = self._folder(hierarchy, 0)
                self._make(hierarchy, trial)
                trial.rmdir()
            except OSError:
                with contextlib.suppress(OSError):
                    self._folder(hierarchy, 0).rmdir()
                continue
            usable.append(hierarchy)
        self._hierarchies = usable
        held = {name for hierarchy in usable for name in hierarchy.controllers}
        self.controllers = tuple(name for name in CGROUP_CONTROLLERS if name in held)

    def add(self, number: int, pid: int) -> bool:
        """Move process *pid* into the cgroups of sandbox *number*; return False if one of them failed."""
        try:
            for hierarchy in self._hierarchies:
                folder = self._folder(hierarchy, number)
                self._make(hierarchy, folder)
                _write(folder / "cgroup.procs", pid)
        except OSError:
            return False
        return True

    def remove(self, number: int) -> str:
        """Remove the cgroups of a sandbox that ended; return the limit that it ended for, or ""."""
        why = ""
        for hierarchy in self._hierarchies:
            folder = self._folder(hierarchy, number)
            if "memory" in hierarchy.controllers and _oom_kills(folder, hierarchy.version):
                why = f"it used more than {self._memory_bytes} bytes of memory"
            self._unremoved.add(folder)
        self._remove_ended()
        return why

    def close(self) -> None:
        """Try once more to remove what could not be removed."""
        self._remove_ended()

    def _remove_ended(self) -> None:
        for folder in list(self._unremoved):
            try:
                folder.rmdir()
            except FileNotFoundError:
                pass
            except OSError:
                continue  # a process is still ending in it; the next removal tries again
            self._unremoved.discard(folder)

    def _folder(self, hierarchy: Hierarchy, number: int) -> Path:
        return hierarchy.folder / f"{_PREFIX}{self._owner}-{number}"

    def _make(self, hierarchy: Hierarchy, folder: Path) -> None:
        folder.mkdir()
        for name, value, is_required in self._limits(hierarchy):
            try:
                _write(folder / name, value)
            except OSError:  # swap need not be counted on this machine
                if is_required:
                    raise

    def _limits(self, hierarchy: Hierarchy) -> Iterable[tuple[str, int, bool]]:
        """Yield file, value, and whether a cgroup without it is no use."""
        is_v1 = hierarchy.version == 1
        if "memory" in hierarchy.controllers and is_v1:
            yield "memory.limit_in_bytes", self._memory_bytes, True
            yield "memory.memsw.limit_in_bytes", self._memory_bytes, False
        elif "memory" in hierarchy.controllers:
            yield "memory.max", self._memory_bytes, True
            yield "memory.swap.max", 0, False
            yield "memory.oom.group", 1, False
        if "pids" in hierarchy.controllers:
            yield "pids.max", self._max_threads, True
        if "cpu" in hierarchy.controllers and not is_v1:
            yield "cpu.weight", _SANDBOX_WEIGHT, True


def _place(mounts: Sequence[str], version: int, controllers: Sequence[str], path: str) -> Path | None:
    """Return the folder of cgroup *path*; None if its hierarchy is not mounted here."""
    for line in mounts:
        before, _, after = line.partition(" - ")
        kind, _, options = after.split(" ", 2)
        root, mount_point = before.split(" ")[3:5]
        if kind != ("cgroup" if version == 1 else "cgroup2"):
            continue
        if version == 1 and not set(controllers) <= set(options.split(",")):
            continue
        if path == root or root == "/" or path.startswith(root + "/"):
            below = path[len(root) :] if root != "/" else path
            return Path(mount_point) / below.lstrip("/")
    return None


def _is_delegated(folder: Path) -> bool:
    """Return whether a service manager gave this cgroup, and what is below it, to its processes."""
    for name in _DELEGATE_ATTRIBUTES:
        with contextlib.suppress(OSError):
            if os.getxattr(folder, name) == b"1":
                return True
    return False


def _enable(hierarchy: Hierarchy) -> None:
    """Enable the controllers of *hierarchy* below it; move the server's processes out of its folder.

    Raises:
        OSError: Refused, or the processes of a cgroup that was not delegated would have to be moved.
    """
    folder = hierarchy.folder
    control = folder / "cgroup.subtree_control"
    missing = [name for name in hierarchy.controllers if name not in _words(control)]
    if not missing:
        return
    has_parent = (folder / "cgroup.type").exists()
    if has_parent:
        if not _is_delegated(folder):
            raise PermissionError(f"{folder} is not delegated")
        server = folder / _SERVER_GROUP
        server.mkdir(exist_ok=True)
        for pid in _words(folder / "cgroup.procs"):
            with contextlib.suppress(ProcessLookupError):
                _write(server / "cgroup.procs", pid)
    for name in missing:
        _write(control, f"+{name}")
    if has_parent and "cpu" in hierarchy.controllers:
        _write(folder / _SERVER_GROUP / "cpu.weight", _SERVER_WEIGHT)


def _remove_leftovers(folder: Path) -> None:
    """Remove the empty cgroups of zygotes that have exited."""
    for cgroup in folder.glob(f"{_PREFIX}*-*"):
        owner = cgroup.name.removeprefix(_PREFIX).partition("-")[0]
        if owner.isdigit() and not Path("/proc", owner).exists():
            with contextlib.suppress(OSError):
                cgroup.rmdir()


def _oom_kills(folder: Path, version: int) -> int:
    try:
        lines = (folder / ("memory.oom_control" if version == 1 else "memory.events")).read_text()
    except OSError:
        return 0
    counts = dict(line.split(" ", 1) for line in lines.splitlines())
    return int(counts.get("oom_kill", 0))


def _words(file: Path) -> list[str]:
    try:
        return file.read_text().split()
    except OSError:
        return []


def _write(file: Path, value: int | str) -> None:
    with file.open("w") as opened:
        opened.write(str(value))
