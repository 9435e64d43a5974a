"""Which map of which tenant gets one of a worker's map-server processes, and which map gives one up."""

from __future__ import annotations

import asyncio
import socket
from typing import Any

import pytest

from rse_pf.processes.ipc import encode_message
from rse_pf.server.live_map.process_pool import MapServerPool, MapServerProcess


class FakeProcess:
    """A fake process that is ready at once, and exits when it is ordered to release its map."""

    pid = 1

    def __init__(self) -> None:
        self.connection, self.theirs = socket.socketpair()
        self.theirs.sendall(encode_message(["ready"]))

    def say(self, order: dict[str, Any]) -> None:
        assert order == {"do": "release"}
        self.theirs.close()

    def kill(self) -> int:
        self.connection.close()
        self.theirs.close()
        return 0


class MapServerProcesses:
    """The processes of one worker, and time that the test sets."""

    def __init__(self, max_processes: int) -> None:
        self.now_s = 0.0
        self.pool = MapServerPool(
            lambda at_low_priority: FakeProcess(),
            max_processes=max_processes,
            keeps_spare=False,
            clock=lambda: self.now_s,
        )

    async def __aenter__(self) -> MapServerProcesses:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.pool.kill_spare()
        for child in self.pool.in_use:
            child.kill()

    def take(self, tenant: str, *, is_watched_only: bool = False) -> MapServerProcess | None:
        return self.pool.take(tenant, lambda child, code: None, is_watched_only=is_watched_only)

    def held(self) -> list[str]:
        return sorted(child.tenant for child in self.pool.in_use)

    async def gets(self, tenant: str) -> MapServerProcess:
        """Return the process that a map of *tenant* gets, which asks again and again."""
        while (child := self.take(tenant)) is None:
            await asyncio.sleep(0)
        return child


async def test_a_tenant_that_holds_all_gives_one_up_and_does_not_get_it_back() -> None:
    async with MapServerProcesses(3) as worker:
        for _ in range(3):
            await worker.gets("acme")
        assert worker.take("acme") is None
        assert not worker.pool.is_freeing_process, "nobody else wants one"
        await worker.gets("rival")
        assert worker.held() == ["acme", "acme", "rival"]
        for _ in range(20):
            assert worker.take("acme") is None
        await asyncio.sleep(0)
        assert worker.held() == ["acme", "acme", "rival"]


async def test_a_tenant_does_not_lose_its_only_map_to_one_that_holds_more() -> None:
    async with MapServerProcesses(3) as worker:
        for _ in range(2):
            await worker.gets("acme")
        watched = await worker.gets("rival")
        watched.unused_since_s = 1.0
        for _ in range(20):
            assert worker.take("acme") is None
            await asyncio.sleep(0)
        assert watched in worker.pool.in_use


async def test_a_map_that_is_watched_only_takes_a_process_only_while_no_other_map_wants_one() -> None:
    async with MapServerProcesses(1) as worker:
        watched = await worker.gets("acme")
        watched.unused_since_s = 1.0
        assert worker.take("rival", is_watched_only=True) is None
        assert not worker.pool.is_freeing_process
        assert worker.take("rival") is None
        while worker.pool.in_use:
            await asyncio.sleep(0)
        assert worker.take("acme", is_watched_only=True) is None, "the other one is about to ask again"
        worker.now_s += 60.0
        assert worker.take("acme", is_watched_only=True) is not None


async def test_a_process_whose_map_gets_commands_is_not_the_first_to_be_released() -> None:
    async with MapServerProcesses(1) as worker:
        child = worker.pool.prepare_spare()
        assert child is not None
        process = child._process
        assert isinstance(process, FakeProcess)
        process_of_map = worker.take("acme", is_watched_only=True)
        assert process_of_map is child
        assert child.unused_since_s == 0.0
        process.theirs.sendall(encode_message(["used", True]))
        while child.unused_since_s is not None:
            await asyncio.sleep(0)
        worker.now_s = 7.0
        process.theirs.sendall(encode_message(["used", False]))
        while child.unused_since_s is None:
            await asyncio.sleep(0)
        assert child.unused_since_s == 7.0


async def test_the_cpu_time_of_map_servers_counts_for_their_tenants_also_after_their_exit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    taken_s = [0.0]
    monkeypatch.setattr("rse_pf.server.live_map.process_pool.cpu_seconds", lambda pid: taken_s[0])

    async with MapServerProcesses(2) as worker:
        taken_s[0] = 1.0  # its imports
        child = await worker.gets("acme")
        taken_s[0] = 3.5
        assert worker.pool.cpu_by_tenant() == {"acme": 2.5}
        child.kill()
        taken_s[0] = 4.0
        assert worker.pool.cpu_by_tenant() == {"acme": 2.5}
        await worker.gets("acme")
        taken_s[0] = 4.25
        assert worker.pool.cpu_by_tenant() == {"acme": 2.75}
