"""The local load balancer keeps its places for robots, whatever unauthenticated clients send."""

from __future__ import annotations

import asyncio
import time
from pathlib import Path

import pytest

from rse_pf.config import PlatformSettings
from rse_pf.local.balancer.envoy_config import Target
from rse_pf.local.balancer.load_balancer import EnvoyLoadBalancer

pytestmark = [pytest.mark.system, pytest.mark.timeout(60)]

SOON_S = 10.0
TIMEOUT_S = 0.4
UPGRADE = b"Upgrade: websocket\r\nConnection: Upgrade\r\n"


async def echo_server(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Answer health checks; open each WebSocket and send back what it brings."""
    try:
        while b"upgrade: websocket" not in (await reader.readuntil(b"\r\n\r\n")).lower():
            writer.write(b"HTTP/1.1 200 OK\r\nContent-Length: 0\r\n\r\n")
        writer.write(b"HTTP/1.1 101 Yes\r\n" + UPGRADE + b"\r\n")
        while data := await reader.read(100):
            writer.write(data)
    except (asyncio.IncompleteReadError, ConnectionError):
        pass
    finally:
        writer.close()


async def keep_asking(port: int) -> float:
    """Ask for a path that does not exist until the connection is closed; return after how many seconds."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    began = time.monotonic()
    try:
        while time.monotonic() - began < SOON_S:
            writer.write(b"GET /x HTTP/1.1\r\nHost: x\r\n\r\n")
            await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), SOON_S)
    except (asyncio.IncompleteReadError, ConnectionError):
        pass
    writer.close()
    return time.monotonic() - began


async def test_requests_for_nothing_keep_no_place_and_an_open_websocket_keeps_its_own(tmp_path: Path) -> None:
    upstream = await asyncio.start_server(echo_server, "127.0.0.1", 0)
    port = upstream.sockets[0].getsockname()[1]
    settings = PlatformSettings.from_dict({"session": {"hello_timeout_s": TIMEOUT_S}})
    balancer = EnvoyLoadBalancer(settings, folder=tmp_path, port=0)
    balancer.launch()
    try:
        await balancer.wait_live(SOON_S)
        balancer.set_targets([Target(name="robots", port=port, control_port=port)])
        assert await balancer.wait_healthy(["robots"], SOON_S)
        reader, writer = await asyncio.open_connection("127.0.0.1", balancer.port)
        writer.write(b"GET /ws HTTP/1.1\r\nHost: x\r\n" + UPGRADE + b"\r\n")
        assert b" 101 " in await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), SOON_S)

        held_s = [await keep_asking(balancer.port) for _ in range(4)]

        assert max(held_s) < 2 * TIMEOUT_S + 2.0
        assert sum(held_s) > 3 * TIMEOUT_S, "the WebSocket is older than its connection may last"
        writer.write(b"still here")
        assert await asyncio.wait_for(reader.readexactly(10), SOON_S) == b"still here"
        writer.close()
    finally:
        balancer.kill()
        upstream.close()
