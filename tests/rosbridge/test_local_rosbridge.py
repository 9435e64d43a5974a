"""The rosbridge server of the local platform: its clients outlive backend servers, and it is replaced."""

from __future__ import annotations

import asyncio
import json
import signal
from pathlib import Path
from typing import Any

import pytest
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import InvalidStatus

from rse_pf.config import PlatformSettings
from rse_pf.local import faults
from rse_pf.local.control.control_plane import ControlOptions
from rse_pf.local.control.platform import LocalPlatform
from rse_pf.local.control.status import platform_status, status_table
from rse_pf.local.state import read_state

pytestmark = pytest.mark.system

WAIT_S = 60.0
SETTINGS = PlatformSettings().replace(serving={"rosbridge": True})


async def join(platform: LocalPlatform, robot: str) -> ClientConnection:
    """Connect through the load balancer; while the rosbridge server is replaced, try again."""
    headers = {"Authorization": f"Bearer {platform.issue_token(robot)}"}
    url = platform.url.removesuffix("/ws") + "/rosbridge"
    while True:
        try:
            return await connect(url, additional_headers=headers, proxy=None)
        except (OSError, InvalidStatus):
            await asyncio.sleep(0.1)  # the next attempt; the caller bounds the time


async def echo(socket: ClientConnection, value: str) -> Any:
    """Return the answer to a call."""
    call = {
        "op": "call_service",
        "id": value,
        "service": "/echo",
        "args": {"value": value},
        "timeout": WAIT_S,
    }
    await socket.send(json.dumps(call))
    return json.loads(await asyncio.wait_for(socket.recv(), WAIT_S))["values"]


async def test_a_client_survives_the_death_of_all_servers_and_finds_a_new_rosbridge_server(
    tmp_path: Path,
) -> None:
    control = ControlOptions(elastic=True)
    async with LocalPlatform(SETTINGS, state=tmp_path / "p", servers=2, port=0, control=control) as platform:
        socket = await asyncio.wait_for(join(platform, "ros-1"), WAIT_S)
        assert await echo(socket, "before") == {"value": "before"}
        for server in platform.servers:
            platform.kill(server.name)
        assert await echo(socket, "after") == {"value": "after"}, "on the same connection"

        state = read_state(tmp_path / "p")
        assert state is not None
        assert "rosbridge server  rosbridge-1 is ready" in status_table(
            await platform_status(state, sample_s=0.0)
        )
        faults.signal_tree(faults.find_server(state, "rosbridge-1").process, signal.SIGKILL)
        await asyncio.wait_for(socket.wait_closed(), WAIT_S)
        socket = await asyncio.wait_for(join(platform, "ros-1"), WAIT_S)
        assert await echo(socket, "again") == {"value": "again"}
        await socket.close()
