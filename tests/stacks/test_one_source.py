"""One place to edit: what cdk.json says arrives in templates, boot files, Lambda and local servers alike."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from rse_pf.config import PlatformSettings, load_settings
from rse_pf.config.server_settings import server_settings
from rse_pf.local.control.platform import LocalPlatform

Assembly = Any

WATCHED = {
    "scaling": ("busy_cpu_percent", "min_servers", "max_servers", "idle_s"),
    "serving": ("port", "control_port"),
}


def carried(assembly: Assembly) -> list[PlatformSettings]:
    """Return the settings inside of every asset: the servers' package and the Lambda's."""
    return [load_settings(path) for path in sorted(assembly.folder.glob("asset.*/settings.json"))]


def test_boot_files_and_lambda_carry_the_very_settings(assembly: Assembly) -> None:
    found = carried(assembly)

    assert len(found) == 2
    server = PlatformSettings.from_dict(server_settings(assembly.settings))
    assert {each.digest() for each in found} == {assembly.settings.digest(), server.digest()}
    for group, names in WATCHED.items():
        for name in names:
            expected = getattr(getattr(assembly.settings, group), name)
            # A server does not read what decides how many of them there are.
            carrying = (
                found if group == "serving" else [each for each in found if each.digest() != server.digest()]
            )
            assert {getattr(getattr(each, group), name) for each in carrying} == {expected}


@pytest.mark.system
async def test_local_servers_answer_with_the_digest_of_the_same_file(
    assembly: Assembly, tmp_path: Path
) -> None:
    settings = assembly.settings.replace(data={"enabled": False})

    async with LocalPlatform(settings, state=tmp_path / "state", servers=1, port=0) as cloud:
        status, written = (await cloud.status())[0], load_settings(tmp_path / "state" / "settings.json")
    assert status["settings"] == written.digest() == settings.digest()
    assert written.scaling == settings.scaling
