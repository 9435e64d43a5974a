"""Isolate the calling process: namespaces, a root of its own, limits, no new privileges, seccomp.

Each function applies one means by plain Linux calls.  One that the kernel refuses raises
`IsolationUnavailable` with its name; `exec` undoes none of them.
Source: the paper's Fig. 4 gives each robot an isolated environment; the means are ours.
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
"""Names of the means that a kernel may lack; limits on resources always hold."""

_LIBC = ctypes.CDLL(None, use_errno=True)

# Flags of unshare(2), linux/sched.h.
_CLONE_NEWNS = 0x00020000
_CLONE_NEWUTS = 0x04000000
_CLONE_NEWIPC = 0x08000000
_CLONE_NEWUSER = 0x10000000
_CLONE_NEWPID = 0x20000000
_CLONE_NEWNET = 0x40000000
_MOUNT_POINTS = tuple(map(Path, ("/mnt", "/media", "/srv", "/opt", "/tmp", "/run")))
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
_SYS_MOUNT_SETATTR = 442
_SYS_PIVOT_ROOT = {"x86_64": 155, "aarch64": 41}
_SECCOMP_MODE_FILTER = 2
_CAP_VERSION_3 = 0x20080522
_LAST_CAP = 63  # highest number of a capability that the kernel interface allows
_MAX_THREADS = 64  # of one sandbox, so that a service cannot exhaust the process ids of the machine
_ROOT_INODES = 4096  # files and folders of the root, most of which are mount points
_BYTES_PER_INODE = 4096  # of the scratch folder, so that many small files take no further kernel memory


class IsolationUnavailable(Exception):
    """This kernel or this account lacks a means of isolation; ``args`` are its name and the reason."""


def missing_isolation(tries: Sequence[Callable[[], None]]) -> list[str]:
    """Call each of *tries*, one for each of `ISOLATION`, in a child process; return the names that failed."""
    missing = []
    for name, isolate in zip(ISOLATION, tries, strict=True):
        child = os.fork()
        if child == 0:
            try:
                isolate()
            except BaseException:  # noqa: BLE001  the exit code reports it
                os._exit(1)
            os._exit(0)
        if os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) != 0:
            missing.append(name)
    return missing


def enter_namespaces() -> None:
    """Enter new namespaces of network, mounts, processes and IPC; a plain user becomes its own root.

    The process namespace begins with the next child.
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
    """Make a root of *readable* paths (read-only), three devices and an empty ``/scratch``, and enter it.

    Args:
        readable: Files and folders that keep their names; missing ones are left out.
        scratch_bytes: Size of the scratch folder, in memory; it may hold one file per 4,096 bytes of that.
        owner: User of the scratch folder.
        copies: Folders, and what is shown in their places (read-only).
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
    """Bound address space, file size, open files and threads; no core files.

    Processes are bounded by seccomp, processor time by the deadline.

    Args:
        memory_bytes: Address space and scratch folder together.
        scratch_bytes: Scratch folder, and the longest file in it.
        alone: Whether the user or the user namespace belongs to this sandbox alone, so that its threads
            can be counted.
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
    """Become *uid* (root only; None stays), hold no capability and never gain one."""
    for capability in range(_LAST_CAP + 1):
        if prctl(PR_CAPBSET_DROP, capability) != 0:
            break  # past the last one, or not allowed to: the sets below are emptied anyway
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
    """Refuse from now on every system call that none of *languages* needs; `seccomp` has the lists."""
    machine = os.uname().machine
    if machine not in MACHINES or struct.calcsize("P") != 8:
        raise IsolationUnavailable("seccomp", f"no filter is written for {machine}")
    code = filter_program(languages, machine, os.getpid())
    buffer = ctypes.create_string_buffer(code, len(code))
    program = struct.pack("@HxxxxxxP", len(code) // 8, ctypes.addressof(buffer))
    _call("seccomp", prctl, PR_SET_NO_NEW_PRIVS, 1)
    _call("seccomp", prctl, PR_SET_SECCOMP, _SECCOMP_MODE_FILTER, program)


def _free_mount_point(readable: Sequence[Path]) -> str:
    """Return a folder to mount the new root on; no readable path may lie below it."""
    for place in _MOUNT_POINTS:
        if place.is_dir() and not any(Path(path).is_relative_to(place) for path in readable):
            return str(place)
    raise IsolationUnavailable("root", f"none of {', '.join(map(str, _MOUNT_POINTS))} is free")


def _outermost(paths: Sequence[Path]) -> list[Path]:
    """Return *paths* without those inside another one, in an order in which they can be mounted."""
    chosen: list[str] = []
    inside: tuple[str, ...] = ()
    for path in sorted({os.path.normpath(path) for path in paths}, key=lambda name: name.count("/")):
        if not path.startswith(inside):
            chosen.append(path)
            if not os.path.islink(path):
                inside += (path + "/",)
    return [Path(path) for path in chosen]


def _bind(path: Path, place: Path, base: str) -> None:
    """Show *path* as *place* below *base*."""
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
    attributes = struct.pack("=QQQQ", _MOUNT_ATTR_RDONLY | _MOUNT_ATTR_NOSUID | _MOUNT_ATTR_NODEV, 0, 0, 0)
    flags = _AT_RECURSIVE if recursive else 0
    _call("root", _LIBC.syscall, _SYS_MOUNT_SETATTR, -1, path.encode(), flags, attributes, len(attributes))


def _mount(source: str | None, target: str, kind: str | None, flags: int, data: str | None) -> None:
    texts = [None if text is None else text.encode() for text in (source, target, kind, data)]
    _call("root", _LIBC.mount, texts[0], texts[1], texts[2], ctypes.c_ulong(flags), texts[3])


def _call(means: str, function: Callable[..., int], *arguments: object) -> None:
    if function(*arguments) != 0:
        raise IsolationUnavailable(means, os.strerror(ctypes.get_errno()))
