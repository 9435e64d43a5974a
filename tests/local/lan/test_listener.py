"""The certificates of a platform that other machines may reach: made once, renewed in time, private."""

from __future__ import annotations

import json
import stat
from pathlib import Path

import pytest

from rse_pf.auth.certificates import SERVER_S, CertificateWithKey
from rse_pf.errors import ConfigurationError
from rse_pf.local.lan.listener import LanListener, authority_file, secret_file

NOW_S = 1_800_000_000.0


def served(folder: Path) -> CertificateWithKey:
    """Return the certificate that Envoy gets."""
    told = json.loads(secret_file(folder).read_text())["resources"][0]["tls_certificate"]
    chain, key = told["certificate_chain"]["inline_string"], told["private_key"]["inline_string"]
    return CertificateWithKey(certificate=chain, private_key=key)


def test_the_first_start_makes_private_files_for_the_address(tmp_path: Path) -> None:
    lan = LanListener(address="10.1.2.3", folder=tmp_path)

    assert lan.prepare("default", now_s=NOW_S)

    modes = {file.name: stat.S_IMODE(file.stat().st_mode) & 0o077 for file in tmp_path.iterdir()}
    assert modes.pop("authority.crt") & 0o044, "the public half is for browsers"
    assert modes == {"authority.pem": 0, "tls.json": 0}
    assert "PRIVATE" not in authority_file(tmp_path).read_text()
    assert "10.1.2.3" in served(tmp_path).names
    assert served(tmp_path).is_issued_by(lan.authority())


def test_a_later_start_keeps_everything_and_renews_before_the_end(tmp_path: Path) -> None:
    lan = LanListener(address="10.1.2.3", folder=tmp_path)
    lan.prepare("default", now_s=NOW_S)
    authority, first = lan.authority(), served(tmp_path)

    assert not lan.prepare("default", now_s=NOW_S + SERVER_S / 2)
    assert served(tmp_path) == first
    assert lan.prepare("default", now_s=NOW_S + SERVER_S * 0.7)
    assert served(tmp_path).expires_s > first.expires_s
    assert lan.authority() == authority, "robots keep what they trust"


def test_another_address_gets_a_certificate_of_the_same_authority(tmp_path: Path) -> None:
    LanListener(address="10.1.2.3", folder=tmp_path).prepare("default", now_s=NOW_S)
    moved = LanListener(address="10.9.9.9", folder=tmp_path)
    authority = moved.authority()

    assert moved.prepare("default", now_s=NOW_S)

    assert "10.9.9.9" in served(tmp_path).names
    assert "10.1.2.3" not in served(tmp_path).names
    assert moved.authority() == authority


@pytest.mark.parametrize(("text", "mode"), [("nonsense", 0o600), (None, 0o644)])
def test_a_damaged_or_readable_authority_is_one_line_and_is_not_replaced(
    tmp_path: Path, text: str | None, mode: int
) -> None:
    lan = LanListener(address="10.1.2.3", folder=tmp_path)
    lan.prepare("default", now_s=NOW_S)
    file = tmp_path / "authority.pem"
    file.write_text(text or file.read_text())
    file.chmod(mode)
    before = file.read_bytes()

    with pytest.raises(ConfigurationError) as caught:
        lan.prepare("default", now_s=NOW_S)

    assert "authority.pem" in caught.value.message
    assert caught.value.hint
    assert file.read_bytes() == before
