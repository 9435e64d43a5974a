"""Limit memory, processes and CPU of each sandbox by a Linux cgroup, where the zygote may make cgroups.

The zygote, which is the parent process of all sandboxes of a worker, makes cgroups only below its own cgroup,
and only in a hierarchy that belongs to the platform: its own cgroup is the root of the hierarchy (as in a
container), or a service manager has delegated it (systemd: ``Delegate=yes``).  Cgroups of other programs are
neither changed nor entered.  On a machine without such a hierarchy, `isolation.limit_resources` and `watcher`
limit the sandboxes instead.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

__all__ = ["CGROUP_CONTROLLERS", "Cgroups", "Hierarchy", "own_hierarchies"]

CGROUP_CONTROLLERS = ("memory", "pids", "cpu")
"""Names of the cgroup controllers that limit a sandbox; a hierarchy may offer only some of them."""

_PREFIX = "rse-pf-sandbox-"  # start of the names of the sandboxes' cgroups, then zygote's pid and a number
_SERVER_GROUP = "rse-pf-server"
"""Name of the cgroup (version 2) into which the server's own processes are moved before sandboxes get theirs:
a cgroup that contains processes cannot have child cgroups with limits."""
_DELEGATE_ATTRIBUTES = ("user.delegate", "trusted.delegate")  # set to 1 by systemd on a delegated cgroup
_SERVER_WEIGHT = 400  # CPU weight of the server: on a busy core it gets four times the time of one sandbox
_SANDBOX_WEIGHT = 100  # CPU weight of one sandbox, however many threads it has


@dataclass(frozen=True, slots=True)
class Hierarchy:
    """A mounted cgroup hierarchy in which the zygote can limit sandboxes.

    Attributes:
        folder: Folder below which each sandbox gets a cgroup.
        version: Version of the kernel's cgroup interface, 1 or 2.
        controllers: Those of `CGROUP_CONTROLLERS` that this hierarchy offers.
    """

    folder: Path
    version: int
    controllers: tuple[str, ...]


def own_hierarchies(proc: Path = Path("/proc/self")) -> list[Hierarchy]:
    """Return the cgroup hierarchies in which this process may make cgroups; an empty list if there are none.

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
        folder = _cgroup_folder(mounts, version, names.split(","), path)
        if folder is None:
            continue
        if folder.name == _SERVER_GROUP:  # the zygote of another worker moved this process there (`_enable`)
            folder = folder.parent
        elif path != "/" and not _is_delegated(folder):
            continue
        offered = names.split(",") if version == 1 else _words(folder / "cgroup.controllers")
        usable = tuple(name for name in CGROUP_CONTROLLERS if name in offered)
        if usable and os.access(folder, os.W_OK):
            hierarchies.append(Hierarchy(folder, version, usable))
    return hierarchies


