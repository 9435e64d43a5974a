"""The listener is on loopback; only the owner can read the key."""

from __future__ import annotations

from pathlib import Path

import pytest

from rse_pf.auth.tokens import KeySet, SigningKey, verify_token
from rse_pf.config import AuthSettings
from rse_pf.errors import ConfigurationError, UsageError
from rse_pf.local.firewall import check_listener, ensure_key, key_file, key_set_file, read_key

SEED = b"s" * 32


@pytest.mark.parametrize("host", ["0.0.0.0", "192.0.2.1", "::", "example.org"])
def test_a_door_that_others_can_reach_is_refused(host: str) -> None:
    with pytest.raises(ConfigurationError, match="other machines"):
        check_listener(host, 0)


def test_the_key_is_its_owners_alone_and_the_public_half_verifies(tmp_path: Path) -> None:
    key = ensure_key(tmp_path, seed=SEED, key_id="k")
    token = key.issue("robot-1", now=1000.0, token_id="t", settings=AuthSettings())
    public = KeySet.from_json(key_set_file(tmp_path).read_text())

    assert key_file(tmp_path).stat().st_mode & 0o777 == 0o600
    assert '"d"' not in key_set_file(tmp_path).read_text()
    assert verify_token(token, keys=public, now=1001.0, settings=AuthSettings()).robot.name == "robot-1"


def test_a_platform_that_starts_again_keeps_the_keys_of_a_rotation(tmp_path: Path) -> None:
    key = ensure_key(tmp_path, seed=SEED, key_id="new")
    old = SigningKey.from_seed(b"o" * 32, "old")
    both = {each.key_id: each.key_set().get(each.key_id) for each in (key, old)}
    key_set_file(tmp_path).write_text(KeySet({kid: half for kid, half in both.items() if half}).to_json())

    ensure_key(tmp_path, seed=SEED, key_id="new")

    assert KeySet.from_json(key_set_file(tmp_path).read_text()).get("old") is not None


def test_a_key_that_others_may_read_is_refused(tmp_path: Path) -> None:
    ensure_key(tmp_path, seed=SEED, key_id="k")
    key_file(tmp_path).chmod(0o640)

    with pytest.raises(UsageError, match="others may read"):
        read_key(key_file(tmp_path))


@pytest.mark.parametrize("content", [b"", b"{}", b"\xff\xfe"])
def test_a_file_that_holds_no_key_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "key.json").write_bytes(content)
    (tmp_path / "key.json").chmod(0o600)

    with pytest.raises(UsageError, match="signing key"):
        read_key(tmp_path / "key.json")
