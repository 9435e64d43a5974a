"""The system calls that a sandbox may make, by language, and the seccomp filter that refuses all others.

The lists contain the calls that strace showed for the examples, the templates and the tests of each language,
and those that other C libraries and kernels make instead.  This module only builds the filter;
`isolation.forbid_system_calls` applies it.

Refused are, among others: starting programs and processes, sockets (except socketpair for Python), pipes,
receiving descriptors, mounts, shared memory and message queues of System V and POSIX, files in memory
(memfd), file locks and leases (their kernel memory has no limit), changes of the scheduling, and every call
added since Linux 5.1.
Source: seccomp(2), and Linux's tables of system calls: arch/x86/entry/syscalls/syscall_64.tbl and
include/uapi/asm-generic/unistd.h.
"""

from __future__ import annotations

import struct
from collections.abc import Collection
from typing import NamedTuple

__all__ = ["LANGUAGES", "MACHINES", "allowed_calls", "filter_program"]

LANGUAGES = ("python", "cpp", "lua")
"""Languages of services for which this module lists the system calls that they need."""

MACHINES = ("x86_64", "aarch64")
"""Machines for which this module has the numbers of system calls, by the names of `platform.machine`."""

Numbers = dict[str, tuple[int | None, int | None]]
"""By name of a system call, its numbers on x86_64 and on aarch64; None if that machine does not have it."""

_MEMORY: Numbers = {  # calls for malloc, numpy's arrays, LuaJIT's machine code and shared libraries
    "brk": (12, 214), "madvise": (28, 233), "mmap": (9, 222), "mprotect": (10, 226), "mremap": (25, 216),
    "munmap": (11, 215),
}  # fmt: skip
_READ: Numbers = {  # calls to read modules, libraries and files; the second line for old C libraries
    "chdir": (80, 49), "close": (3, 57), "dup": (32, 23), "dup3": (292, 24), "faccessat": (269, 48),
    "access": (21, None), "dup2": (33, None), "lstat": (6, None), "open": (2, None), "stat": (4, None),
    "fcntl": (72, 25), "fstat": (5, 80), "fstatfs": (138, 44), "getcwd": (79, 17), "getdents64": (217, 61),
    "ioctl": (16, 29), "lseek": (8, 62), "newfstatat": (262, 79), "openat": (257, 56), "pread64": (17, 67),
    "read": (0, 63), "readlink": (89, None), "readlinkat": (267, 78), "readv": (19, 65),
    "statfs": (137, 43), "statx": (332, 291),
}  # fmt: skip
_WRITE: Numbers = {  # calls to write files in the scratch folder and to print; sendfile to copy files
    "chmod": (90, None), "link": (86, None), "mkdir": (83, None), "rename": (82, None), "rmdir": (84, None),
    "symlink": (88, None), "unlink": (87, None),
    "copy_file_range": (326, 285), "fallocate": (285, 47), "fchmod": (91, 52), "fchmodat": (268, 53),
    "fdatasync": (75, 83), "fsync": (74, 82), "ftruncate": (77, 46), "linkat": (265, 37),
    "mkdirat": (258, 34), "pwrite64": (18, 68), "renameat": (264, 38), "renameat2": (316, 276),
    "sendfile": (40, 71), "symlinkat": (266, 36), "truncate": (76, 45), "unlinkat": (263, 35),
    "utimensat": (280, 88), "write": (1, 64), "writev": (20, 66),
}  # fmt: skip
_WORKER: Numbers = {"recvfrom": (45, 207), "sendto": (44, 206)}  # calls for the socket to the worker
_PROCESS: Numbers = {  # calls to read properties of the own process; futex for locks of threads
    "exit": (60, 93), "exit_group": (231, 94), "futex": (202, 98), "getegid": (108, 177),
    "geteuid": (107, 175), "getgid": (104, 176), "getpid": (39, 172), "getppid": (110, 173),
    "getrandom": (318, 278), "getrlimit": (97, 163), "getrusage": (98, 165), "gettid": (186, 178),
    "getuid": (102, 174), "prctl": (157, 167), "prlimit64": (302, 261), "sched_getaffinity": (204, 123),
    "sysinfo": (99, 179), "times": (100, 153), "uname": (63, 160),
}  # fmt: skip
_TIME: Numbers = {  # calls for sleep, and clocks on virtual machines where they cannot be read without a call
    "clock_getres": (229, 114), "clock_gettime": (228, 113), "clock_nanosleep": (230, 115),
    "gettimeofday": (96, 169), "nanosleep": (35, 101), "time": (201, None),
}  # fmt: skip
_SIGNALS: Numbers = {  # calls for abort(); restart_syscall continues a sleep after SIGSTOP and SIGCONT
    "kill": (62, 129), "restart_syscall": (219, 128), "rt_sigaction": (13, 134),
    "rt_sigprocmask": (14, 135), "rt_sigreturn": (15, 139), "sigaltstack": (131, 132), "tgkill": (234, 131),
}  # fmt: skip
_THREADS: Numbers = {  # calls for threads of Python, C++ and OpenMP; membarrier when musl loads a library
    "clone": (56, 220), "getcpu": (309, 168), "membarrier": (324, 283), "rseq": (334, 293),
    "sched_yield": (24, 124), "set_robust_list": (273, 99),
}  # fmt: skip
_STANDARD_LIBRARY: Numbers = {  # calls for Python's asyncio, select, mmap and shutil.copy2, and numpy.memmap
    "epoll_create1": (291, 20), "epoll_ctl": (233, 21), "epoll_pwait": (281, 22), "epoll_wait": (232, None),
    "getsockname": (51, 204), "listxattr": (194, 11), "llistxattr": (195, 12), "msync": (26, 227),
    "poll": (7, None), "ppoll": (271, 73), "pselect6": (270, 72), "select": (23, None),
    "socketpair": (53, 199),
}  # fmt: skip

