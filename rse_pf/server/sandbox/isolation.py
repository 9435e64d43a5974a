"""Isolate the calling process: namespaces, a root folder of its own, limits, no privileges, seccomp.

Each function applies one means of isolation to the calling process by Linux system calls; the process cannot
undo it.  A function whose system call the kernel refuses raises `IsolationUnavailable`.
Source: the paper's Fig. 4 gives each robot an isolated environment; it does not say by which means.
"""

from __future__ import annotations

import ctypes
import os
import resource
import struct
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path

from rse_pf.processes.linux import (
    PR_CAPBSET_DROP,
    PR_SET_DUMPABLE,
    PR_SET_NO_NEW_PRIVS,
    PR_SET_SECCOMP,
    prctl,
)
from rse_pf.server.sandbox.seccomp import LANGUAGES, MACHINES, filter_program

__all__ = [
    "ISOLATION",
    "IsolationUnavailable",
    "enter_namespaces",
    "forbid_system_calls",
    "give_up_privileges",
    "limit_resources",
    "make_root",
    "missing_isolation",
]

ISOLATION = ("namespaces", "root", "privileges", "seccomp")
"""Names of the means of isolation that a kernel or an account may lack.  Limits on resources, which
`limit_resources` sets, are not among them, because every kernel has them."""

_LIBC = ctypes.CDLL(None, use_errno=True)

# Flags of unshare(2), linux/sched.h.
_CLONE_NEWNS = 0x00020000
_CLONE_NEWUTS = 0x04000000
_CLONE_NEWIPC = 0x08000000
_CLONE_NEWUSER = 0x10000000
_CLONE_NEWPID = 0x20000000
_CLONE_NEWNET = 0x40000000
_MOUNT_POINTS = tuple(map(Path, ("/mnt", "/media", "/srv", "/opt", "/tmp", "/run")))
"""Folders on one of which the root of a sandbox is mounted: the first that no sandbox has to read."""
# Flags of mount(2), linux/mount.h.
_MS_NOSUID = 0x2
_MS_NODEV = 0x4
_MS_BIND = 0x1000
_MS_REC = 0x4000
_MS_PRIVATE = 1 << 18
_MNT_DETACH = 2
_AT_RECURSIVE = 0x8000
# Attributes of mount_setattr(2), linux/mount.h.
_MOUNT_ATTR_RDONLY = 0x1
_MOUNT_ATTR_NOSUID = 0x2
_MOUNT_ATTR_NODEV = 0x4
_SYS_MOUNT_SETATTR = 442  # number of the system call on every machine
_SYS_PIVOT_ROOT = {"x86_64": 155, "aarch64": 41}  # number of the system call by machine
_SECCOMP_MODE_FILTER = 2  # mode of prctl(PR_SET_SECCOMP), linux/seccomp.h
_CAP_VERSION_3 = 0x20080522  # version of the arguments of capset(2), linux/capability.h
_LAST_CAP = 63  # highest number of a capability that the kernel interface allows
_MAX_THREADS = 64  # most threads of one sandbox, so that a service cannot exhaust the machine's process ids
_ROOT_INODES = 4096  # most files and folders in the root of a sandbox, most of which are mount points
_BYTES_PER_INODE = 4096  # one file per 4 KiB of the scratch folder, so that small files fill no kernel memory


class IsolationUnavailable(Exception):
    """Raised if this kernel or account lacks a means of isolation.

    ``args`` are the name of the means, from `ISOLATION`, and the reason.
    """


def missing_isolation(tries: Sequence[Callable[[], None]]) -> list[str]:
    """Try every means of isolation in a child process of its own, and return the names of those that fail.

    Args:
        tries: For each name of `ISOLATION`, in that order, a function that applies this means.
    """
    missing = []
    for name, isolate in zip(ISOLATION, tries, strict=True):
        child = os.fork()
        if child == 0:
            try:
                isolate()
            except BaseException:  # noqa: BLE001  exit code 1 reports the failure to the parent
                os._exit(1)
            os._exit(0)
        if os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) != 0:
            missing.append(name)
    return missing


def enter_namespaces() -> None:
    """Enter new Linux namespaces for network, mounts, processes, IPC and host name.

    A process that does not run as root also enters a user namespace of its own, in which it holds the
    capabilities to mount a root.  Only children that are forked from now on are in the namespace of
    processes.

    Raises:
        IsolationUnavailable: The kernel refuses namespaces to this account.
    """
    flags = _CLONE_NEWNS | _CLONE_NEWPID | _CLONE_NEWNET | _CLONE_NEWIPC | _CLONE_NEWUTS
    uid, gid = os.getuid(), os.getgid()
    if uid != 0:
        flags |= _CLONE_NEWUSER
    _call("namespaces", _LIBC.unshare, flags)
    if uid != 0:
        try:
            Path("/proc/self/setgroups").write_text("deny")
            Path("/proc/self/uid_map").write_text(f"{uid} {uid} 1")
            Path("/proc/self/gid_map").write_text(f"{gid} {gid} 1")
        except OSError as error:
            raise IsolationUnavailable("namespaces", str(error)) from error


