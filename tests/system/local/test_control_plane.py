"""The control plane over real processes: what dies or hangs is replaced, who leaves leaves in order.

Robots of the SDK ask all the time; a command that is not answered within its deadline fails the test.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import signal
import subprocess
import sys
import urllib.request
from collections.abc import AsyncIterator, Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from client_sdk import connect
from rse_pf.auth.control_token import bearer, read_control_token
from rse_pf.config import PlatformSettings
from rse_pf.errors import ConfigurationError, UsageError
from rse_pf.local.control.control_plane import ControlOptions
from rse_pf.local.control.platform import LocalPlatform
from rse_pf.local.processes import is_alive, mark_of, send_signal, wait_ended
from rse_pf.local.state import read_state

pytestmark = pytest.mark.system

SOON_S = 30.0
SETTINGS = PlatformSettings()
ROBOTS = 6
EVERY_S = 0.02


class News:
    """What a platform told, and a way to wait for more."""

    def __init__(self) -> None:
        self.events: list[Mapping[str, Any]] = []
        self.samples: list[Mapping[str, Any]] = []
        self._more = asyncio.Condition()

    def event(self, told: Mapping[str, Any]) -> None:
        self.events.append(told)
        self._notify()

    def sample(self, told: Mapping[str, Any]) -> None:
        self.samples.append(told)
        self._notify()

    async def until(self, condition: Callable[[], Any]) -> Any:
        """Wait until *condition* is true, and return its value."""
        async with self._more:
            await asyncio.wait_for(self._more.wait_for(condition), SOON_S)
        return condition()

    def find(self, event: str, **details: Any) -> Mapping[str, Any] | None:
        """Return the first event of that name and with these details."""
        return next(
            (
                told
                for told in self.events
                if told["event"] == event and all(told.get(name) == value for name, value in details.items())
            ),
            None,
        )

    async def heard(self, event: str, **details: Any) -> Mapping[str, Any]:
        """Wait for an event, and return it."""
        found: Mapping[str, Any] = await self.until(lambda: self.find(event, **details))
        return found

    def _notify(self) -> None:
        async def tell() -> None:
            async with self._more:
                self._more.notify_all()

        with contextlib.suppress(RuntimeError):  # the platform's last event may come after the loop
            task = asyncio.get_running_loop().create_task(tell())
            task.add_done_callback(lambda _: None)


def platform(folder: Path, news: News, **options: Any) -> LocalPlatform:
    chosen = {"settings": SETTINGS, "servers": 2, "port": 0, **options}
    names = ("elastic", "compress", "rebalance")
    given: dict[str, Any] = {name: chosen.pop(name) for name in names if name in chosen}
    control = ControlOptions(**{"elastic": True, "on_sample": news.sample, **given})
    return LocalPlatform(chosen.pop("settings"), state=folder, on_event=news.event, control=control, **chosen)


class Tally:
    """What the robots got."""

    def __init__(self) -> None:
        self.answered = 0
        self.failed: list[Exception] = []
        self.servers: dict[str, str] = {}


@contextlib.asynccontextmanager
async def asking(cloud: LocalPlatform, count: int = ROBOTS, every_s: float = EVERY_S) -> AsyncIterator[Tally]:
    """Let *count* robots ask all the time; the block is left when each has its last answer."""
    tally, over = Tally(), asyncio.Event()

    async def live(name: str, joined: asyncio.Event) -> None:
        async with connect(cloud.url, token=cloud.issue_token(name)) as robot:
            while not over.is_set():
                try:
                    answer = await robot.call("echo", {"value": name}, keep=True, deadline_s=5.0)
                    assert answer.reply == {"value": name}
                    tally.answered += 1
                    tally.servers[name] = answer.server
                except Exception as error:  # noqa: BLE001 - whatever it is, it is counted and shown
                    tally.failed.append(error)
                joined.set()
                with contextlib.suppress(asyncio.TimeoutError):
                    await asyncio.wait_for(over.wait(), every_s)

    joined = [asyncio.Event() for _ in range(count)]
    robots = [asyncio.create_task(live(f"robot-{number}", each)) for number, each in enumerate(joined)]
    try:
        await asyncio.wait_for(asyncio.gather(*(each.wait() for each in joined)), SOON_S)
        yield tally
    finally:
        over.set()
        await asyncio.wait_for(asyncio.gather(*robots), SOON_S)


def check(tally: Tally) -> None:
    assert tally.failed == []
    assert tally.answered > ROBOTS


async def test_killed_and_stopped_servers_are_replaced_and_robots_lose_nothing(tmp_path: Path) -> None:
    news = News()
    async with platform(tmp_path / "a", news) as cloud:
        async with asking(cloud) as tally:
            cloud.kill("server-1")
            new = (await news.heard("replace", server="server-1"))["by"]
            await news.heard("server-out", server="server-1")
            await news.heard("server-healthy", server=new)
            cloud.pause("server-2")
            newer = (await news.heard("replace", server="server-2"))["by"]
            gone = await news.heard("server-gone", server="server-2")
            await news.heard("server-healthy", server=newer)
            assert [new, newer] == ["server-3", "server-4"], "a name is never used twice"
            assert gone["exit_code"] == -signal.SIGKILL
            assert news.find("server-unhealthy", server="server-2")
            assert not news.find("server-unhealthy", server="server-1"), "it ended, which is known sooner"
            state = read_state(cloud.state)
            assert state is not None
            assert [server.name for server in state.servers] == [new, newer]
        check(tally)


@pytest.mark.slow
async def test_a_zone_that_fails_takes_half_of_the_servers_and_no_command(tmp_path: Path) -> None:
    news = News()
    async with platform(tmp_path / "a", news, servers=4) as cloud:
        async with asking(cloud) as tally:
            for name in ("server-1", "server-3"):  # those of the pretended zone
                cloud.kill(name)
            new = [(await news.heard("replace", server=name))["by"] for name in ("server-1", "server-3")]
            for name in new:
                await news.heard("server-healthy", server=name)
            before = tally.answered
            await news.until(lambda: tally.answered > before + 2 * ROBOTS)
        check(tally)
        assert sorted(new) == ["server-5", "server-6"]


async def test_the_warm_standby_is_the_replacement_and_the_next_one_follows(tmp_path: Path) -> None:
    news = News()
    async with platform(tmp_path / "a", news, compress=6.0) as cloud:
        standby = (await news.heard("standby-started"))["pid"]
        async with asking(cloud) as tally:
            cloud.kill("server-1")
            await news.heard("server-healthy", server="server-3")
            assert cloud.backend_servers.marks["server-3"].pid == standby
            told = await news.heard("server-ready", server="server-3")
            assert told["pid"] == standby
        check(tally)
        started = await news.until(
            lambda: [told["pid"] for told in news.events if told["event"] == "standby-started"][1:]
        )
        mark = mark_of(started[0])
    assert mark is not None
    assert not is_alive(mark), "it goes with its platform"


async def test_a_killed_balancer_comes_back_on_its_port_with_its_targets(tmp_path: Path) -> None:
    news = News()
    async with platform(tmp_path / "a", news) as cloud:
        url = cloud.url
        async with asking(cloud) as tally:
            cloud.kill_balancer()
            await news.heard("balancer-gone")
            await news.heard("balancer-back")
            assert await cloud.load_balancer.wait_healthy(["server-1", "server-2"], SOON_S)
            before = tally.answered
            await news.until(lambda: tally.answered > before + 2 * ROBOTS)
            assert f":{cloud.port}/" in url
            state = read_state(cloud.state)
            assert state is not None
            assert state.load_balancer is not None
            assert is_alive(state.load_balancer), "the file names the new process"
        check(tally)
        assert len(cloud.servers) == 2


async def test_a_roll_under_load_replaces_every_server_in_order_and_loses_nothing(tmp_path: Path) -> None:
    news = News()
    async with platform(tmp_path / "a", news) as cloud:
        async with asking(cloud) as tally:
            await cloud.roll()
            assert [server.name for server in cloud.servers] == ["server-3", "server-4"]
            await news.until(lambda: set(tally.servers.values()) <= {"server-3", "server-4"})
        check(tally)
    for old in ("server-1", "server-2"):
        names = [told["event"] for told in news.events if told.get("server") == old]
        assert names[-4:] == ["drain-start", "server-out", "server-gone", "drain-over"]
        over = news.find("drain-over", server=old)
        assert over is not None
        assert over["clean"]
    assert not news.find("replace")


async def test_robots_that_are_there_already_spread_over_a_new_server(tmp_path: Path) -> None:
    def is_even(sample: Mapping[str, Any]) -> bool:
        robots = [server["robots"] for server in sample["servers"]]
        return sum(robots) == 12 and max(robots) <= 7

    news = News()
    async with platform(tmp_path / "a", news, servers=1) as cloud, asking(cloud, 12, 0.2) as tally:
        await cloud.grow(1, "more of them")
        await news.heard("rebalance", server="server-1")
        await news.until(lambda: is_even(news.samples[-1]))
    check(tally)


async def test_load_makes_it_grow_and_rest_makes_it_shrink(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A period of 1.25 s averages the ticks of CPU time; 0.04 cores are busy also beside other processes."""
    monkeypatch.setattr("rse_pf.scaling.rules.IDLE_CPU_PERCENT", 65.0)
    short = {"period_s": 10, "idle_s": 60, "warm_up_s": 0}
    settings = SETTINGS.replace(
        serving={"emulated_cores": 0.04}, scaling={**short, "min_servers": 1, "max_servers": 2}
    )

    news = News()
    async with platform(tmp_path / "a", news, settings=settings, servers=1, compress=8) as cloud:
        async with asking(cloud, 3 * ROBOTS, every_s=0.001):  # enough also from a crowded machine
            grown = await news.heard("grow")
            await news.heard("server-healthy", server="server-2")
        shrunk = await news.heard("shrink")
        await news.heard("drain-over")
        assert grown["reason"].startswith("CPU at")
        assert shrunk["reason"].startswith("idle")
        assert len(cloud.servers) == 1
        assert cloud.sample is not None
        seen = [sample["cpu_percent"] for sample in news.samples[: news.samples.index(cloud.sample)]]
        assert max(each for each in seen if each is not None) >= settings.scaling.busy_cpu_percent


