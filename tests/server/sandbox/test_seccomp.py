"""The filter of system calls: by a small BPF machine for every architecture, and in this machine's kernel."""

from __future__ import annotations

import ctypes
import itertools
import json
import os
import platform
import re
import struct
from pathlib import Path

import pytest

from rse_pf.server.sandbox.isolation import forbid_system_calls, missing_isolation
from rse_pf.server.sandbox.seccomp import LANGUAGES, MACHINES, allowed_calls, filter_program

ARCHITECTURES = {"x86_64": 0xC000003E, "aarch64": 0xC00000B7}
ALLOWED, KILLED, EPERM, ENOSYS = 0x7FFF0000, 0x80000000, 0x00050001, 0x00050026
PID = 4321
PTHREAD = 0x3D0F00
HIGHEST = 600
"""Above the newest call of any Linux."""
GOOD = {
    "clone": (PTHREAD,), "mmap": (0, 0, 0, 0x22), "fcntl": (0, 1030), "ioctl": (0, 0x5401), "prctl": (15,),
    "prlimit64": (0,), "socketpair": (1,), "kill": (PID,), "tgkill": (PID,),
}  # fmt: skip
"""Arguments with which a call that is allowed in part is allowed."""
BAD = {
    "clone": [(17,), (PTHREAD | 0x10000000,), (PTHREAD & ~0x10000,), (0x4111,)],
    "mmap": [(0, 0, 0, 0x40022)],
    "fcntl": [(0, command) for command in (5, 6, 7, 8, 10, 37, 1024, 1026, 1031, 1033)],
    "ioctl": [(0, command) for command in (0x5412, 0x5413, 0x8905, 0x40086602)],
    "prctl": [(option,) for option in (1, 4, 22, 24, 35, 38, 41)],
    "prlimit64": [(1,), (PID,)],
    "socketpair": [(2,), (10,), (16,), (30,)],
    "kill": [(1,), (0,), (0xFFFFFFFF,)],
    "tgkill": [(1,), (0,)],
}
"""Arguments with which it is refused: fork and namespaces, huge pages, locks, leases and larger pipes, ..."""
SETS = [each for n in (1, 2, 3) for each in itertools.combinations(LANGUAGES, n)]
UNFILTERED = {335, 336}
"""uretprobe and uprobe: newer kernels do not filter them, and kill who calls them without a probe."""
HEADERS = {
    "x86_64": Path("/usr/include/x86_64-linux-gnu/asm/unistd_64.h"),
    "aarch64": Path("/usr/include/asm-generic/unistd.h"),
}
NAMES_IN_HEADER = {"newfstatat": "fstatat"}
"""The generic table has it under its name for 32 and 64 bits."""


def verdict(program: bytes, machine: str, number: int, arguments: tuple[int, ...] = ()) -> int:
    """Return what the filter *program* says to a call, as the kernel would execute it."""
    padded = (*arguments, *(0,) * 6)[:6]
    data = struct.pack("=IIQ6Q", number, ARCHITECTURES[machine], 0, *padded)
    steps = [struct.unpack_from("=HBBI", program, at) for at in range(0, len(program), 8)]
    at, value = 0, 0
    while True:
        code, if_true, if_false, k = steps[at]
        at += 1
        if code == 0x20:
            (value,) = struct.unpack_from("=I", data, k)
        elif code == 0x54:
            value &= k
        elif code == 0x15:
            at += if_true if value == k else if_false
        elif code == 0x35:
            at += if_true if value >= k else if_false
        else:
            assert code == 0x06
            return k


def refusal(number: int) -> int:
    """Return how a call of that number is refused."""
    return ENOSYS if 424 <= number < 0x40000000 else EPERM


NEVER = {
    "x86_64": {
        "shmget": 29, "shmat": 30, "socket": 41, "sendmsg": 46, "recvmsg": 47, "setsockopt": 54, "fork": 57,
        "vfork": 58, "execve": 59, "semget": 64, "msgget": 68, "ptrace": 101, "mknod": 133,
        "sched_setscheduler": 144, "mlock": 149, "mount": 165, "setxattr": 188, "sched_setaffinity": 203,
        "timer_create": 222, "mq_open": 240, "inotify_init": 253, "unshare": 272, "vmsplice": 278,
        "setns": 308, "memfd_create": 319, "bpf": 321, "userfaultfd": 323, "io_uring_setup": 425,
        "pidfd_open": 434, "openat2": 437, "memfd_secret": 447, "open_tree_attr": 467,
    },
    "aarch64": {
        "shmget": 194, "shmat": 196, "socket": 198, "sendmsg": 211, "recvmsg": 212, "setsockopt": 208,
        "execve": 221, "semget": 190, "msgget": 186, "ptrace": 117, "mknodat": 33, "sched_setscheduler": 119,
        "mlock": 228, "mount": 40, "setxattr": 5, "sched_setaffinity": 122, "timer_create": 107,
        "mq_open": 180, "inotify_init1": 26, "unshare": 97, "vmsplice": 75, "setns": 268,
        "memfd_create": 279, "bpf": 280, "userfaultfd": 282, "io_uring_setup": 425, "pidfd_open": 434,
        "openat2": 437, "memfd_secret": 447, "open_tree_attr": 467,
    },
}  # fmt: skip


