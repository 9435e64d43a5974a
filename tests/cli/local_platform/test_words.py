"""What the actions of a running platform tell: robots, addresses of a LAN, refused pauses."""

from __future__ import annotations

import math
import os
from pathlib import Path

import pytest

from rse_pf.cli.local_platform.lan import chosen_address, lan_lines
from rse_pf.cli.local_platform.robots import robots_table
from rse_pf.config import HealthSettings
from rse_pf.errors import UsageError
from rse_pf.local.faults.faults import longest_pause_s
from rse_pf.local.lan.listener import LanListener
from rse_pf.local.processes import ProcessMark, mark_of
from rse_pf.local.state import PlatformState, ServerState

ROW = {
    "robot": "robot-1", "tenant": "default", "server": "server-2", "codec": "bin", "connected_s": 5400.0,
    "commands": 12, "last_result": "ok",
}  # fmt: skip


def test_the_table_of_robots_has_a_row_for_each_and_says_how_many_are_left_out() -> None:
    lines = robots_table(
        {"robots": [ROW, {**ROW, "robot": "r2", "last_result": ""}], "count": 5, "silent": []}
    )

    assert lines[0].split("  ")[0] == "robot"
    assert lines[1].split() == ["robot-1", "default", "server-2", "bin", "1.5", "h", "12", "ok"]
    assert lines[2].split()[-1] == "-"
    assert lines[3] == "and 3 more"
    assert robots_table({"robots": [], "count": 0, "silent": []}) == ["no robot is connected"]


def test_the_lines_of_a_lan_name_port_authority_and_fingerprint(tmp_path: Path) -> None:
    lan = LanListener(address="10.1.2.3", folder=tmp_path)
    lan.prepare("default", now_s=1_800_000_000.0)

    text = "\n".join(lan_lines("wss://10.1.2.3:8700/ws", lan.authority(), tmp_path / "authority.crt", ""))

    assert str(tmp_path / "authority.crt") in text
    assert "TCP port 8700" in text
    assert lan.authority().fingerprint in text
    assert chosen_address(None) == ""


def test_a_pause_may_last_until_the_control_plane_replaces_the_server() -> None:
    own, gone = mark_of(os.getpid()), ProcessMark(pid=1, began="1@another-boot")
    assert own is not None
    server = ServerState(name="server-1", process=own)
    data = ServerState(name="data-1", process=own)
    state = PlatformState(
        name="p", control_plane=own, url="", settings_digest="", settings_file="", key_file="",
        servers=(server,), data_server=data,
    )  # fmt: skip
    health = HealthSettings(unhealthy_checks=4)

    assert longest_pause_s(state, server, health) == 1.0
    assert longest_pause_s(state, data, health) == 4.0
    unattended = PlatformState(
        name="p", control_plane=gone, url="", settings_digest="", settings_file="", key_file=""
    )
    assert longest_pause_s(unattended, server, health) == math.inf


def test_a_lan_without_tokens_or_with_a_certificate_from_elsewhere_is_refused() -> None:
    from rse_pf.config import PlatformSettings
    from rse_pf.errors import ConfigurationError
    from rse_pf.local.firewall import check_lan_settings

    check_lan_settings(PlatformSettings())
    for changes, said in (
        ({"auth": {"required": False}}, "auth.required"),
        ({"local": {"certificate": "a", "private_key": "b"}}, "local.certificate"),
    ):
        with pytest.raises(ConfigurationError, match=said):
            check_lan_settings(PlatformSettings().replace(**changes))
    with pytest.raises(UsageError):
        chosen_address("0.0.0.0")
