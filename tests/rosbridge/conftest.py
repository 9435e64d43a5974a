"""A backend server, and a rosbridge server in the event loop of the test."""

from __future__ import annotations

import socket
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from typing import Any

import pytest

from rse_pf.config import PlatformSettings
from rse_pf.extensions.rosbridge.server import open_rosbridge
from tests.kit.guarded_server import GuardedServer
from tests.kit.rosbridge_clients import Bridge

UNLIMITED = {"max_commands_per_s": 0.0}


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[GuardedServer]:
    """Return a backend server without a limit of commands."""
    folder = tmp_path_factory.mktemp("server")
    with GuardedServer(folder, workers=1, session=UNLIMITED, auth={"leeway_s": 1}) as started:
        yield started


@asynccontextmanager
async def opened(server: GuardedServer, **groups: dict[str, Any]) -> AsyncIterator[Bridge]:
    """Open a rosbridge server whose settings have *groups*; all of its clients are closed at the end."""
    settings = PlatformSettings.from_dict({"session": UNLIMITED, **groups})
    listening = socket.create_server(("127.0.0.1", 0))
    bridge = Bridge(server, listening.getsockname()[1])
    running = await open_rosbridge(settings, server.url, listening)
    try:
        yield bridge
    finally:
        await bridge.close()
        running.close()
        await running.wait_closed()