@pytest.mark.parametrize("machine", MACHINES)
@pytest.mark.parametrize("languages", SETS)
def test_the_listed_calls_are_allowed_and_every_other_number_is_refused(machine, languages):
    program = filter_program(languages, machine, PID)
    listed = {number: name for name, number in allowed_calls(languages, machine).items()}

    for number in (*range(HIGHEST), 0x40000000, 0x40000000 + 59, 0x7FFFFFFF, 0xFFFFFFFF):
        expected = ALLOWED if number in listed else refusal(number)
        arguments = GOOD.get(listed.get(number, ""), ())
        assert verdict(program, machine, number, arguments) == expected, (number, listed.get(number))


@pytest.mark.parametrize("machine", MACHINES)
def test_some_calls_are_allowed_with_harmless_arguments_only(machine):
    program = filter_program(LANGUAGES, machine, PID)
    numbers = allowed_calls(LANGUAGES, machine)

    for name, refused in BAD.items():
        for arguments in refused:
            assert verdict(program, machine, numbers[name], arguments) == EPERM, (name, arguments)


@pytest.mark.parametrize("machine", MACHINES)
def test_no_language_may_share_memory_start_programs_or_reach_the_kernel(machine):
    allowed = set(allowed_calls(LANGUAGES, machine).values())

    assert not {name for name, number in NEVER[machine].items() if number in allowed}
    assert max(allowed) < 424, "a C library can do without calls of Linux 5.1 and later"


@pytest.mark.parametrize("machine", MACHINES)
def test_a_language_has_the_calls_that_it_needs_and_no_more(machine):
    python, cpp, lua = (set(allowed_calls([each], machine)) for each in ("python", "cpp", "lua"))

    assert lua < cpp < python
    assert {"clone", "rseq"} <= cpp - lua
    assert {"socketpair", "epoll_ctl"} <= python - cpp


@pytest.mark.parametrize("machine", MACHINES)
def test_a_call_of_another_architecture_kills(machine):
    (other,) = set(MACHINES) - {machine}

    assert verdict(filter_program(LANGUAGES, machine, PID), other, 63) == KILLED


@pytest.mark.parametrize("machine", MACHINES)
def test_the_numbers_are_those_of_the_kernels_headers(machine):
    header = HEADERS[machine]
    if not header.is_file():
        pytest.skip(f"{header} is not installed")
    found = re.findall(r"#define __NR(?:3264)?_(\w+)\s+(\d+)\b", header.read_text())
    numbers = {name: int(number) for name, number in found}

    for name, number in allowed_calls(LANGUAGES, machine).items():
        in_header = NAMES_IN_HEADER.get(name, name) if machine == "aarch64" else name
        assert numbers[in_header] == number, name


def wrongly_allowed(installed: tuple[str, ...], expected: tuple[str, ...]) -> list[int]:
    """Return the calls that the kernel does not refuse under one filter, though those of *expected* would."""
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        forbid_system_calls(installed)
        syscall = ctypes.CDLL(None, use_errno=True).syscall
        wrong = []
        listed = set(allowed_calls(expected, platform.machine()).values())
        for number in sorted(set(range(HIGHEST)) - listed - UNFILTERED):
            ctypes.set_errno(0)
            wanted = refusal(number) & 0xFF
            # Arguments that do harm nowhere, if the call is made: no valid address, descriptor or process.
            if syscall(number, -1, 0, 0, 0, 0, 0) != -1 or ctypes.get_errno() != wanted:
                wrong.append(number)
        os.write(write, json.dumps(wrong).encode())
        os._exit(0)
    os.close(write)
    with open(read) as pipe:
        text = pipe.read()
    assert os.waitpid(child, 0)[1] == 0
    return json.loads(text)


@pytest.mark.skipif(platform.machine() not in MACHINES, reason="no filter is written for this machine")
def test_the_kernel_refuses_every_call_that_is_not_listed():
    if missing_isolation([int, int, int, forbid_system_calls]):
        pytest.skip("this kernel has no seccomp")

    for language in LANGUAGES:
        assert wrongly_allowed((language,), (language,)) == []
    clone_and_more = set(wrongly_allowed(("cpp",), ("lua",)))
    assert clone_and_more, "a filter that is too wide is seen"
    assert clone_and_more <= set(allowed_calls(["cpp"], platform.machine()).values())
