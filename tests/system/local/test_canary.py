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
from rse_pf.local.control.control_plane import ControlOptions
from rse_pf.local.control.platform import LocalPlatform
from rse_pf.object_store import DirectoryStore

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


class Notices:
    """What the platform reports, with a way to wait for it."""

    def __init__(self) -> None:
        self.events: list[Mapping[str, Any]] = []
        self.samples = 0
        self._changed = asyncio.Event()

    def add_event(self, event: Mapping[str, Any]) -> None:
        self.events.append(event)
        self._changed.set()

    def add_sample(self, sample: Mapping[str, Any]) -> None:
        self.samples += 1
        self._changed.set()

    def shrinks(self) -> list[Mapping[str, Any]]:
        return [event for event in self.events if event["event"] == "shrink"]

    async def until(self, is_met: Any, deadline_s: float) -> None:
        async def wait() -> None:
            while not is_met():
                self._changed.clear()
                await self._changed.wait()

        await asyncio.wait_for(wait(), deadline_s)


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


def elastic_platform(folder: Path, notices: Notices, **scaling: Any) -> LocalPlatform:
    control = ControlOptions(elastic=True, compress=COMPRESS, on_sample=notices.add_sample)
    settings = SETTINGS.replace(scaling={"min_servers": 1, "max_servers": SERVERS, "warm_up_s": 0, **scaling})
    return LocalPlatform(
        settings, servers=SERVERS, port=0, state=folder, on_event=notices.add_event, control=control
    )


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
    notices = Notices()
    enrol_canary(tmp_path / "a")
    # The rule `underused` would do the same after 15 minutes; it is off, so that `idle` is tested.
    async with elastic_platform(tmp_path / "a", notices, underused_s=0) as cloud:
        began_s = time.monotonic()
        async with repeating(lambda: ask_as_canary(cloud.url)) as failed:
            await notices.until(notices.shrinks, 60.0)
            first_s = time.monotonic() - began_s
            await notices.until(lambda: len(cloud.servers) == 1, 120.0)
        print(f"first scale-in after {first_s / MINUTE_S:.1f} minutes of the rules")
        assert not failed
        assert {event["reason"] for event in notices.shrinks()} == {"idle for 300 s"}


async def test_one_robot_at_one_frame_a_minute_keeps_the_servers(tmp_path: Path) -> None:
    notices = Notices()
    async with elastic_platform(tmp_path / "a", notices, underused_s=0) as cloud:
        async with connect(cloud.url, token=cloud.issue_token("robot")) as robot:
            began = notices.samples
            async with repeating(lambda: robot.call("echo", {"value": 1})) as failed:
                # Samples are taken once a second or more often: this is twice as long as idleness takes.
                await notices.until(lambda: notices.samples > began + 2 * 5 * MINUTE_S, 120.0)
        assert not failed
        assert not notices.shrinks()
