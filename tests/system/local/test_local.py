"""The local platform as a library: real Envoy, real servers, nothing left running."""

from __future__ import annotations

import asyncio
import contextlib
import signal
import subprocess
import sys
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest
import websockets
from websockets.asyncio.client import ClientConnection

from rse_pf.config import PlatformSettings
from rse_pf.errors import ConfigurationError, UsageError
from rse_pf.local.control.platform import LocalPlatform
from rse_pf.local.firewall import key_file
from rse_pf.local.processes import mark_of, wait_ended
from rse_pf.local.state import read_state
from rse_pf.wire import SUBPROTOCOLS, Hello, Ping, make_codec

pytestmark = pytest.mark.system

SOON_S = 10.0
SETTINGS = PlatformSettings()


class Robot:
    """The smallest robot: says hello, and pings."""

    def __init__(self, connection: ClientConnection) -> None:
        self.connection = connection
        self.server = ""
        self._codec = make_codec("bin")

    async def ask(self, message: Any) -> Any:
        await self.connection.send(self._codec.encode(message))
        data = await asyncio.wait_for(self.connection.recv(decode=False), SOON_S)
        return self._codec.decode_from_server(data)

    async def is_served(self) -> bool:
        return (await self.ask(Ping(sent_s=7.0))).sent_s == 7.0


def dial(url: str, token: str) -> Any:
    headers = {"Authorization": f"Bearer {token}"} if token else {}
    return websockets.connect(
        url, subprotocols=[SUBPROTOCOLS["bin"]], additional_headers=headers,
        compression=None, ping_interval=None, open_timeout=SOON_S, close_timeout=1,
    )  # fmt: skip


@contextlib.asynccontextmanager
async def robots(cloud: LocalPlatform, count: int, first: int = 0) -> AsyncIterator[list[Robot]]:
    """Open *count* sockets, of robot *first* and on, in turn; each knows which server welcomed it."""
    async with contextlib.AsyncExitStack() as stack:
        opened = []
        for number in range(first, first + count):
            robot = Robot(
                await stack.enter_async_context(dial(cloud.url, cloud.issue_token(f"robot-{number}")))
            )
            robot.server = (await robot.ask(Hello())).server
            opened.append(robot)
        yield opened


async def refusal(url: str, token: str = "") -> int:
    """Return the status with which the server refuses."""
    with pytest.raises(websockets.exceptions.InvalidStatus) as told:
        async with dial(url, token):
            pass
    return told.value.response.status_code


async def event(cloud: LocalPlatform, name: str, heard: asyncio.Queue[Any]) -> Any:
    async def wait() -> Any:
        while (told := await heard.get())["event"] != name:
            pass
        return told

    return await asyncio.wait_for(wait(), SOON_S)


def processes(cloud: LocalPlatform) -> list[int]:
    """Return every process of a running platform."""
    assert cloud.load_balancer.process.mark is not None
    workers = [pid for server in cloud.servers for pid in server.workers]
    return [cloud.load_balancer.process.mark.pid, *(server.pid for server in cloud.servers), *workers]


def test_robots_with_a_token_are_welcomed_by_both_servers_and_nothing_is_left(
    tmp_path: Path, gone: Callable[[int], None]
) -> None:
    async def run() -> list[int]:
        async with LocalPlatform(SETTINGS, servers=2, port=0, state=tmp_path / "a") as cloud:
            async with robots(cloud, 8) as all_robots:
                assert {robot.server for robot in all_robots} == {"server-1", "server-2"}
                status = await cloud.status()
                assert sorted(each["server"] for each in status) == ["server-1", "server-2"]
                assert {each["pid"] for each in status} == {server.pid for server in cloud.servers}
                stats = await cloud.load_balancer.stats()
                assert sum(target.robots for target in stats.values()) == 8
            started = processes(cloud)
            assert len(started) == 5
            state = read_state(cloud.state)
            assert state is not None
            assert state.url == cloud.url
            assert state.port == cloud.port
            assert {mark.pid for mark in state.processes()} <= set(started)
            return started

    for pid in asyncio.run(run()):
        gone(pid)
    assert read_state(tmp_path / "a") is None
    assert not key_file(tmp_path / "a").exists(), "a key that nobody needs any more"


async def test_the_door_refuses_who_has_no_token_and_knows_one_path_only(tmp_path: Path) -> None:
    async with LocalPlatform(SETTINGS, servers=1, port=0, state=tmp_path / "a") as cloud:
        elsewhere = cloud.url.replace("/ws", "/elsewhere")
        token = cloud.issue_token("robot-1")
        assert [
            await refusal(cloud.url),
            await refusal(cloud.url, token[:-4] + "AAAA"),
            await refusal(elsewhere, token),
        ] == [401, 401, 404]