def make_root(
    readable: Sequence[Path], scratch_bytes: int, owner: int, copies: Mapping[Path, Path] | None = None
) -> None:
    """Make a new root folder for this process and enter it; call `enter_namespaces` first.

    The root contains the *readable* paths and the *copies*, all read-only, the devices ``null``, ``zero`` and
    ``urandom``, and an empty folder ``/scratch`` in memory, which becomes the current folder.  Unless one of
    these paths lies in ``/tmp``, ``/tmp`` is a symbolic link to ``/scratch``.

    Args:
        readable: Files and folders that the process can read under their own paths; missing ones are left
            out.
        scratch_bytes: Size of ``/scratch`` in bytes.  It can hold one file for every 4,096 bytes of its size.
        owner: User id that owns ``/scratch``.
        copies: For each path, the folder whose content is seen there instead.

    Raises:
        IsolationUnavailable: The kernel refuses to mount, or each of `_MOUNT_POINTS` has readable paths.
    """
    copies = copies or {}
    _mount(None, "/", None, _MS_REC | _MS_PRIVATE, None)
    base = _free_mount_point([*readable, *copies, *copies.values()])
    _mount("root", base, "tmpfs", _MS_NOSUID | _MS_NODEV, f"size=1m,nr_inodes={_ROOT_INODES},mode=755")
    for path in (*_outermost(readable), *(Path("/dev") / name for name in ("null", "zero", "urandom"))):
        _bind(path, path, base)
    for place, copy in copies.items():
        _bind(copy, place, base)
    scratch = base + "/scratch"
    os.mkdir(scratch)
    inodes = max(1, scratch_bytes // _BYTES_PER_INODE)
    options = f"size={scratch_bytes},nr_inodes={inodes},mode=700"
    _mount("scratch", scratch, "tmpfs", _MS_NOSUID | _MS_NODEV, options)
    os.chown(scratch, owner, owner if os.getuid() == 0 else os.getgid())
    if not os.path.lexists(base + "/tmp"):
        os.symlink("scratch", base + "/tmp")
    old = base + "/old"
    os.mkdir(old)
    machine = os.uname().machine
    number = _SYS_PIVOT_ROOT.get(machine)
    if number is None:
        raise IsolationUnavailable("root", f"pivot_root is unknown on {machine}")
    _call("root", _LIBC.syscall, number, base.encode(), old.encode())
    os.chdir("/")
    _call("root", _LIBC.umount2, b"/old", _MNT_DETACH)
    os.rmdir("/old")
    _read_only("/", recursive=False)
    os.chdir("/scratch")


def limit_resources(memory_bytes: int, scratch_bytes: int, *, alone: bool) -> None:
    """Limit address space, file size, open files (64) and threads (64) of this process; forbid core files.

    The number of processes is not limited here, because seccomp forbids new ones.  Neither is CPU time: a
    sandbox is killed some time after the deadline of its command.

    Args:
        memory_bytes: Limit in bytes of address space and scratch folder together.
        scratch_bytes: Size in bytes of the scratch folder, which is also the limit of one file.
        alone: Whether the user id or the user namespace belongs to this sandbox alone.  Threads are limited
            only then, because Linux counts the threads of a user, not of a process.
    """
    if alone:
        resource.setrlimit(resource.RLIMIT_NPROC, (_MAX_THREADS, _MAX_THREADS))
    for which, limit in (
        (resource.RLIMIT_AS, memory_bytes - scratch_bytes),
        (resource.RLIMIT_FSIZE, scratch_bytes),
        (resource.RLIMIT_NOFILE, 64),
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_MEMLOCK, 0),
        (resource.RLIMIT_MSGQUEUE, 0),
    ):
        resource.setrlimit(which, (limit, limit))


