"""The fleet page shows the live maps of all tenants."""

from __future__ import annotations

import asyncio
import contextlib
import json
import secrets
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from client_sdk import connect
from rse_pf.extensions.fleet_page.feeds.live_feed import LiveFeed
from rse_pf.extensions.fleet_page.hub import Hub
from rse_pf.local.firewall import key_file, read_key
from tests.kit.fake_map import keyframe_bytes
from tests.system.local.test_control_plane import SETTINGS, SOON_S, News, platform

pytestmark = pytest.mark.system


async def found(hub: Hub, topics: set[str], matches: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
    """Return the first message of *topics* that *matches*."""
    async with contextlib.aclosing(hub.messages(frozenset(topics))) as messages:
        async for data in messages:
            if data.startswith(b"data: "):
                message: dict[str, Any] = json.loads(data.removeprefix(b"data: "))
                if matches(message):
                    return message
    raise AssertionError("the stream ended")


async def test_a_page_shows_live_maps_of_every_tenant_under_the_name_of_the_tenant(tmp_path: Path) -> None:
    async with platform(tmp_path / "a", News(), servers=1) as cloud:
        key = read_key(key_file(cloud.state))

        async def drive(tenant: str) -> None:
            token = key.issue(
                "r1", now=time.time(), token_id=secrets.token_hex(4), settings=SETTINGS.auth, tenant=tenant
            )
            async with connect(cloud.url, token=token) as robot:
                keyframe = {"map": "hall", "segment": 0, "number": 0, "keyframe": keyframe_bytes(1.0, b"")}
                await robot.call("live-keyframe", keyframe, deadline_s=SOON_S)

        for tenant in ("default", "acme"):
            await drive(tenant)
        hub = Hub()
        feeding = asyncio.create_task(LiveFeed(hub, cloud.state).run())
        try:
            listed = found(hub, {"maps"}, lambda message: len(message["value"]) == 2)
            assert (await asyncio.wait_for(listed, SOON_S))["value"] == ["hall", "acme/hall"]
            shown = found(hub, {"maps", "live/acme/hall"}, lambda message: "state" in message["value"])
            assert (await asyncio.wait_for(shown, SOON_S))["topic"] == "live/acme/hall"
        finally:
            feeding.cancel()
            await asyncio.gather(feeding, return_exceptions=True)
