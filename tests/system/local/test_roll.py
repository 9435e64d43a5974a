"""A roll to a release that does not start stops at its first server, and no robot notices."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from system.local.test_control_plane import SETTINGS, News, asking, check, platform

from rse_pf.errors import ConfigurationError

pytestmark = pytest.mark.system

PROGRAM = """
import pathlib, runpy, sys, time

broken = pathlib.Path({flag!r})
if broken.exists():
    if broken.read_text() == "hangs":
        time.sleep(3600)
    sys.exit("no such setting")
sys.argv[0] = "rse-pf"
runpy.run_module("rse_pf.cli.main", run_name="__main__")
"""


@pytest.mark.parametrize("fault", ["ends", pytest.param("hangs", marks=pytest.mark.slow)])
async def test_a_broken_release_stops_the_roll_at_its_first_server_and_loses_nothing(
    tmp_path: Path, fault: str
) -> None:
    flag, script = tmp_path / "broken", tmp_path / "release.py"
    script.write_text(PROGRAM.format(flag=str(flag)), encoding="utf-8")

    news = News()
    options = {"program": (sys.executable, str(script)), "settings": SETTINGS}
    async with platform(tmp_path / "a", news, **options) as cloud:
        async with asking(cloud) as tally:
            flag.write_text(fault)
            with pytest.raises(ConfigurationError, match="stopped at new server 1 of 2") as told:
                await cloud.roll()
            assert "server-3.log" in told.value.hint
            assert [server.name for server in cloud.servers] == ["server-1", "server-2"]
            before = tally.answered
            await news.until(lambda: tally.answered > before + 50)
            launched = [event for event in news.events if event["event"] == "server-launched"]
            assert len(launched) == 3, "the broken release was started again"

            flag.unlink()
            await cloud.roll()
            assert [server.name for server in cloud.servers] == ["server-4", "server-5"]
        check(tally)


async def test_a_roll_starts_no_server_from_the_memory_of_an_old_standby(tmp_path: Path) -> None:
    news = News()
    async with platform(tmp_path / "a", news, servers=1) as cloud:
        old = await news.heard("standby-started")
        await cloud.roll()
        launched = await news.heard("server-launched", server="server-2")
        assert launched["pid"] != old["pid"]
