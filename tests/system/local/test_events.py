"""What a platform reports to a program that follows its events, and what its logs show of the same time."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
from system.local.test_control_plane import SOON_S, News, platform

from client_sdk import connect
from rse_pf.local.control.platform import LocalPlatform
from rse_pf.local.servers.backend_servers import RSE_PF

pytestmark = pytest.mark.system


async def started(cloud: LocalPlatform, *words: str) -> asyncio.subprocess.Process:
    return await asyncio.create_subprocess_exec(
        *RSE_PF, "local", *words, "--name", cloud.state.name,
        env={**os.environ, "XDG_STATE_HOME": str(cloud.state.parent.parent)}, stdout=asyncio.subprocess.PIPE,
    )  # fmt: skip


@contextlib.asynccontextmanager
async def following(cloud: LocalPlatform) -> AsyncIterator[asyncio.StreamReader]:
    process = await started(cloud, "events", "--follow", "--json")
    assert process.stdout is not None
    try:
        yield process.stdout
    finally:
        process.send_signal(signal.SIGINT)
        assert await asyncio.wait_for(process.wait(), SOON_S) == 0


async def until(events: asyncio.StreamReader, kind: str, **details: Any) -> dict[str, Any]:
    """Return the first event of *kind* with these details."""
    while True:
        event: dict[str, Any] = json.loads(await asyncio.wait_for(events.readline(), SOON_S))
        if event["kind"] == kind and all(event[name] == value for name, value in details.items()):
            return event


async def test_robots_and_servers_are_in_one_stream_with_time_tenant_robot_and_kind(tmp_path: Path) -> None:
    began_s = time.time()
    async with platform(tmp_path / "rse-pf" / "a", News(), servers=1) as cloud:
        async with following(cloud) as events:
            await until(events, "server-healthy", server="server-1")
            async with connect(cloud.url, token=cloud.issue_token("r1")) as robot:
                await robot.call("echo", {"value": 1})
                online = await until(events, "robot-online", robot="r1", tenant="default", server="server-1")
            await until(events, "robot-offline", robot="r1", server="server-1")
            cloud.kill("server-1")
            killed = await until(events, "server-killed", server="server-1")
            assert (killed["tenant"], killed["robot"]) == (None, None)
            await until(events, "server-healthy", server="server-2")
            assert began_s <= online["time"] <= killed["time"] <= time.time()

        show = await started(
            cloud, "logs", "--since", "1h", "--level", "warning", "--server", "control-plane"
        )
        shown, _ = await asyncio.wait_for(show.communicate(), SOON_S)
        today = time.strftime("%Y-%m-%d ", time.localtime(began_s))
        lines = shown.decode().splitlines()
        assert all(line.startswith(today[:4]) for line in lines)
        assert [line.split()[4] for line in lines][:2] == ["server-killed", "server-gone"]
