"""The canary as an enrolled robot of the local platform, through its load balancer."""

from __future__ import annotations

import asyncio
import json
import time
from pathlib import Path

import pytest

from rse_pf.auth.roster import EnrolledRobot
from rse_pf.auth.tokens import SigningKey
from rse_pf.auth.trust_store import AccessControlStore
from rse_pf.aws.canary.handler import ask_known_pose
from rse_pf.config import PlatformSettings
from rse_pf.errors import ConnectError
from rse_pf.local.control.platform import LocalPlatform
from rse_pf.object_store import DirectoryStore

pytestmark = [pytest.mark.system, pytest.mark.slow]


def test_an_enrolled_canary_is_served_through_the_load_balancer_and_another_key_is_not(
    tmp_path: Path,
) -> None:
    settings = PlatformSettings()
    key = SigningKey.of_robot(b"c" * 32)

    def ask(url: str, key: SigningKey) -> dict[str, object]:
        token = key.issue("canary", now=time.time(), token_id="t", settings=settings.auth)
        return ask_known_pose(url, token, settings, trace="t" * 32, clock=time.monotonic)

    async def run() -> None:
        access = AccessControlStore(DirectoryStore(tmp_path / "a"))
        robot = EnrolledRobot(
            robot="canary", x=json.loads(key.public_json())["x"], scopes=("services:pnp",)
        )  # fmt: skip
        access.change_roster(lambda roster: roster.enrolled(robot))
        async with LocalPlatform(settings, servers=2, port=0, state=tmp_path / "a") as cloud:
            told = await asyncio.to_thread(ask, cloud.url, key)
            assert told["server"] in ("server-1", "server-2")
            with pytest.raises(ConnectError, match="401"):
                await asyncio.to_thread(ask, cloud.url, SigningKey.of_robot(b"d" * 32))

    asyncio.run(run())
