"""A roll to another release or to other settings: robots lose nothing, and one that fails stops at once."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import sys
import threading
from pathlib import Path

import pytest
from system.local.test_control_plane import SETTINGS, News, asking, check, platform

from client_sdk.transfer.data_client import DataClient, DataOptions
from rse_pf.config import PlatformSettings
from rse_pf.errors import ConfigurationError, QuotaExceeded
from rse_pf.local.control.platform import LocalPlatform
from rse_pf.local.servers.backend_servers import RSE_PF
from rse_pf.local.state import platform_settings

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


def written(folder: Path, **groups: object) -> Path:
    file = folder / "new.json"
    file.write_text(json.dumps({"context": {"rse-pf": groups}}), encoding="utf-8")
    return file


async def rolled(cloud: LocalPlatform, file: Path) -> tuple[int, str]:
    """Roll *cloud* with the settings in *file* by the command line; return exit code and what it said."""
    command = [*RSE_PF, "local", "roll", "--name", cloud.state.name, "--settings", str(file)]
    roll = await asyncio.create_subprocess_exec(
        *command, env={**os.environ, "XDG_STATE_HOME": str(cloud.state.parent.parent)},
        stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT,
    )  # fmt: skip
    said, _ = await roll.communicate()
    assert roll.returncode is not None
    return roll.returncode, said.decode()


async def test_a_roll_with_settings_changes_all_servers_and_loses_nothing(tmp_path: Path) -> None:
    folder, over = tmp_path / "rse-pf" / "a", threading.Event()
    wanted = {"session": {"max_in_flight": 3}, "data": {"quota_bytes": 5_000_000}}
    file = written(tmp_path, **wanted)

    def upload(url: str, token: str) -> int:
        count = 0
        with contextlib.closing(DataClient(url, token, DataOptions(first_pause_s=0.05))) as client:
            while not over.is_set():
                client.upload(b"%d" % count)
                count += 1
        return count

    async with platform(folder, News(), data=True) as cloud:
        uploading = asyncio.create_task(asyncio.to_thread(upload, cloud.url, cloud.issue_token("uploader")))
        try:
            async with asking(cloud) as tally:
                code, said = await rolled(cloud, file)
                assert code == 0, said
                assert "session.max_in_flight = 3 (was 8)" in said
                assert [server.name for server in cloud.servers] == ["server-3", "server-4"]
            check(tally)
        finally:
            over.set()
        assert await uploading > 0
        expected = PlatformSettings().replace(**wanted)
        assert {page["settings"] for page in await cloud.status()} == {expected.digest()}
        other = DataClient(cloud.url, cloud.issue_token("other"))
        with contextlib.closing(other), pytest.raises(QuotaExceeded, match="5000000"):
            await asyncio.to_thread(other.upload, bytes(6_000_000))

        code, said = await rolled(cloud, file)
        assert (code, said.count("hint:")) == (2, 1)
        assert "changes no setting" in said


async def test_a_roll_names_settings_that_need_a_restart_and_replaces_nothing(tmp_path: Path) -> None:
    file = written(tmp_path, local={"page_port": 1234}, session={"max_in_flight": 3})
    async with platform(tmp_path / "rse-pf" / "a", News(), servers=1) as cloud:
        code, said = await rolled(cloud, file)
        assert code == 2
        assert "local.page_port needs a restart" in said
        assert "docs/howto/upgrade.md" in said
        assert [server.name for server in cloud.servers] == ["server-1"]
        assert platform_settings(cloud.state) == cloud.settings == SETTINGS


async def test_after_a_roll_that_failed_a_replacement_has_the_old_settings(tmp_path: Path) -> None:
    file = written(tmp_path, services={"folder": str(tmp_path / "missing")})
    news = News()
    async with platform(tmp_path / "rse-pf" / "a", news, servers=1) as cloud:
        code, said = await rolled(cloud, file)
        assert code == 1
        assert "stopped at new server 1 of 1" in said
        cloud.kill("server-1")
        await news.heard("server-healthy", server="server-3")
        assert {page["settings"] for page in await cloud.status()} == {SETTINGS.digest()}
