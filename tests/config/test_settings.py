"""Settings: checked once, when the object is made, and in words that help."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from rse_pf.config import PlatformSettings, SettingRow, load_settings, setting_rows
from rse_pf.errors import SettingsError

ROWS = list(setting_rows())


def other(row: SettingRow) -> Any:
    """Return a legal value of *row* that differs from its default."""
    if isinstance(row.default, bool):
        return not row.default
    if isinstance(row.default, str):
        return next((each for each in row.choices if each != row.default), row.default + "x")
    step = 1 if isinstance(row.default, int) else 0.5
    for value in (row.default + step, row.default - step):
        if (row.low is None or value >= row.low) and (row.high is None or value <= row.high):
            return value
    raise AssertionError(row)


def write(folder: Path, document: Any) -> Path:
    path = folder / "cdk.json"
    path.write_text(json.dumps(document), encoding="utf-8")
    return path


def test_the_paper_is_the_default() -> None:
    settings = PlatformSettings()

    assert settings.scaling.busy_cpu_percent == 70.0
    assert settings.scaling.idle_s == 300


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ({"scaling": {"max_servers": 1}}, ["scaling.max_servers = 1", "scaling.min_servers = 2"]),
        ({"scaling": {"idle_s": 90}}, ["scaling.idle_s = 90", "scaling.period_s = 60"]),
        ({"session": {"max_inflated_bytes": 2048}}, ["session.max_message_bytes"]),
        ({"cloud": {"allow_insecure": False}}, ["cloud.certificate_arn", "cloud.domain_name"]),
    ],
)
def test_a_contradiction_is_refused_with_both_numbers(overrides: dict[str, Any], words: list[str]) -> None:
    with pytest.raises(SettingsError) as caught:
        PlatformSettings.from_dict(overrides)

    assert all(word in caught.value.message for word in words)
    assert "cdk.json" in caught.value.hint


@pytest.mark.parametrize(
    ("overrides", "message", "hint"),
    [
        ({"scalling": {}}, "unknown group 'scalling'", "did you mean scaling?"),
        ({"zzz": {}}, "unknown group 'zzz'", "known are serving, session"),
        ({"scaling": {"max_server": 1}}, "unknown setting scaling.max_server", "did you mean max_servers?"),
        ({"scaling": 3}, "scaling must be an object of settings, got int", '"scaling": {'),
        ({"scaling": {"max_servers": "4"}}, "scaling.max_servers = '4' is not of type int", "correct it"),
        ({"scaling": {"max_servers": 4.0}}, "scaling.max_servers = 4.0 is not of type int", "correct it"),
        ({"scaling": {"max_servers": True}}, "scaling.max_servers = True is not of type int", "correct it"),
        ({"scaling": {"busy_cpu_percent": True}}, "is not of type float", "correct it"),
        ({"auth": {"required": 1}}, "auth.required = 1 is not of type bool", "correct it"),
        ({"auth": {"audience": None}}, "auth.audience = None is not of type str", "correct it"),
        ({"scaling": {"busy_cpu_percent": 101}}, "busy_cpu_percent = 101.0 is above 100", "lower it"),
        ({"serving": {"port": -1}}, "serving.port = -1 is below 0", "raise it"),
        ({"serving": {"allowed_origins": "https://a.example *"}}, "'*', which is no origin", "write it"),
        ({"serving": {"allowed_origins": "https://a.example/"}}, "is no origin", "write it"),
        ({"serving": {"log_level": "loud"}}, "is not one of debug, info", "choose"),
        ({"scaling": {"busy_cpu_percent": float("nan")}}, "not a finite number", "correct it"),
        ({"burst": {"url": "robots.example.org"}}, "no place to send commands to", "/burst"),
        ({"burst": {"url": "ftp://robots.example.org/burst"}}, "no place to send commands to", "/burst"),
        ({"cloud": {"replica_maps": "maps s3://maps"}}, "'s3://maps', which is no name of a bucket", "s3://"),
        ({"cloud": {"robot_cidr": "10.0.0.0/33"}}, "'10.0.0.0/33' is no range of IPv4", "192.0.2.0/24"),
        ({"cloud": {"robot_cidr": "10.0.0/24"}}, "'10.0.0/24' is no range of IPv4", "192.0.2.0/24"),
        ({"cloud": {"robot_cidr": "10.0.0.0"}}, "'10.0.0.0' is no range of IPv4", "192.0.2.0/24"),
        (
            {"cloud": {"robot_cidr": "10.0.0.0/255.0.0.0"}},
            "'10.0.0.0/255.0.0.0' is no range of IPv4",
            "192.0.2.0/24",
        ),
        ({"cloud": {"robot_cidr": "2001:db8::/32"}}, "'2001:db8::/32' is no range of IPv4", "192.0.2.0/24"),
        ({"cloud": {"robot_cidr": ""}}, "'' is no range of IPv4", "192.0.2.0/24"),
        ({"session": {"ping_interval_s": float("inf")}}, "not a finite number", "correct it"),
        ({"session": {"ping_interval_s": 10**400}}, "not a finite number", "correct it"),
        ({"serving": {"max_robots": 10**5000}}, "not a finite number", "correct it"),
    ],
)
def test_a_bad_setting_is_refused_with_a_hint(overrides: dict[str, Any], message: str, hint: str) -> None:
    with pytest.raises(SettingsError) as caught:
        PlatformSettings.from_dict(overrides)

    assert message in caught.value.message
    assert hint in caught.value.hint


@pytest.mark.parametrize("row", [row for row in ROWS if row.low is not None], ids=lambda row: row.name)
def test_a_number_below_its_range_is_refused(row: SettingRow) -> None:
    assert row.low is not None
    value = type(row.default)(row.low - 1)

    with pytest.raises(SettingsError, match=f"{row.group}.{row.name}"):
        PlatformSettings.from_dict({row.group: {row.name: value}})


@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"{row.group}.{row.name}")
def test_the_digest_changes_with_every_setting(row: SettingRow) -> None:
    companions: dict[str, dict[str, Any]] = {
        "idle_s": {"idle_s": 360},
        "period_s": {"period_s": 100},
        "max_servers": {"max_servers": 11},
        "allow_insecure": {"certificate_arn": "arn", "domain_name": "robots.example"},
        "certificate": {"private_key": "key.pem"},
        "private_key": {"certificate": "chain.pem"},
        "allowed_origins": {"allowed_origins": "https://robots.example.org"},
        "url": {"url": "/burst"},
        "schedule": {"schedule": "daily 08:00 min 3"},
        "time_zone": {"time_zone": "Asia/Seoul"},
        "other_instance_types": {"other_instance_types": "c6i.large"},
        "replica_maps": {"replica_maps": "maps-in-virginia"},
        "robot_cidr": {"robot_cidr": "192.0.2.0/24"},
        "replica_artifacts": {"replica_artifacts": "artifacts-in-virginia"},
    }
    values = {row.name: other(row), **companions.get(row.name, {})}

    changed = PlatformSettings.from_dict({row.group: values})

    assert changed.digest() != PlatformSettings().digest()


def test_the_digest_is_the_same_wherever_the_settings_are() -> None:
    one = PlatformSettings.from_dict({"local": {"port": 0}, "pnp": {"engine": "opencv"}})
    same = PlatformSettings.from_dict({"pnp": {"engine": "opencv"}, "local": {"port": 0, "servers": 2}})

    assert one.digest() == same.digest()
    assert len(one.digest()) == 16


def test_replace_keeps_the_rest_of_a_group() -> None:
    settings = PlatformSettings.from_dict({"scaling": {"max_servers": 4}})

    changed = settings.replace(scaling={"min_servers": 3})

    assert (changed.scaling.min_servers, changed.scaling.max_servers) == (3, 4)


def test_a_settings_file_holds_overrides_only(tmp_path: Path) -> None:
    path = write(tmp_path, {"app": "python app.py", "context": {"rse-pf": {"scaling": {"max_servers": 4}}}})

    assert load_settings(path).scaling.max_servers == 4


def test_the_file_of_the_working_folder_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path, {"context": {"rse-pf": {"local": {"servers": 5}}}})
    monkeypatch.chdir(tmp_path)

    assert load_settings().local.servers == 5


def test_settings_at_the_top_of_a_file_are_refused_instead_of_being_left_out(tmp_path: Path) -> None:
    file = write(tmp_path, {"serving": {"port": 1}, "session": {}})

    with pytest.raises(SettingsError, match="has serving, session at its top") as refused:
        load_settings(file)

    assert '{"context": {"rse-pf"' in refused.value.hint


@pytest.mark.parametrize(
    "data",
    [b"", b"not json", b"\xff\xfe", b"[" * 100000, b"[]", b'"x"', b'{"context": []}',
     b'{"context": {"rse-pf": [1]}}',
     b'{"context": {"rse-pf": {"serving": {"port": ' + b"9" * 5000 + b"}}}}"],
)  # fmt: skip
def test_a_broken_file_is_a_settings_error_and_nothing_else(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "cdk.json"
    path.write_bytes(data)

    with pytest.raises(SettingsError) as caught:
        load_settings(path)

    assert caught.value.hint


WORDS = st.sampled_from([row.group for row in ROWS]) | st.text(max_size=8)
SETTINGS = st.sampled_from([row.name for row in ROWS]) | st.text(max_size=8)
SCALARS = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8)
VALUES = SCALARS | st.lists(SCALARS, max_size=2) | st.dictionaries(st.text(max_size=3), SCALARS, max_size=2)
GROUPS = st.dictionaries(SETTINGS, VALUES, max_size=3) | VALUES


@given(st.dictionaries(WORDS, GROUPS, max_size=3))
@example({"serving": {"emulated_cores": 10**400}})
@example({"serving": {"workers": -(10**5000)}})
def test_any_overrides_give_settings_or_a_settings_error(overrides: dict[str, Any]) -> None:
    try:
        settings = PlatformSettings.from_dict(overrides)
    except SettingsError as error:
        refusal = error
    else:
        assert PlatformSettings.from_dict(settings.to_dict()) == settings
        return
    assert refusal.hint
    assert len(refusal.report()) < 1500
