"""Where a server runs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from rse_pf.config import PlatformSettings, load_settings
from rse_pf.config.placement import ServerPlacement, is_loopback, live_ports
from rse_pf.errors import SettingsError

SETTINGS = PlatformSettings.from_dict({"serving": {"port": 9000, "workers": 3}})


def test_a_settings_file_carries_a_placement_with_the_settings(tmp_path: Path) -> None:
    placement = ServerPlacement.of(SETTINGS, host="127.0.0.1", port=0, control_port=0, store="dir:/objects")
    file = tmp_path / "settings.json"
    file.write_text(json.dumps(placement.document(SETTINGS)))

    settings = load_settings(file)

    assert ServerPlacement.read(file, settings) == placement
    assert settings == SETTINGS
    assert settings.digest() == SETTINGS.digest()


def test_a_placement_changes_the_settings_of_its_server_and_nothing_else() -> None:
    placement = ServerPlacement.of(SETTINGS, port=0, store="dir:/objects", live_host="0.0.0.0")

    placed = placement.apply(SETTINGS)

    assert (placed.serving.port, placed.data.store, placed.live.host) == (0, "dir:/objects", "0.0.0.0")
    before = {
        "serving": {"port": 9000},
        "data": {"store": SETTINGS.data.store},
        "live": {"host": "127.0.0.1"},
    }
    assert placed.replace(**before) == SETTINGS


@pytest.mark.parametrize(
    ("placement", "word"),
    [
        ({"port": 70000}, "port"), ({"workers": "two"}, "workers"), ({"listen": "all"}, "listen"),
        ([1], "placement"),
    ],
)  # fmt: skip
def test_a_placement_that_makes_no_sense_is_refused_with_a_hint(
    tmp_path: Path, placement: Any, word: str
) -> None:
    file = tmp_path / "settings.json"
    file.write_text(json.dumps({"placement": placement}))

    with pytest.raises(SettingsError, match=word) as told:
        ServerPlacement.read(file, PlatformSettings())

    assert told.value.hint


@pytest.mark.parametrize("host", ["127.0.0.1", "127.8.0.1", "::1", "localhost"])
def test_a_loopback_address_and_the_name_localhost_are_reached_from_this_machine_alone(host: str) -> None:
    assert is_loopback(host)


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "10.0.0.1", "localhost.example.com", "example.com", ""])
def test_any_other_address_or_name_can_be_reached_from_elsewhere(host: str) -> None:
    assert not is_loopback(host)


def test_owners_of_live_maps_have_known_ports_only_where_other_machines_connect() -> None:
    elsewhere = SETTINGS.replace(live={"host": "0.0.0.0", "first_port": 8900})

    assert live_ports(elsewhere.live) == range(8900, 8964)
    assert live_ports(elsewhere.replace(live={"host": "127.0.0.2"}).live) == range(1)
    assert live_ports(elsewhere.replace(live={"first_port": 0}).live) == range(1)


@pytest.mark.parametrize(
    ("groups", "word"),
    [
        ({"live": {"first_port": 65500}}, "above 65472"),
        ({"data": {"port": 8801}}, "data.port = 8801"),
        ({"serving": {"control_port": 8863}}, "serving.control_port = 8863"),
    ],
)
def test_ports_of_live_maps_that_cannot_be_are_refused_with_a_hint(groups: Any, word: str) -> None:
    with pytest.raises(SettingsError, match=word) as told:
        PlatformSettings.from_dict(groups)

    assert told.value.hint
