"""A swarm against real servers behind a real balancer: open load, its books, and a returning herd."""

from __future__ import annotations

import asyncio
import csv
import json
import multiprocessing
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from rse_pf.config import PlatformSettings
from rse_pf.extensions.experiments.load.scenario import LoadScenario
from rse_pf.extensions.experiments.load.swarm import Swarm
from rse_pf.extensions.experiments.results.summary import summarise
from rse_pf.local.control.platform import LocalPlatform
from rse_pf.local.processes import wait_ended

pytestmark = pytest.mark.system

SETTINGS = PlatformSettings()


def swarm_of(cloud: LocalPlatform, options: LoadScenario, **more: Any) -> Swarm:
    return Swarm(options, url=cloud.url, token_of=cloud.issue_token, session=SETTINGS.session, **more)


def free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


async def start_again(cloud: LocalPlatform, before: Any) -> None:
    """Start a balancer that was killed, at the same port, unless the platform has done so itself."""
    balancer = cloud.load_balancer
    await asyncio.to_thread(wait_ended, before, 5.0)
    if balancer.process.mark == before:
        balancer.launch()
        await balancer.wait_live(10.0)
        balancer.set_targets([server.target for server in cloud.servers])


async def test_robots_of_two_processes_get_right_poses_and_leave(tmp_path: Path) -> None:
    heard: list[Any] = []
    async with LocalPlatform(SETTINGS, servers=1, port=0, state=tmp_path / "a") as cloud:
        options = LoadScenario(robots=6, processes=2, join_every_s=0.05)
        async with swarm_of(cloud, options, on_event=heard.append) as swarm:
            await swarm.start()
            await swarm.wait_joined(20)
            await swarm.leave(2)
            assert swarm.left == {"robot-5", "robot-6"}
            await swarm.wait_answered(20, 20)
            result = await swarm.finish()
        assert not any(process.name == "swarm" for process in multiprocessing.active_children())
    figures = summarise(result.commands)["commands"]
    assert figures["sent"] == figures["answered"] >= 4 * 5
    assert figures["lost"] == result.duplicates == result.wrong_poses == 0
    robots = {f"robot-{number + 1}" for number in range(6)}
    assert {command.robot for command in result.commands} == robots
    assert {event["robot"] for event in heard if event["event"] == "robot-joined"} == robots
    last = {robot: max(c.planned for c in result.commands if c.robot == robot) for robot in robots}
    assert max(last["robot-5"], last["robot-6"]) < min(last[f"robot-{n}"] for n in range(1, 5))
    for command in result.commands:
        assert command.answered is not None
        assert command.round_trip_ms == pytest.approx(1e3 * (command.answered - command.planned), abs=0.01)
        assert command.sent >= command.planned - 1e-3
    assert 0.0 < result.cpu_s < result.wall_s * 2


async def test_the_median_through_the_papers_link_is_little_more_than_its_delay(tmp_path: Path) -> None:
    async with (
        LocalPlatform(SETTINGS, servers=1, port=0, state=tmp_path / "a") as cloud,
        swarm_of(cloud, LoadScenario(robots=3, link="paper")) as swarm,
    ):
        await swarm.start()
        await swarm.wait_joined(20)
        await swarm.wait_answered(25, 20)
        result = await swarm.finish()
    median = summarise(result.commands)["round_trip_ms"]["p50"]
    assert 130.0 <= median <= 130.0 + 40.0
    assert result.link == "paper"


@pytest.mark.slow
async def test_all_robots_reconnect_soon_after_the_load_balancer_was_killed_and_restarted(
    tmp_path: Path,
) -> None:
    robots, heard = 40, []
    all_back = asyncio.Event()

    def listen(event: Any) -> None:
        heard.append(event)
        if len({each["robot"] for each in heard if each["event"] == "link-back"}) == robots:
            all_back.set()

    async with LocalPlatform(SETTINGS, servers=2, port=free_port(), state=tmp_path / "a") as cloud:
        origin = time.monotonic()
        async with swarm_of(cloud, LoadScenario(robots=robots), on_event=listen, origin=origin) as swarm:
            await swarm.start()
            await swarm.wait_joined(30)
            before = cloud.load_balancer.process.mark
            assert before is not None
            os.kill(before.pid, signal.SIGKILL)
            killed_s = time.monotonic() - origin
            await start_again(cloud, before)
            await asyncio.wait_for(all_back.wait(), 20)
            result = await swarm.finish()
    figures = summarise(result.commands)
    assert figures["commands"]["lost"] == figures["commands"]["failed"] == 0, figures["failures_by_code"]
    assert result.duplicates == result.wrong_poses == 0
    assert result.reconnects >= robots
    back = sorted(event["time"] - killed_s for event in heard if event["event"] == "link-back")
    assert back[-1] < 10.0


@pytest.mark.slow
def test_the_report_of_the_verb_follows_from_its_records(tmp_path: Path) -> None:
    out = tmp_path / "out"
    words = ["swarm", "--robots", "3", "--seconds", "1", "--fps", "10", "--servers", "1", "--out", str(out)]
    done = subprocess.run(
        [sys.executable, "-m", "rse_pf.cli.main", *words],
        capture_output=True, text=True, timeout=90, check=False, cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    report = json.loads((out / "report.json").read_text())
    with (out / "commands.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert report["commands"]["sent"] == len(rows) >= 30
    assert report["commands"]["answered"] == sum(row["code"] == "ok" for row in rows)
    assert report["generator"]["cpu_s"] > 0
    assert len(report["environment"]["load_average"]) == len(report["generator"]["load_average_after"]) == 3
    events = [json.loads(line) for line in (out / "events.jsonl").read_text().splitlines()]
    assert sum(event["action"] == "robot-joined" for event in events) == 3
    written = ["commands.csv", "events.jsonl", "report.json", "scenario.json"]
    assert sorted(path.name for path in out.iterdir()) == written
    assert "answered" in done.stdout