class Cgroups:
    """The cgroups of the sandboxes of one zygote.

    Attributes:
        controllers: Controllers that limit each sandbox; empty before `prepare`, or if no cgroup can be made.
    """

    def __init__(
        self, hierarchies: Sequence[Hierarchy], *, owner: int, memory_bytes: int, max_threads: int
    ) -> None:
        """Store the limits; nothing is changed before `prepare`.

        Args:
            hierarchies: Hierarchies in which each sandbox gets a cgroup, from `own_hierarchies`.
            owner: Process id of the zygote.  It is part of the names of the cgroups, so that those of a
                zygote that has exited are recognised and removed.
            memory_bytes: Limit of the memory of one sandbox, including its scratch folder and the kernel's
                memory for it; Linux kills the sandbox above this limit.
            max_threads: Limit of the threads and processes of one sandbox together.
        """
        self.controllers: tuple[str, ...] = ()
        self._hierarchies = list(hierarchies)
        self._owner = owner
        self._memory_bytes = memory_bytes
        self._max_threads = max_threads
        self._unremoved: set[Path] = set()

    def prepare(self) -> None:
        """Try every hierarchy and keep those in which a cgroup can be made; set ``controllers``.

        Empty cgroups of zygotes that have exited are removed.  In a delegated hierarchy of version 2, the
        server's own processes are moved into the cgroup `_SERVER_GROUP`.
        """
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
        offered = {name for hierarchy in usable for name in hierarchy.controllers}
        self.controllers = tuple(name for name in CGROUP_CONTROLLERS if name in offered)

    def add(self, number: int, pid: int) -> bool:
        """Make the cgroups of sandbox *number*, and move its process *pid* into them.

        Returns:
            True, also without any hierarchy; False if a cgroup could not be made, limited or entered.  The
            caller then kills the sandbox, and removes its cgroups with `remove`.
        """
        try:
            for hierarchy in self._hierarchies:
                folder = self._folder(hierarchy, number)
                self._make(hierarchy, folder)
                _write(folder / "cgroup.procs", pid)
        except OSError:
            return False
        return True

    def remove(self, number: int) -> str:
        """Remove the cgroups of sandbox *number*, whose process has exited.

        A cgroup that cannot be removed yet is removed by a later call.

        Returns:
            A sentence that names the memory limit, if Linux killed a process of the sandbox because of that
            limit; otherwise "".
        """
        why = ""
        for hierarchy in self._hierarchies:
            folder = self._folder(hierarchy, number)
            if "memory" in hierarchy.controllers and _oom_kills(folder, hierarchy.version):
                why = f"it used more than {self._memory_bytes} bytes of memory"
            self._unremoved.add(folder)
        self._remove_ended()
        return why

    def close(self) -> None:
        """Try once more to remove the cgroups of exited sandboxes that could not be removed before."""
        self._remove_ended()

    def _remove_ended(self) -> None:
        for folder in list(self._unremoved):
            try:
                folder.rmdir()
            except FileNotFoundError:
                pass
            except OSError:
                continue  # a process in this cgroup has not exited yet; the next removal tries again
            self._unremoved.discard(folder)

    def _folder(self, hierarchy: Hierarchy, number: int) -> Path:
        return hierarchy.folder / f"{_PREFIX}{self._owner}-{number}"

    def _make(self, hierarchy: Hierarchy, folder: Path) -> None:
        folder.mkdir()
        for name, value, is_required in self._limits(hierarchy):
            try:
                _write(folder / name, value)
            except OSError:  # for instance, this kernel does not count swap
                if is_required:
                    raise

    def _limits(self, hierarchy: Hierarchy) -> Iterable[tuple[str, int, bool]]:
        """Yield the limits of a sandbox in *hierarchy*: file of the cgroup, value, whether it is required.

        If a required file cannot be written, the hierarchy is not used.
        """
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


def _cgroup_folder(mounts: Sequence[str], version: int, controllers: Sequence[str], path: str) -> Path | None:
    """Return the folder in which the cgroup *path* is mounted; None if its hierarchy is not mounted.

    Args:
        mounts: Lines of ``/proc/self/mountinfo``.
        version: Version of the cgroup interface, 1 or 2.
        controllers: Controllers of the hierarchy (version 1 only).
        path: Path of the cgroup in its hierarchy, from ``/proc/self/cgroup``.
    """
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
    """Return whether systemd has delegated the cgroup *folder* to the processes in it (``Delegate=yes``)."""
    for name in _DELEGATE_ATTRIBUTES:
        with contextlib.suppress(OSError):
            if os.getxattr(folder, name) == b"1":
                return True
    return False


def _enable(hierarchy: Hierarchy) -> None:
    """Enable the controllers of a version 2 hierarchy for the cgroups below its folder.

    Unless the folder is the root of the hierarchy, all processes in it are moved to the cgroup
    `_SERVER_GROUP` first.  Does nothing if all controllers are enabled already.

    Raises:
        OSError: The kernel refused the change, or the folder is neither the root nor delegated.
    """
    folder = hierarchy.folder
    control = folder / "cgroup.subtree_control"
    missing = [name for name in hierarchy.controllers if name not in _words(control)]
    if not missing:
        return
    has_parent = (folder / "cgroup.type").exists()
    if has_parent:
        if not _is_delegated(folder):
            raise PermissionError(f"systemd has not delegated the cgroup {folder}")
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
    """Remove the empty cgroups below *folder* that were made by zygotes that have exited."""
    for cgroup in folder.glob(f"{_PREFIX}*-*"):
        owner = cgroup.name.removeprefix(_PREFIX).partition("-")[0]
        if owner.isdigit() and not Path("/proc", owner).exists():
            with contextlib.suppress(OSError):
                cgroup.rmdir()


def _oom_kills(folder: Path, version: int) -> int:
    """Return how many processes of a cgroup Linux killed for its memory limit; 0 if that is not known."""
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
