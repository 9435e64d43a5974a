"""Two platforms with one key stand for two regions: a robot's identity is valid in both."""

from __future__ import annotations

import random
from pathlib import Path

import pytest

import client_sdk
from rse_pf.config import PlatformSettings
from rse_pf.errors import AuthError
from rse_pf.local.control.platform import LocalPlatform
from rse_pf.local.firewall import ensure_key

pytestmark = [pytest.mark.slow, pytest.mark.system]

SETTINGS = PlatformSettings.from_dict({"local": {"start_timeout_s": 60.0, "warm_standby": False}})


async def test_one_identity_is_valid_in_both_regions_and_another_identity_is_not(tmp_path: Path) -> None:
    for name, seed in (("home", b"h" * 32), ("replica", b"h" * 32), ("stranger", b"s" * 32)):
        (tmp_path / name).mkdir(mode=0o700)
        ensure_key(tmp_path / name, seed=seed, key_id="key-1")

    async with (
        LocalPlatform(SETTINGS, state=tmp_path / "home", servers=1, port=0) as home,
        LocalPlatform(SETTINGS, state=tmp_path / "replica", servers=1, port=0) as replica,
        LocalPlatform(SETTINGS, state=tmp_path / "stranger", servers=1, port=0) as stranger,
    ):
        token = home.issue_token("robot-1")
        for region in (home, replica):
            async with client_sdk.connect(region.url, token=token, random=random.Random(1)) as robot:
                assert (await robot.call("echo", {"text": "here"})).reply
        with pytest.raises(AuthError):
            async with client_sdk.connect(stranger.url, token=token, random=random.Random(1)) as robot:
                await robot.call("echo", {"text": "there"})
