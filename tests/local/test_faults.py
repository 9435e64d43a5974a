"""Faults hit the whole server and nothing else, and end when they should."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from rse_pf.errors import UsageError
from rse_pf.local.faults import (
    cut_off,
    find_server,
    nft_commands,
    signal_tree,
    slow_down,
    tree,
)
from rse_pf.local.processes import ProcessMark, mark_of
from rse_pf.local.state import PlatformState, ServerState

FAMILY = """
import subprocess, sys
child = subprocess.Popen([sys.executable, "-c", "print('up', flush=True)\\nwhile True: pass"])
child.wait()
"""
SOON_S = 10.0


@pytest.fixture
def family() -> Iterator[ProcessMark]:
    """A process with a busy child."""
    process = subprocess.Popen([sys.executable, "-c", FAMILY], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "up\n"
    root = mark_of(process.pid)
    assert root is not None
    yield root
    signal_tree(root, signal.SIGKILL)
    process.communicate()


def letter(mark: ProcessMark) -> str:
    return Path(f"/proc/{mark.pid}/stat").read_text().rpartition(")")[2].split()[0]


def until(what: object, marks: list[ProcessMark]) -> None:
    end = time.monotonic() + SOON_S
    while not all((letter(mark) == "T") is what for mark in marks):
        assert time.monotonic() < end, [letter(mark) for mark in marks]
        os.sched_yield()


def cpu_s(mark: ProcessMark) -> float:
    fields = Path(f"/proc/{mark.pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def state(**more: object) -> PlatformState:
    me = mark_of(os.getpid())
    assert me is not None
    gone = ProcessMark(pid=me.pid, began="0@another-boot")
    servers = (ServerState(name="server-1", process=gone), ServerState(name="server-2", process=me))
    return PlatformState(
        name="p", control_plane=me, url="", settings_digest="", settings_file="", key_file="",
        servers=servers, **more,
    )  # fmt: skip


def test_a_pid_that_was_used_again_is_not_touched(family: ProcessMark) -> None:
    other = ProcessMark(pid=family.pid, began="1@another-boot")

    assert tree(other) == []
    assert signal_tree(other, signal.SIGKILL) == 0
    assert letter(family) in "SR"


def test_a_slowed_server_gets_its_share_and_all_of_it_afterwards(family: ProcessMark) -> None:
    child = tree(family)[1]
    began, used = time.monotonic(), cpu_s(child)
    over = threading_event_like(began + 1.5)

    slow_down(family, 20.0, over)

    wall = time.monotonic() - began
    assert cpu_s(child) - used < 0.5 * wall
    until(False, [child])


def threading_event_like(end: float):
    never = socket.socketpair()

    def wait(seconds: float) -> bool:
        never[0].settimeout(max(0.0001, seconds))
        with contextlib.suppress(TimeoutError):
            never[0].recv(1)
        if time.monotonic() >= end:
            for each in never:
                each.close()
            return True
        return False

    return wait


@pytest.mark.parametrize("percent", [0.0, 100.0, -5.0, float("nan")])
def test_a_share_that_is_none_is_refused(family: ProcessMark, percent: float) -> None:
    with pytest.raises(UsageError):
        slow_down(family, percent, lambda seconds: True)


def test_names_and_ports_reach_nft_only_as_letters_and_numbers() -> None:
    reported = nft_commands('rse_pf_a; "b"', [8001, 0, 8002])

    assert "table inet rse_pf_a___b_ " in reported
    assert "dport { 8001, 8002 } drop" in reported
    assert "flags owner" in reported


def test_a_partition_by_a_plain_user_names_the_nearest_thing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    server = find_server(state(), "server-2")

    with pytest.raises(UsageError, match="needs root") as caught, cut_off(server, "p"):
        pass

    assert "pause server-2" in (caught.value.hint or "")


@pytest.mark.system
def test_a_partition_drops_silently_and_heals() -> None:
    if os.geteuid() != 0 or shutil.which("nft", path="/usr/sbin:/usr/bin:/sbin") is None:
        pytest.skip("a partition needs root and nft")
    me = mark_of(os.getpid())
    assert me is not None
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
        server = ServerState(name="server-1", process=me, port=port)
        with cut_off(server, "test"), pytest.raises(TimeoutError):
            socket.create_connection(("127.0.0.1", port), timeout=0.3)
        end = time.monotonic() + SOON_S
        while True:
            try:
                socket.create_connection(("127.0.0.1", port), timeout=0.5).close()
                break
            except TimeoutError:
                assert time.monotonic() < end
