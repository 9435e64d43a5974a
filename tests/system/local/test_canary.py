"""The canary as an enrolled robot of the local platform: it is served, and does not keep idle servers."""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from client_sdk import connect
from rse_pf.auth.roster import SYNTHETIC, EnrolledRobot
from rse_pf.auth.tokens import SigningKey
from rse_pf.auth.trust_store import AccessControlStore
from rse_pf.aws.canary.handler import ask_known_pose
from rse_pf.config import PlatformSettings
from rse_pf.errors import ConnectError
from rse_pf.local.control.platform import LocalPlatform
from rse_pf.storage.object_store import DirectoryStore
from tests.system.local.test_control_plane import News, platform

pytestmark = pytest.mark.system

SETTINGS = PlatformSettings()
COMPRESS = 30.0
"""Factor by which the minutes of the scaling rules are shorter."""
MINUTE_S = 60.0 / COMPRESS
SERVERS = 3
KEY = SigningKey.of_robot(b"c" * 32)


def enrol_canary(folder: Path) -> None:
    robot = EnrolledRobot(
        robot="canary", x=json.loads(KEY.public_json())["x"], scopes=("services:pnp", SYNTHETIC)
    )
    access = AccessControlStore(DirectoryStore(folder))
    access.change_roster(lambda roster: roster.enrolled(robot))


async def ask_as_canary(url: str, key: SigningKey = KEY) -> Mapping[str, Any]:
    token = key.issue("canary", now=time.time(), token_id="t", settings=SETTINGS.auth)
    return await asyncio.to_thread(ask_known_pose, url, token, SETTINGS, trace="t" * 32, clock=time.monotonic)


@contextlib.asynccontextmanager
async def repeating(ask: Any) -> Any:
    """Await ``ask()`` once in each minute of the scaling rules; yield the list of what was not answered."""
    failed: list[Exception] = []
    over = asyncio.Event()

    async def repeat() -> None:
        while not over.is_set():
            try:
                await ask()
            except Exception as error:  # noqa: BLE001 - whatever it is, the test shows it
                failed.append(error)
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(over.wait(), MINUTE_S)

    task = asyncio.create_task(repeat())
    try:
        yield failed
    finally:
        over.set()
        await task


def elastic_platform(folder: Path, news: News) -> LocalPlatform:
    """Return a platform whose rules are those of the default settings, but for `underused`, which is off."""
    scaling = {"min_servers": 1, "max_servers": SERVERS, "warm_up_s": 0, "underused_s": 0}
    settings = SETTINGS.replace(scaling=scaling)
    return platform(folder, news, settings=settings, servers=SERVERS, compress=COMPRESS)


@pytest.mark.slow
async def test_an_enrolled_canary_is_served_through_the_load_balancer_and_another_key_is_not(
    tmp_path: Path,
) -> None:
    enrol_canary(tmp_path / "a")
    async with LocalPlatform(SETTINGS, servers=2, port=0, state=tmp_path / "a") as cloud:
        told = await ask_as_canary(cloud.url)
        assert told["server"] in ("server-1", "server-2")
        with pytest.raises(ConnectError, match="401"):
            await ask_as_canary(cloud.url, SigningKey.of_robot(b"d" * 32))


async def test_servers_leave_while_only_the_canary_sends_commands_and_each_of_its_commands_is_answered(
    tmp_path: Path,
) -> None:
    news = News()
    enrol_canary(tmp_path / "a")
    async with elastic_platform(tmp_path / "a", news) as cloud:
        async with repeating(lambda: ask_as_canary(cloud.url)) as failed:
            await news.heard("shrink", reason="idle for 300 s")
            await news.until(lambda: len(cloud.servers) == 1)
        assert not failed


async def test_one_robot_at_one_frame_a_minute_keeps_the_servers(tmp_path: Path) -> None:
    news = News()
    async with elastic_platform(tmp_path / "a", news) as cloud:
        async with (
            connect(cloud.url, token=cloud.issue_token("robot")) as robot,
            repeating(lambda: robot.call("echo", {"value": 1})) as failed,
        ):
            for _ in range(2):  # twice as many samples, a second apart, as idleness takes
                taken = len(news.samples)
                await news.until(lambda taken=taken: len(news.samples) > taken + 5 * MINUTE_S)
        assert not failed
        assert news.find("shrink") is None