_EVERY: Numbers = _MEMORY | _READ | _WRITE | _WORKER | _PROCESS | _TIME | _SIGNALS
"""Calls that are allowed for services of every language."""
_BY_LANGUAGE: dict[str, Numbers] = {
    "python": _THREADS | _STANDARD_LIBRARY,
    "cpp": _THREADS,
    "lua": {},
}
"""Calls that are allowed in addition to `_EVERY` if a service in this language is installed."""


class _Check(NamedTuple):
    """A condition for a system call: one of its arguments, with *mask* applied, is one of *values*.

    *argument* counts from 0; only the low 32 bits of the argument are compared.
    """

    argument: int
    values: tuple[int, ...]
    mask: int = 0xFFFFFFFF


_PTHREAD_FLAGS = 0x003D0F00  # flags with which pthread_create calls clone
_CLONE_DETACHED = 0x00400000  # flag that musl sets as well; without effect since Linux 2.6.2
_MAP_HUGETLB = 0x00040000  # flag of mmap for huge pages
_AF_UNIX = 1  # family of sockets within one machine
_OWN_PROCESS = 0  # process id that stands for the calling process
_CHECKS = {
    "clone": _Check(0, (_PTHREAD_FLAGS,), 0xFFFFFFFF & ~_CLONE_DETACHED),  # threads only, no namespace
    "mmap": _Check(3, (0,), _MAP_HUGETLB),  # no huge pages: no memory limit of a sandbox counts them
    "fcntl": _Check(1, (0, 1, 2, 3, 4, 1030)),  # F_DUPFD, F_{GET,SET}FD, F_{GET,SET}FL, F_DUPFD_CLOEXEC
    "ioctl": _Check(1, (0x5401, 0x802C542A, 0x5421, 0x5450, 0x5451)),  # TCGETS(2), FIONBIO, FIO(N)CLEX
    "prctl": _Check(0, (15, 16)),  # PR_SET_NAME, PR_GET_NAME; not PR_SET_PDEATHSIG of die_with_parent
    "prlimit64": _Check(0, (_OWN_PROCESS,)),
    "socketpair": _Check(0, (_AF_UNIX,)),
}
"""Conditions on the arguments of allowed calls, by name; a call that does not meet its one is refused."""

