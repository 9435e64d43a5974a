"""A platform on a small disk that another program fills: robots are served, and can still be cut off."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from client_sdk import connect
from rse_pf.audit.log import CONTROL_PLANE, audit_folder, read_entries
from rse_pf.cli.main import main
from rse_pf.config import PlatformSettings
from rse_pf.errors import RsePfError
from rse_pf.local.control.control_plane import ControlOptions
from rse_pf.local.control.platform import LocalPlatform
from rse_pf.local.control.status import platform_status, status_table
from rse_pf.local.state import read_state

pytestmark = pytest.mark.system

SETTINGS = PlatformSettings().replace(local={"warm_standby": False})
SOON_S = 60.0
"""A server starts in 2 s, and in 10 s on a machine with ten other processes."""


@pytest.fixture
def disk(small_disk: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a disk of 24 MiB where platforms have their state."""
    place = small_disk("24m")
    monkeypatch.setenv("XDG_STATE_HOME", str(place))
    return place


async def until(condition: Callable[[], bool]) -> None:
    """Wait until *condition* holds."""
    ends_s = time.monotonic() + SOON_S
    while not condition():
        assert time.monotonic() < ends_s, "it never came"
        await asyncio.sleep(0.02)


async def fails(robot: Any) -> bool:
    try:
        await robot.call("echo", {"value": 1}, deadline_s=1.0)
    except RsePfError:
        return True
    return False


def test_robots_are_served_and_cut_off_on_a_full_disk_and_a_server_is_back_with_the_space(
    disk: Path, fill: Callable[[Path], Path]
):
    asyncio.run(live_through_a_full_disk(disk, fill))


async def live_through_a_full_disk(disk: Path, fill: Callable[[Path], Path]) -> None:
    """Fill the disk, cut robots off, kill a server, and make space again."""
    events: list[Mapping[str, Any]] = []
    cloud = LocalPlatform(
        SETTINGS, state=disk / "rse-pf" / "default", servers=2, port=0, adoptable=True,
        control=ControlOptions(elastic=True, rebalance=False), on_event=events.append,
    )  # fmt: skip

    def names() -> list[str]:
        return [event["event"] for event in events]

    async with cloud, contextlib.AsyncExitStack() as stack:
        robots = {}
        for name in ("kept", "stolen", "lost"):
            opened = connect(cloud.url, token=cloud.issue_token(name))
            robots[name] = await stack.enter_async_context(opened)
            await robots[name].call("echo", {"value": name})
        hog = fill(disk)
        await until(lambda: "disk-full" in names())

        assert main(["robot", "disable", "stolen", "--not-enrolled"]) == 0
        assert main(["token", "revoke", "--all-of", "lost", "--not-enrolled"]) == 0
        for number in range(40):  # the reserve is not used up by commands
            assert main(["robot", "disable", f"other-{number}", "--not-enrolled"]) == 0
        await until(lambda: not any(robots[name].connected for name in ("stolen", "lost")))
        for name in ("stolen", "lost"):
            assert await fails(robots[name])

        victim = cloud.servers[0].name
        cloud.kill(victim)
        await until(lambda: len(cloud.servers) == 1)
        for _ in range(50):
            assert (await robots["kept"].call("echo", {"value": 7}, keep=True)).reply == {"value": 7}
        state = read_state(cloud.state)
        assert state is not None
        table = status_table(await platform_status(state, sample_s=0.05))
        assert "disk full" in table
        assert "replace" not in names(), "a server that cannot start is not launched"

        hog.unlink()
        await until(lambda: len(cloud.servers) == 2)
        await until(lambda: "disk-ok" in names() or "disk-low" in names())

    reasons = [event["reason"] for event in events if event["event"] == "disk-full"]
    assert "full" in reasons[0]
    assert str(cloud.state) in reasons[0]
    recorded = read_entries(audit_folder(cloud.state) / f"{CONTROL_PLANE}.jsonl")
    assert "platform.disk-full" in {entry.action for entry in recorded}
