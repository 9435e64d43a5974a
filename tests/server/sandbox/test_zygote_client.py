"""A worker's zygote: how it starts, what it is ordered, and what it reports."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import socket
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest

from rse_pf.config import PlatformSettings
from rse_pf.errors import ConfigurationError
from rse_pf.processes.ipc import receive
from rse_pf.server.sandbox.zygote_client import ZygoteClient
from tests.kit.fakes import FakeLog

pytestmark = pytest.mark.system
SETTINGS = PlatformSettings.from_dict({"services": {"accept_weak_isolation": True}})
WAIT_S = 20.0


class Reports:
    """What a zygote reported: the number of each sandbox that ended, and its own end as -1."""

    def __init__(self) -> None:
        self.ends: asyncio.Queue[tuple[int, str]] = asyncio.Queue()

    def on_gone(self, number: int, how: str) -> None:
        self.ends.put_nowait((number, how))

    def on_lost(self) -> None:
        self.ends.put_nowait((-1, "lost"))


@contextlib.asynccontextmanager
async def running_zygote() -> AsyncIterator[tuple[ZygoteClient, Reports, FakeLog]]:
    """Start a zygote that has no services, and end it."""
    reports, log, loop = Reports(), FakeLog(), asyncio.get_running_loop()
    failures: list[dict[str, Any]] = []
    loop.set_exception_handler(lambda _, context: failures.append(context))
    zygote = ZygoteClient([], SETTINGS, loop=loop, log=log, on_gone=reports.on_gone, on_lost=reports.on_lost)
    zygote.start()
    try:
        yield zygote, reports, log
    finally:
        zygote.close()
    assert failures == []


def order(zygote: ZygoteClient, number: int) -> socket.socket:
    """Order sandbox *number* and return the worker's end of its channel."""
    ours, theirs = socket.socketpair()
    output = os.open(os.devnull, os.O_WRONLY)
    try:
        assert zygote.create(number, theirs, output)
    finally:
        theirs.close()
        os.close(output)
    ours.settimeout(WAIT_S)
    return ours


async def create(zygote: ZygoteClient, number: int) -> socket.socket:
    """Create sandbox *number*, wait until it is ready, and return the worker's end of its channel."""
    ours = order(zygote, number)
    assert await asyncio.to_thread(receive, ours) == ["ready"]
    return ours


async def test_a_paused_sandbox_does_nothing_until_it_is_resumed() -> None:
    async with running_zygote() as (zygote, reports, _):
        channel = await create(zygote, 3)
        zygote.pause(3)
        channel.close()  # which would end it, see above
        (await create(zygote, 4)).close()

        assert await reports.ends.get() == (4, "exit code 0")
        zygote.resume(3)
        assert await reports.ends.get() == (3, "exit code 0")


async def test_a_sandbox_that_is_paused_while_it_starts_waits_too() -> None:
    async with running_zygote() as (zygote, reports, _):
        with order(zygote, 3):
            zygote.pause(3)
            (await create(zygote, 4)).close()
            assert await reports.ends.get() == (4, "exit code 0")
        (await create(zygote, 5)).close()

        assert await reports.ends.get() == (5, "exit code 0")
        zygote.end(3)
        assert await reports.ends.get() == (3, "signal SIGKILL")


async def test_a_zygote_that_is_killed_is_replaced_by_one_that_takes_orders() -> None:
    async with running_zygote() as (zygote, reports, log):
        with await create(zygote, 3):
            os.kill(zygote_of(os.getpid()), signal.SIGKILL)
            assert await reports.ends.get() == (-1, "lost")
        (await create(zygote, 4)).close()

        assert await reports.ends.get() == (4, "exit code 0")
        assert "zygote-lost" in log.names()


def zygote_of(worker: int) -> int:
    """Return the pid of the zygote that *worker* started."""
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            is_zygote = b"sandbox.zygote" in (folder / "cmdline").read_bytes()
            parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
            if is_zygote and parent == worker:
                return int(folder.name)
    raise AssertionError("no zygote")


async def test_a_zygote_has_no_variable_and_no_socket_of_its_worker(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "of the worker")
    with socket.socket() as listener:
        listener.listen()
        listener.set_inheritable(True)
        async with running_zygote():
            folder = Path("/proc", str(zygote_of(os.getpid())))
            held = [os.readlink(each) for each in (folder / "fd").iterdir() if int(each.name) > 2]

            assert b"of the worker" not in (folder / "environ").read_bytes()
            assert sum(name.startswith("socket") for name in held) == 1


async def test_a_zygote_that_does_not_start_is_a_typed_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.executable", "/bin/false")

    with pytest.raises(ConfigurationError, match="did not start"):
        async with running_zygote():
            pass