_ARCHITECTURES = {"x86_64": 0xC000003E, "aarch64": 0xC00000B7}  # AUDIT_ARCH_* of linux/audit.h, by machine
_X32 = 0x40000000  # lowest number of a call of the x32 interface on x86_64; all of these are refused
_FIRST_OF_LINUX_5_1 = 424  # lowest number of calls since Linux 5.1, which are equal on every machine
# Results of a filter, linux/seccomp.h; an error number is added to _ERRNO.
_ALLOW = 0x7FFF0000
_KILL = 0x80000000
_ERRNO = 0x00050000
# Error numbers, errno.h.
_EPERM = 1
_ENOSYS = 38
# Instructions of classic BPF, linux/bpf_common.h.
_LOAD = 0x20
_AND = 0x54
_RETURN = 0x06
_JUMP_EQUAL = 0x15
_JUMP_AT_LEAST = 0x35
# Offsets in struct seccomp_data, in bytes.
_NUMBER_AT = 0
_ARCHITECTURE_AT = 4
_ARGUMENTS_AT = 16


def allowed_calls(languages: Collection[str], machine: str) -> dict[str, int]:
    """Return the number of each system call that sandboxes may make, by its name.

    Some of these calls are allowed with certain arguments only (`filter_program`).

    Args:
        languages: Names of `LANGUAGES`.  A sandbox can run services in all of them, so the calls of all of
            them are allowed.
        machine: One of `MACHINES`.
    """
    column = MACHINES.index(machine)
    named = dict(_EVERY)
    for language in languages:
        named |= _BY_LANGUAGE[language]
    return {name: number for name in sorted(named) if (number := named[name][column]) is not None}


def filter_program(languages: Collection[str], machine: str, pid: int) -> bytes:
    """Return the seccomp filter of a sandbox as instructions of classic BPF, 8 bytes each.

    A refused call fails with EPERM.  Calls of Linux 5.1 and later, such as clone3, fail with ENOSYS (unknown
    call), so that a C library makes the older call instead, whose arguments a filter can check.  A call by
    the interface of another architecture kills the process.

    Args:
        languages: Names of `LANGUAGES`; the calls of all of them are allowed.
        machine: One of `MACHINES`.
        pid: Id of the process that the filter is for, the only process to which it can send signals.
    """
    checks = {**_CHECKS, "kill": _Check(0, (pid,)), "tgkill": _Check(0, (pid,))}
    steps = [
        _step(_LOAD, _ARCHITECTURE_AT),
        _step(_JUMP_EQUAL, _ARCHITECTURES[machine], 1, 0),
        _step(_RETURN, _KILL),
        _step(_LOAD, _NUMBER_AT),
    ]
    for name, number in allowed_calls(languages, machine).items():
        then = _check(checks[name]) if name in checks else [_step(_RETURN, _ALLOW)]
        steps += [_step(_JUMP_EQUAL, number, 0, len(then)), *then]
    steps += [
        _step(_JUMP_AT_LEAST, _X32, 2, 0),
        _step(_JUMP_AT_LEAST, _FIRST_OF_LINUX_5_1, 0, 1),
        _step(_RETURN, _ERRNO | _ENOSYS),
        _step(_RETURN, _ERRNO | _EPERM),
    ]
    return b"".join(steps)


def _check(check: _Check) -> list[bytes]:
    """Return instructions that allow a call if its argument meets *check*, and else refuse it by EPERM."""
    count = len(check.values)
    return [
        _step(_LOAD, _ARGUMENTS_AT + 8 * check.argument),
        _step(_AND, check.mask),
        *(_step(_JUMP_EQUAL, value, count - i, 0) for i, value in enumerate(check.values)),
        _step(_RETURN, _ERRNO | _EPERM),
        _step(_RETURN, _ALLOW),
    ]


def _step(code: int, k: int, if_true: int = 0, if_false: int = 0) -> bytes:
    """Return one BPF instruction; a jump skips *if_true* or *if_false* instructions."""
    return struct.pack("=HBBI", code, if_true, if_false, k)