async def test_new_servers_that_all_crash_are_started_slowly_and_old_ones_serve_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rse_pf.local.control.control_plane.MAX_RESTARTS_PER_MINUTE", 2)
    broken = tmp_path / "broken"
    script = (
        f"import os, sys\nif os.path.exists({str(broken)!r}): sys.exit('no cheese today')\n"
        "from rse_pf.cli.main import main\nsys.exit(main())"
    )

    news = News()
    program = (sys.executable, "-c", script)
    async with platform(tmp_path / "a", news, program=program) as cloud:
        broken.touch()
        cloud.kill("server-1")
        await news.heard("crash-loop")
        samples = len(news.samples)
        await news.until(lambda: len(news.samples) >= samples + 2)
        launched = [told["server"] for told in news.events if told["event"] == "server-launched"]
        assert launched == ["server-1", "server-2", "server-3", "server-4"]
        failed = news.find("server-failed", server="server-3")
        assert failed is not None
        assert "no cheese today" in failed["reason"]
        assert [server.name for server in cloud.servers] == ["server-2"]


async def test_a_server_that_is_asked_to_leave_is_replaced_but_not_cut_off(tmp_path: Path) -> None:
    news = News()
    async with platform(tmp_path / "a", news) as cloud:
        async with asking(cloud) as tally:
            cloud.backend_servers.send("server-1", signal.SIGTERM)
            await news.heard("drain-start", server="server-1")
            new = (await news.heard("replace", server="server-1"))["by"]
            gone = await news.heard("server-gone", server="server-1")
            await news.heard("server-healthy", server=new)
            assert gone["exit_code"] == 0
        check(tally)


