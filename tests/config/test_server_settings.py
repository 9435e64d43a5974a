"""What travels to the servers: changing anything else replaces no server."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest

from rse_pf.config import PlatformSettings
from rse_pf.config.server_settings import READ_BY_SERVERS, server_settings
from rse_pf.config.settings import setting_rows
from rse_pf.config.validation import SettingRow
from rse_pf.errors import SettingsError

ROWS = list(setting_rows())
BASE = PlatformSettings()
TOGETHER: dict[tuple[str, str], dict[str, dict[str, Any]]] = {
    ("cloud", "allow_insecure"): {
        "cloud": {"certificate_arn": "arn:aws:acm:a:1:certificate/b", "domain_name": "a.org"}
    },
    ("local", "certificate"): {"local": {"private_key": "key.pem"}},
    ("local", "private_key"): {"local": {"certificate": "chain.pem"}},
    ("scaling", "period_s"): {"scaling": {"idle_s": 420}},
}
"""Settings that are refused alone, with what they need."""


def changed(row: SettingRow) -> tuple[PlatformSettings, PlatformSettings] | None:
    """Return settings without and with another value of one of them; None where no other one was found."""
    value = row.default
    tries: list[Any] = [*(row.choices or ())]
    if isinstance(value, bool):
        tries = [not value]
    elif isinstance(value, int):
        tries += [value + 1, value - 1, value * 2, 70]
    elif isinstance(value, float):
        tries += [value * 1.01 + 0.001, value * 0.99 - 0.001]
    else:
        tries += [
            "other", "https://robots.example.org", "https://robots.example.org/burst", "weekdays 08:00 min 3",
            "Asia/Seoul", "m7i.large", "192.0.2.0/24",
        ]  # fmt: skip
    companions = TOGETHER.get((row.group, row.name), {})
    try:
        before = BASE.replace(**companions)
    except SettingsError:
        before = BASE
    for other in tries:
        if other == value:
            continue
        groups = {**companions, row.group: {**companions.get(row.group, {}), row.name: other}}
        try:
            return before, BASE.replace(**groups)
        except SettingsError:
            continue
    return None


@pytest.mark.parametrize("row", ROWS, ids=[f"{row.group}.{row.name}" for row in ROWS])
def test_a_setting_changes_the_package_exactly_when_a_server_reads_it(row: SettingRow) -> None:
    pair = changed(row)
    assert pair is not None, f"no other value found for {row.group}.{row.name}: add one to TOGETHER"
    before, after = map(server_settings, pair)
    travels = row.name in READ_BY_SERVERS.get(row.group, (row.name,))

    assert (after != before) == travels


def test_the_listed_settings_exist_and_a_server_starts_with_what_travels() -> None:
    known = {group.name: group.type for group in dataclasses.fields(PlatformSettings)}
    for group, names in READ_BY_SERVERS.items():
        assert group in known
        assert set(names) <= set(BASE.to_dict()[group])

    assert server_settings(PlatformSettings.from_dict(server_settings(BASE))) == server_settings(BASE)
