"""The fleet over fakes: the order of a drain, who is replaced and who is not, how the end ends."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from rse_pf.config import PlatformSettings
from rse_pf.errors import ConfigurationError
from rse_pf.local.balancer.envoy_config import Target
from rse_pf.local.control.fleet import Fleet, FleetReports, Member
from rse_pf.local.processes import ProcessMark
from rse_pf.local.servers.backend_servers import BackendServer
from rse_pf.local.servers.control_client import ControlPort

SOON_S = 10.0
SETTINGS = PlatformSettings()


class FakeServers:
    """Processes that are ready when the test says so, and end when they are killed."""

    def __init__(self) -> None:
        self.over: dict[str, asyncio.Event] = {}
        self.signals: list[tuple[str, signal.Signals]] = []
        self.marks: dict[str, ProcessMark] = {}
        self.broken: set[str] = set()

    def launch(self, name: str) -> None:
        self.over[name] = asyncio.Event()
        self.marks[name] = ProcessMark(pid=len(self.over), began=name)

    async def wait_ready(self, name: str, timeout_s: float) -> BackendServer:
        if name in self.broken:
            raise ConfigurationError(f"{name} ended", hint="look")
        mark = self.marks[name]
        return BackendServer(
            name=name,
            pid=mark.pid,
            port=1000 + mark.pid,
            control_port=1,
            workers=(),
            log=Path(name),
            mark=mark,
        )

    def control(self, port: int) -> ControlPort:
        return ControlPort(port)

    def send(self, name: str, number: signal.Signals) -> bool:
        self.signals.append((name, number))
        if number == signal.SIGKILL and name in self.over:
            self.over[name].set()
        return True

    async def wait_over(self, name: str) -> int | None:
        await self.over[name].wait()
        return -9

    def forget(self, name: str) -> None:
        self.marks.pop(name, None)


class FakeBalancer:
    """Finds every target healthy at once, and writes down every list of targets."""

    def __init__(self) -> None:
        self.targets: list[list[str]] = []

    def set_targets(self, targets: list[Target]) -> None:
        self.targets.append([target.name for target in targets])

    async def wait_healthy(self, names: list[str], timeout_s: float) -> bool:
        return bool(self.targets) and set(names) <= set(self.targets[-1])

    async def wait_gone(self, name: str, timeout_s: float) -> bool:
        return name not in self.targets[-1]


class World:
    """A fleet over fakes."""

    def __init__(self) -> None:
        self.servers, self.balancer = FakeServers(), FakeBalancer()
        self.events: list[dict[str, Any]] = []
        self.fleet = Fleet(
            self.servers,  # type: ignore[arg-type]
            self.balancer,  # type: ignore[arg-type]
            SETTINGS,
            compress=1.0,
            reports=FleetReports(
                emit=lambda event, **details: self.events.append({"event": event, **details}),
                changed=lambda: None,
            ),
        )

    async def up(self, count: int) -> list[Member]:
        members = [self.fleet.launch() for _ in range(count)]
        for member in members:
            await self.fleet.bring_up(member, SOON_S)
        return members

    def told(self, name: str) -> list[str]:
        return [event["event"] for event in self.events if event.get("server") == name]


@asynccontextmanager
async def a_fleet() -> AsyncIterator[World]:
    world = World()
    yield world
    await world.fleet.close()


async def test_a_living_broken_server_leaves_the_targets_before_it_is_killed() -> None:
    async with a_fleet() as world:
        first, _ = await world.up(2)
        world.fleet.launch_replacement(first.name)
        assert world.servers.signals == [("server-1", signal.SIGKILL)]
        assert world.balancer.targets[-1] == ["server-2"]
        assert world.fleet.standing(0.0).replacing == 1
        await world.fleet.wait_until_healthy([world.fleet.members["server-3"]], SOON_S)
        await first.over.wait()
        assert world.fleet.standing(0.0).replacing == 0

    assert world.fleet.dead == {}


async def test_the_one_with_the_fewest_robots_is_drained_and_the_last_one_never() -> None:
    async with a_fleet() as world:
        for member, robots in zip(await world.up(3), (5, 2, 9), strict=True):
            member.robots = robots
        assert world.fleet.shrink("idle") == "server-2"
        assert world.balancer.targets[-1] == ["server-1", "server-3"]
        assert world.fleet.shrink("idle") == "server-1"
        assert world.fleet.shrink("idle") is None


async def test_a_start_that_fails_is_a_young_death_and_an_event() -> None:
    async with a_fleet() as world:
        world.servers.broken.add("server-1")
        world.fleet.grow(1)
        while not world.fleet.dead:
            await asyncio.sleep(0)

    assert world.fleet.dead == {"server-1": True}
    assert world.told("server-1") == ["server-launched", "server-gone", "server-failed"]


async def test_targets_stay_until_every_adopted_server_is_known_again() -> None:
    async with a_fleet() as world:
        members = []
        for name in ("server-4", "server-7"):
            world.servers.launch(name)
            members.append(world.fleet.adopt(name, now_s=0.0, is_target=True))
        bringing = asyncio.create_task(world.fleet.bring_up(members[0], SOON_S))
        while members[0].server is None:
            await asyncio.sleep(0)
        assert world.balancer.targets == []
        await world.fleet.bring_up(members[1], SOON_S)
        await bringing
        assert world.balancer.targets[0] == ["server-4", "server-7"]
        assert world.fleet.launch().name == "server-8", "no name is used twice"


async def test_the_end_comes_although_a_cancellation_gets_lost() -> None:
    heard: list[str] = []

    async def deaf() -> None:
        try:
            await asyncio.Event().wait()
        except asyncio.CancelledError:
            heard.append("lost")
        try:
            await asyncio.Event().wait()
        finally:
            heard.append("over")

    async with a_fleet() as world:
        world.fleet.keep(deaf())
        await asyncio.sleep(0)
        await world.fleet.close()
        assert heard == ["lost", "over"]


async def test_a_server_that_ends_unasked_is_dead_until_it_is_replaced() -> None:
    async with a_fleet() as world:
        first, _ = await world.up(2)
        world.servers.send(first.name, signal.SIGKILL)
        await first.over.wait()
        while not world.fleet.dead:
            await asyncio.sleep(0)
        standing = world.fleet.standing(0.0)
        assert (standing.servers, standing.healthy, dict(standing.dead)) == (2, 1, {"server-1": True})
        assert world.balancer.targets[-1] == ["server-2"]

        assert world.fleet.launch_replacement("server-1") == "server-3"

        assert world.fleet.standing(0.0).servers == 2
        assert world.fleet.dead == {}


async def test_who_leaves_in_order_is_replaced_but_not_killed() -> None:
    async with a_fleet() as world:
        first, _ = await world.up(2)
        world.fleet.note_own_drain(first)
        world.fleet.note_own_drain(first)
        assert world.fleet.dead == {"server-1": False}
        world.fleet.launch_replacement(first.name)
        assert world.servers.signals == []
        assert [each["event"] for each in world.events].count("drain-start") == 1