def give_up_privileges(uid: int | None) -> None:
    """Change to user *uid*, drop all capabilities, and forbid to gain any again by set-user-id programs.

    Files that the process makes from now on are readable by *uid* alone, and other processes of this user
    cannot trace the process.

    Args:
        uid: User and group id to change to, which only root can; None keeps the user.

    Raises:
        IsolationUnavailable: The kernel refuses a change of the capabilities.
    """
    for capability in range(_LAST_CAP + 1):
        if prctl(PR_CAPBSET_DROP, capability) != 0:
            break  # no such capability, or no permission; capset below removes all capabilities anyway
    if uid is not None:
        os.setgroups([])
        os.setresgid(uid, uid, uid)
        os.setresuid(uid, uid, uid)
    header = struct.pack("=Ii", _CAP_VERSION_3, 0)
    _call("privileges", _LIBC.capset, header, b"\0" * 24)
    _call("privileges", prctl, PR_SET_NO_NEW_PRIVS, 1)
    prctl(PR_SET_DUMPABLE, 0)
    os.umask(0o077)


def forbid_system_calls(languages: Collection[str] = LANGUAGES) -> None:
    """Refuse from now on every system call that services in *languages* do not need (`seccomp`).

    Raises:
        IsolationUnavailable: There is no filter for this machine, or the kernel does not accept filters.
    """
    machine = os.uname().machine
    if machine not in MACHINES or struct.calcsize("P") != 8:
        raise IsolationUnavailable("seccomp", f"no filter is written for {machine}")
    code = filter_program(languages, machine, os.getpid())
    buffer = ctypes.create_string_buffer(code, len(code))
    program = struct.pack("@HxxxxxxP", len(code) // 8, ctypes.addressof(buffer))
    _call("seccomp", prctl, PR_SET_NO_NEW_PRIVS, 1)
    _call("seccomp", prctl, PR_SET_SECCOMP, _SECCOMP_MODE_FILTER, program)


def _free_mount_point(readable: Sequence[Path]) -> str:
    """Return the first folder of `_MOUNT_POINTS` that exists and has no *readable* path in it.

    Raises:
        IsolationUnavailable: There is no such folder.
    """
    for place in _MOUNT_POINTS:
        if place.is_dir() and not any(Path(path).is_relative_to(place) for path in readable):
            return str(place)
    raise IsolationUnavailable("root", f"none of {', '.join(map(str, _MOUNT_POINTS))} is free")


def _outermost(paths: Sequence[Path]) -> list[Path]:
    """Return *paths* without those that lie inside another of them, ordered by depth.

    A path below a symbolic link among *paths* is kept, because a link is copied and not followed.
    """
    chosen: list[str] = []
    inside: tuple[str, ...] = ()
    for path in sorted({os.path.normpath(path) for path in paths}, key=lambda name: name.count("/")):
        if not path.startswith(inside):
            chosen.append(path)
            if not os.path.islink(path):
                inside += (path + "/",)
    return [Path(path) for path in chosen]


def _bind(path: Path, place: Path, base: str) -> None:
    """Mount *path* read-only at *place* in the new root folder *base*; copy it if it is a symbolic link.

    Does nothing if *path* does not exist.
    """
    target = base + str(place)
    if path.is_symlink():
        os.makedirs(os.path.dirname(target), mode=0o755, exist_ok=True)
        if not os.path.lexists(target):
            os.symlink(os.readlink(path), target)
        return
    if not path.exists():
        return
    if path.is_dir():
        os.makedirs(target, mode=0o755, exist_ok=True)
    else:
        os.makedirs(os.path.dirname(target), mode=0o755, exist_ok=True)
        os.close(os.open(target, os.O_CREAT | os.O_WRONLY, 0o644))
    _mount(str(path), target, None, _MS_BIND | _MS_REC, None)
    if not str(path).startswith("/dev/"):
        _read_only(target, recursive=True)


def _read_only(path: str, *, recursive: bool) -> None:
    """Make the mount at *path* read-only, and ignore device files and set-user-id bits in it."""
    attributes = struct.pack("=QQQQ", _MOUNT_ATTR_RDONLY | _MOUNT_ATTR_NOSUID | _MOUNT_ATTR_NODEV, 0, 0, 0)
    flags = _AT_RECURSIVE if recursive else 0
    _call("root", _LIBC.syscall, _SYS_MOUNT_SETATTR, -1, path.encode(), flags, attributes, len(attributes))


def _mount(source: str | None, target: str, kind: str | None, flags: int, data: str | None) -> None:
    texts = [None if text is None else text.encode() for text in (source, target, kind, data)]
    _call("root", _LIBC.mount, texts[0], texts[1], texts[2], ctypes.c_ulong(flags), texts[3])


def _call(means: str, function: Callable[..., int], *arguments: object) -> None:
    """Call a function of the C library; raise IsolationUnavailable for *means* if its result is not 0."""
    if function(*arguments) != 0:
        raise IsolationUnavailable(means, os.strerror(ctypes.get_errno()))