async def test_without_elastic_nothing_is_replaced_but_drain_and_grow_can_be_asked_for(
    tmp_path: Path,
) -> None:
    news = News()
    async with LocalPlatform(SETTINGS, servers=1, port=0, state=tmp_path / "a", on_event=news.event) as cloud:
        with pytest.raises(UsageError, match="server-1 is the last server"):
            await cloud.drain("server-1")
        assert await cloud.grow(1, "asked") == ["server-2"]
        assert (await cloud.drain("server-1", reason="asked"))["clean"]
        assert cloud.sample is None
        document = cloud.status_document()
        assert [server["name"] for server in document["servers"]] == ["server-2"]
        with pytest.raises(UsageError, match="no server named 'server-1'"):
            cloud.pause("server-1")


CONTROL_PLANE = """
import asyncio
from pathlib import Path
from rse_pf.local.control.control_plane import ControlOptions
from rse_pf.local.control.platform import LocalPlatform
from rse_pf.config import PlatformSettings
async def run():
    options = dict(servers=2, port=0, state=Path("a"), adoptable=True, control=ControlOptions(elastic=True))
    async with LocalPlatform(PlatformSettings(), **options) as cloud:
        print(cloud.url, cloud.issue_token("robot-0"), flush=True)
        await asyncio.Event().wait()
asyncio.run(run())
"""


