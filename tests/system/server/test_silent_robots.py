"""Thousands of connections that send nothing are closed within 10 s, and robots are served meanwhile."""

from __future__ import annotations

import asyncio
import contextlib
import resource
import time
from collections.abc import Iterator
from typing import Any

import pytest

from rse_pf.wire import Result

pytestmark = pytest.mark.system

SILENT = 5000
CLOSED_WITHIN_S = 10.0


@pytest.fixture
def many_files() -> Iterator[None]:
    """Let this process and the server that it starts have as many sockets as the test opens."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = SILENT + 1000
    if hard != resource.RLIM_INFINITY and hard < wanted:
        pytest.skip(f"this machine lets a process have {hard} files")
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, wanted), hard))
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


async def open_for_s(port: int) -> float:
    """Connect, send nothing, and return how long the server left the connection open."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    opened = time.monotonic()
    with contextlib.suppress(ConnectionError):
        assert await reader.read() == b""
    writer.close()
    return time.monotonic() - opened


@pytest.mark.usefixtures("many_files")
async def test_five_thousand_silent_connections_are_closed_within_ten_seconds(start_server: Any) -> None:
    server = start_server(keys=True)

    silent = [asyncio.create_task(open_for_s(server.port)) for _ in range(SILENT)]
    await asyncio.wait(silent, return_when=asyncio.FIRST_COMPLETED)
    async with server.robot(token=server.token()) as robot:
        assert isinstance(await robot.ask(1, "echo", {"value": 1}), Result)
    lasted_s = await asyncio.gather(*silent)

    print(f"{SILENT} silent connections were open for at most {max(lasted_s):.2f} s")
    assert max(lasted_s) <= CLOSED_WITHIN_S