async def test_targets_change_without_cutting_open_sockets(tmp_path: Path) -> None:
    async with LocalPlatform(SETTINGS, servers=2, port=0, state=tmp_path / "a") as cloud:
        first, second = cloud.servers
        balancer = cloud.load_balancer
        async with robots(cloud, 8) as early:
            assert {robot.server for robot in early} == {first.name, second.name}
            for _ in range(3):
                balancer.set_targets([first.target])
                assert await balancer.wait_gone(second.name, SOON_S)
                async with robots(cloud, 4, first=8) as late:
                    assert {robot.server for robot in late} == {first.name}
                balancer.set_targets([first.target, second.target])
                assert await balancer.wait_healthy([first.name, second.name], SOON_S)
            assert [await robot.is_served() for robot in early] == [True] * 8


async def test_a_killed_server_is_noticed_and_the_other_one_serves_on(tmp_path: Path) -> None:
    heard: asyncio.Queue[Any] = asyncio.Queue()
    async with LocalPlatform(
        SETTINGS, servers=2, port=0, state=tmp_path / "a", on_event=heard.put_nowait
    ) as cloud:
        cloud.kill("server-1")
        told = await event(cloud, "server-gone", heard)
        assert (told["server"], told["exit_code"]) == ("server-1", -signal.SIGKILL)
        assert [server.name for server in cloud.servers] == ["server-2"]
        assert await cloud.load_balancer.wait_gone("server-1", SOON_S)
        async with robots(cloud, 4) as served:
            assert {robot.server for robot in served} == {"server-2"}
        with pytest.raises(UsageError, match="no server named 'server-1'"):
            cloud.kill("server-1")


async def test_two_platforms_do_not_collide_and_a_name_or_port_is_taken_once(tmp_path: Path) -> None:
    async with (
        LocalPlatform(SETTINGS, servers=1, port=0, state=tmp_path / "a") as first,
        LocalPlatform(SETTINGS, servers=1, port=0, state=tmp_path / "b") as second,
    ):
        assert not set(processes(first)) & set(processes(second))
        assert await refusal(second.url, first.issue_token("robot-1")) == 401
        with pytest.raises(ConfigurationError, match="named 'a' is running already"):
            await LocalPlatform(SETTINGS, servers=1, port=0, state=tmp_path / "a").__aenter__()
        with pytest.raises(ConfigurationError, match="Address already in use"):
            await LocalPlatform(SETTINGS, servers=1, port=first.port, state=tmp_path / "c").__aenter__()
        async with robots(first, 1), robots(second, 1):
            pass


def test_nothing_is_left_when_the_block_fails(tmp_path: Path, gone: Callable[[int], None]) -> None:
    started: list[int] = []

    async def run() -> None:
        async with LocalPlatform(SETTINGS, servers=1, port=0, state=tmp_path / "a") as cloud:
            started.extend(processes(cloud))
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        asyncio.run(run())
    for pid in started:
        gone(pid)


@pytest.mark.parametrize(
    ("script", "complaint"),
    [
        ("import sys; sys.exit('no cheese today')", "exit code 1: no cheese today"),
        ("import signal; print('I wait', flush=True); signal.pause()", "was not ready within .*: I wait"),
    ],
)
def test_a_server_that_does_not_start_ends_the_start_and_leaves_nothing(
    tmp_path: Path, script: str, complaint: str, gone: Callable[[int], None]
) -> None:
    cloud = LocalPlatform(
        SETTINGS.replace(local={"start_timeout_s": 2.0}),
        servers=2, port=0, state=tmp_path / "a", program=(sys.executable, "-c", script),
    )  # fmt: skip

    with pytest.raises(ConfigurationError, match=complaint):
        asyncio.run(cloud.__aenter__())

    assert cloud.load_balancer.process.mark is not None
    gone(cloud.load_balancer.process.mark.pid)
    assert cloud.backend_servers.marks == {}
    assert read_state(tmp_path / "a") is None
    assert cloud.events[-1] == {"event": "platform-gone"}


def test_everything_dies_with_a_program_that_is_killed(tmp_path: Path) -> None:
    script = """
import asyncio
from pathlib import Path
from rse_pf.local.control.platform import LocalPlatform
from rse_pf.config import PlatformSettings
async def run():
    async with LocalPlatform(PlatformSettings(), servers=1, port=0, state=Path("a")) as cloud:
        workers = [pid for server in cloud.servers for pid in server.workers]
        print(cloud.load_balancer.process.mark.pid, cloud.servers[0].pid, *workers, flush=True)
        await asyncio.Event().wait()
asyncio.run(run())
"""
    with subprocess.Popen([sys.executable, "-c", script], cwd=tmp_path, stdout=subprocess.PIPE) as program:
        assert program.stdout is not None
        marks = [mark_of(int(pid)) for pid in program.stdout.readline().split()]
        program.kill()

    assert len(marks) == 3
    for mark in marks:
        assert mark is not None
        assert wait_ended(mark, SOON_S)