def test_a_new_control_plane_adopts_what_a_killed_one_left_and_robots_notice_nothing(tmp_path: Path) -> None:
    async def run(url: str, token: str, program: subprocess.Popen[bytes]) -> None:
        before = read_state(tmp_path / "a")
        assert before is not None
        news = News()
        async with connect(url, token=token) as robot:
            first = await robot.call("echo", {"value": 1})
            program.kill()
            program.wait()
            with pytest.raises(ConfigurationError, match="outlived their control plane"):
                await platform(tmp_path / "a", news).__aenter__()
            changed = SETTINGS.replace(scaling={"max_servers": 7})
            async with platform(tmp_path / "a", news, settings=changed, adoptable=True) as cloud:
                adopted = await news.heard("adopted")
                assert (adopted["servers"], adopted["balancer"]) == (["server-1", "server-2"], True)
                assert set(adopted["digests"].values()) == {before.settings_digest}
                assert before.settings_digest != cloud.status_document()["settings_digest"]
                assert cloud.url == url
                after = read_state(cloud.state)
                assert after is not None
                assert after.processes() == before.processes()
                assert all(map(is_alive, after.processes()))
                second = await robot.call("echo", {"value": 2})
                assert second.server == first.server
                assert robot.stats.reconnects == 0
                cloud.kill("server-1")
                new = await news.heard("replace", server="server-1")
                assert new["by"] == "server-3"
                await news.heard("server-healthy", server="server-3")
                await asyncio.to_thread(page, after.status_port, after.control_token_file)
        for mark in before.processes():
            assert wait_ended(mark, SOON_S)

    def page(port: int, token_file: str) -> None:
        headers = {"Authorization": bearer(read_control_token(Path(token_file)))}
        request = urllib.request.Request(f"http://127.0.0.1:{port}/status", headers=headers)
        with urllib.request.urlopen(request, timeout=SOON_S) as answer:
            told = json.load(answer)
        assert [server["name"] for server in told["servers"]] == ["server-2", "server-3"]
        assert told["policy"]["max_servers"] == 7
        assert told["balancer"]["running"]

    command = [sys.executable, "-c", CONTROL_PLANE]
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE) as program:
        assert program.stdout is not None
        url, token = program.stdout.readline().decode().split()
        marks = [mark_of(program.pid)]
        state = read_state(tmp_path / "a")
        assert state is not None
        marks += state.processes()
        try:
            asyncio.run(run(url, token, program))
        finally:
            for mark in marks:
                if mark is not None:
                    send_signal(mark, signal.SIGKILL)
