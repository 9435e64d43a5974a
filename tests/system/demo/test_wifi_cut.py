"""Wi-Fi that goes away without a word: noticed on both sides, and over soon after it is back."""

from __future__ import annotations

import asyncio
import time
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

from rse_pf.config import PlatformSettings
from rse_pf.extensions.experiments.faults.network_emulator import PROFILES, LinkProcess
from rse_pf.extensions.experiments.load.scenario import LoadScenario
from rse_pf.extensions.experiments.load.swarm import Swarm
from rse_pf.local.control.platform import LocalPlatform

pytestmark = [pytest.mark.system, pytest.mark.slow]

SETTINGS = PlatformSettings()
ROBOTS = 8
NOTICED_S = 6.0
SERVER_NOTICED_S = 7.5  # its timeout (5 s), its margin and its tick
BACK_S = 4.0  # 2.0 on a machine that does nothing else
DEADLINE_S = 5.0


class Listener:
    """Remembers when each robot lost its link, seconds from the origin."""

    def __init__(self) -> None:
        self.lost: dict[str, float] = {}
        self._news = asyncio.Event()

    def __call__(self, event: Any) -> None:
        if event["event"] == "link-lost":
            self.lost.setdefault(event["robot"], event["time"])
        self._news.set()

    async def until_all_lost(self) -> None:
        while len(self.lost) < ROBOTS:
            self._news.clear()
            await self._news.wait()


async def until_no_server_has_robots(cloud: LocalPlatform) -> None:
    while any(status["robots"] for status in await cloud.status()):
        await asyncio.sleep(0.1)  # the servers tell their numbers only when asked


async def test_both_sides_notice_a_cut_and_the_first_answers_come_soon_after_it(tmp_path: Path) -> None:
    listener = Listener()
    async with LocalPlatform(SETTINGS, servers=2, port=0, state=tmp_path / "a") as cloud:
        parts = urlsplit(cloud.url)
        async with LinkProcess(PROFILES["none"], parts.hostname or "", parts.port or 0) as link:
            url = parts._replace(netloc=f"127.0.0.1:{link.port}").geturl()
            origin = time.monotonic()
            async with Swarm(
                LoadScenario(robots=ROBOTS, deadline_s=DEADLINE_S),
                url=url, token_of=cloud.issue_token, session=SETTINGS.session, on_event=listener,
                origin=origin,
            ) as swarm:  # fmt: skip
                await swarm.start()
                await swarm.wait_joined(20)
                await link.cut()
                cut_s = time.monotonic() - origin
                await asyncio.wait_for(until_no_server_has_robots(cloud), SERVER_NOTICED_S)
                await asyncio.wait_for(listener.until_all_lost(), NOTICED_S)
                assert max(listener.lost.values()) - cut_s <= NOTICED_S
                await link.heal()
                healed_s = time.monotonic() - origin
                await swarm.wait_answered(ROBOTS * 50, 20)  # the backlog, and fresh ones
                result = await swarm.finish(DEADLINE_S)

    during = [c for c in result.commands if c.code == "ok" and cut_s + 0.3 < (c.answered or 0) < healed_s]
    assert not during
    first = {
        robot: min(
            c.answered - healed_s
            for c in result.commands
            if c.robot == robot and c.code == "ok" and c.answered is not None and c.answered >= healed_s
        )
        for robot in listener.lost
    }
    assert len(first) == ROBOTS
    assert max(first.values()) <= BACK_S, first
    late = [c for c in result.commands if c.code == "ok" and (c.round_trip_ms or 0) > DEADLINE_S * 1e3 + 50]
    assert not late, "an answer after its deadline was delivered as fresh"
    assert {c.code for c in result.commands} == {"ok", "expired"}
    assert result.wrong_poses == 0
    assert result.duplicates == 0
    assert result.reconnects >= ROBOTS
