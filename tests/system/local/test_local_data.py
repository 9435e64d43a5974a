"""The data service of the local platform: through the load balancer, killed, stopped, and ended."""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import client_sdk
from client_sdk.transfer.data_client import DataClient, DataOptions
from rse_pf.config import PlatformSettings
from rse_pf.errors import ConnectError, RsePfError
from rse_pf.identity import RobotId, object_name
from rse_pf.local import faults
from rse_pf.local.control.control_plane import ControlOptions
from rse_pf.local.control.platform import LocalPlatform
from rse_pf.local.control.status import data_url, platform_status, status_table
from rse_pf.local.state import read_state
from rse_pf.storage.object_store import DirectoryStore

pytestmark = pytest.mark.system

WAIT_S = 60.0
SETTINGS = PlatformSettings()
MIB = 1 << 20


class Events:
    """The events of a platform; `next` waits for one."""

    def __init__(self) -> None:
        self._events: asyncio.Queue[Any] = asyncio.Queue()

    def __call__(self, event: Any) -> None:
        self._events.put_nowait((time.monotonic(), dict(event)))

    async def next(self, name: str) -> tuple[float, dict[str, Any]]:
        async def wait() -> tuple[float, dict[str, Any]]:
            while (found := await self._events.get())[1]["event"] != name:
                pass
            return found

        event: tuple[float, dict[str, Any]] = await asyncio.wait_for(wait(), WAIT_S)
        return event


@contextlib.contextmanager
def client(platform: LocalPlatform, **options: Any) -> Iterator[DataClient]:
    """A robot's client, closed at the end."""
    chosen = DataOptions(part_bytes=MIB // 4, first_pause_s=0.02, random=random.Random(1), **options)
    with contextlib.closing(
        DataClient(platform.url, lambda: platform.issue_token("robot-1"), chosen)
    ) as made:
        yield made


async def localise_in(platform: LocalPlatform, name: str, digest: str) -> str:
    """Return the error code of a ``localise`` call of robot *name* with an object that is not a map."""
    camera = {"fx": 500.0, "fy": 500.0, "cx": 320.0, "cy": 240.0, "width": 640, "height": 480}
    request = {
        "map": {"object": digest}, "camera": camera, "pixels": np.zeros((40, 2)),
        "descriptors": bytes(32 * 40),
    }  # fmt: skip
    async with client_sdk.connect(platform.url, token=platform.issue_token(name)) as robot:
        with pytest.raises(RsePfError) as refused:
            await robot.call("localise", request)
    return refused.value.code


def test_services_read_what_a_robot_stored_through_the_load_balancer(
    tmp_path: Path, gone: Callable[[int], None]
) -> None:
    data = random.Random(7).randbytes(2 * MIB)
    events = Events()

    async def run(resources: contextlib.ExitStack) -> list[int]:
        platform = LocalPlatform(
            SETTINGS,
            servers=1,
            port=0,
            state=tmp_path / "a",
            data=True,
            control=ControlOptions(elastic=True),
            on_event=events,
        )
        async with platform:
            robot = resources.enter_context(client(platform))
            digest = await asyncio.to_thread(robot.upload, data)
            assert await asyncio.to_thread(robot.download, digest) == data
            store = DirectoryStore(tmp_path / "a" / "objects")
            assert store.get(object_name(RobotId("default", "robot-1"), digest)) == data
            assert await localise_in(platform, "robot-1", digest) == "bad-request", "the object was not read"
            assert await localise_in(platform, "robot-2", digest) == "not-found"

            state = read_state(platform.state)
            assert state is not None
            assert state.data_server is not None
            (first,) = platform.status_document()["data_servers"]
            assert first["pid"] == state.data_server.process.pid
            assert first["running"] is True
            status = await platform_status(state, sample_s=0.0)
            assert status["data_servers"][0]["state"] == "ready"
            assert f"large data goes to  {data_url(platform.url)}" in status_table(status)

            server = faults.find_server(state, "data-1")
            killed_s = time.monotonic()
            faults.signal_tree(server.process, signal.SIGKILL)
            await events.next("data-server-down")
            back_s, event = await events.next("data-server-up")
            print(f"back after {back_s - killed_s:.2f} s, load {os.getloadavg()[0]:.1f}")
            assert event["port"] == first["port"]
            assert await asyncio.to_thread(robot.download, digest) == data

            faults.signal_tree(platform.data_servers.state.process, signal.SIGSTOP)  # type: ignore[union-attr]
            await events.next("data-server-silent")
            await events.next("data-server-up")
            assert await asyncio.to_thread(robot.download, digest) == data
            return [first["pid"], event["pid"], platform.data_servers.document()[0]["pid"]]

    with contextlib.ExitStack() as resources:
        pids = asyncio.run(run(resources))
    assert len(set(pids)) == 3
    for pid in pids:
        gone(pid)


async def test_without_a_data_service_an_upload_says_so_soon(tmp_path: Path) -> None:
    async with LocalPlatform(SETTINGS, servers=1, port=0, state=tmp_path / "a") as platform:
        assert platform.status_document()["data_servers"] == []
        with client(platform, deadline_s=0.1) as robot, pytest.raises(ConnectError) as refused:
            await asyncio.to_thread(robot.upload, b"data")
        assert "has no data service" in refused.value.message
        assert "--no-data" in refused.value.hint
