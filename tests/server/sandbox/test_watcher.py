"""The watcher: what it counts as memory of a sandbox, whom it names, and how often it looks."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from rse_pf.server.sandbox.watcher import MemoryWatcher

pytestmark = pytest.mark.system
MIB = 1 << 20
HOLD = """
import ctypes, mmap, os, sys
size, shares, pages = map(int, sys.argv[1:])
libc = ctypes.CDLL(None)
libc.mmap.restype = ctypes.c_void_p
libc.mmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t, *[ctypes.c_int] * 3, ctypes.c_long]
for i in range(pages):  # each in another gigabyte, and read only, so that it is not resident
    ctypes.string_at(libc.mmap((1 << 40) + (i << 30), 4096, mmap.PROT_READ, 0x100022, -1, 0), 1)
block = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
for at in range(0, size, 4096):
    block[at] = 1
if shares:
    os.fork()
os.write(1, b"held\\n")
sys.stdin.read()
"""
Start = Callable[..., int]


@pytest.fixture
def holding() -> Iterator[Start]:
    """Yield a function that starts a process which holds that much memory, alone or with a child."""
    started: list[subprocess.Popen[str]] = []

    def start(size: int, *, shares: bool = False, pages: int = 0) -> int:
        child = subprocess.Popen(
            [sys.executable, "-c", HOLD, str(size), str(int(shares)), str(pages)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        started.append(child)
        assert child.stdout is not None
        for _ in range(1 + shares):
            assert child.stdout.readline() == "held\n"
        return child.pid

    yield start
    for child in started:
        child.communicate()


def test_a_sandbox_above_its_limit_is_named_with_both_numbers(holding: Start) -> None:
    within, above = holding(10 * MIB), holding(60 * MIB)
    watcher = MemoryWatcher(50 * MIB)

    reasons = watcher.find_excess([within, above])

    assert list(reasons) == [above]
    reason = reasons[above]
    used = int(reason.split()[2])
    assert 60 * MIB < used < 80 * MIB
    assert reason.endswith(f"the limit is {50 * MIB}")


def test_pages_that_processes_share_count_in_proportion(holding: Start) -> None:
    assert MemoryWatcher(50 * MIB).find_excess([holding(60 * MIB, shares=True)]) == {}


def test_page_tables_count_even_of_pages_that_are_not_resident(holding: Start) -> None:
    pid = holding(4096, pages=8000)

    assert list(MemoryWatcher(60 * MIB).find_excess([pid])) == [pid]
    assert MemoryWatcher(60 * MIB).find_excess([holding(4096)]) == {}


def test_it_looks_more_often_when_a_sandbox_is_near_its_limit(holding: Start) -> None:
    pid = holding(60 * MIB)
    far, near = MemoryWatcher(1024 * MIB), MemoryWatcher(100 * MIB)

    far.find_excess([pid])
    near.find_excess([pid])

    assert near.interval_s == pytest.approx(0.02)
    assert far.interval_s == pytest.approx(0.25)


def test_files_of_the_scratch_folder_count(holding: Start, tmp_path: Path) -> None:
    pid = holding(4096)
    (tmp_path / str(pid) / "root/scratch").mkdir(parents=True)
    held = os.statvfs(tmp_path)
    used = (held.f_blocks - held.f_bfree) * held.f_frsize

    assert MemoryWatcher(1 << 60, proc=tmp_path).used_bytes(pid) >= used // 2 > 0
