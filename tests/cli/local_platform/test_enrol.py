"""rse-pf robot enrol --out: what is in the file, what the roster knows, and what is refused."""

from __future__ import annotations

import json
import os
import stat
from pathlib import Path

import pytest

from client_sdk.enrolment import read_enrolment
from rse_pf.auth.trust_store import AccessControlStore
from rse_pf.cli.main import main
from rse_pf.enrolment import Enrolment
from rse_pf.errors import UsageError
from rse_pf.local.lan.listener import LanListener, authority_file
from rse_pf.local.processes import mark_of
from rse_pf.local.state import PlatformState
from rse_pf.storage.object_store import DirectoryStore

Capture = pytest.CaptureFixture[str]


def runs(folder: Path, url: str) -> None:
    """Let the platform run at *url*; with an authority if that is wss."""
    own = mark_of(os.getpid())
    assert own is not None
    authority = ""
    if url.startswith("wss:"):
        LanListener(address="10.1.2.3", folder=folder).prepare("default", now_s=1_800_000_000.0)
        authority = str(authority_file(folder))
    PlatformState(
        name="default", control_plane=own, url=url, settings_digest="", settings_file="", key_file="",
        authority_file=authority,
    ).write(folder)  # fmt: skip


def test_the_file_holds_address_authority_and_the_key_that_the_roster_knows(
    platform: Path, capsys: Capture
) -> None:
    runs(platform, "wss://10.1.2.3:8700/ws")

    assert main(["robot", "enrol", "robot-1", "--out", "r1.enrolment", "--scope", "services:pnp"]) == 0

    file = Path("r1.enrolment")
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    made = Enrolment.read(file)
    assert (made.url, made.robot) == ("wss://10.1.2.3:8700/ws", "robot-1")
    assert made.authority == authority_file(platform).read_text()
    known = AccessControlStore(DirectoryStore(platform)).roster().find("default", "robot-1")
    assert known is not None
    assert (known.x, known.scopes) == (made.key["x"], ("services:pnp",))
    said = capsys.readouterr().out
    assert "client_sdk.connect(enrolment='r1.enrolment')" in said
    assert made.key["d"] not in said
    access = read_enrolment(file)
    assert access.ssl_context is not None
    assert len(access.ssl_context.get_ca_certs()) == 1, "no other authority is trusted"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("", "only this machine reaches that address"),
        (" --url ws://platform.example:8700/ws", "clear text"),
        (" --url wss://platform.example/ws", "again with --authority"),
    ],
)
def test_an_address_that_robots_elsewhere_cannot_use_is_reported(
    platform: Path, capsys: Capture, words: str, said: str
) -> None:
    runs(platform, "ws://127.0.0.1:8700/ws")

    assert main(f"robot enrol robot-1 --out r1.enrolment{words}".split()) == 0

    assert said in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("robot-1 --out r1", "platform 'default' does not run"),
        ("robot-1 --out r1 --url 10.1.2.3", "is not the address of a platform"),
        ("robot-1 --out r1 --url wss://a/ws --authority missing", "cannot read the authority"),
        ("robot-1 --out r1 --url wss://a/ws --authority secret.pem", "is not the certificate"),
        ("robot-1 --out there --url wss://a/ws", "exists already"),
        ("robot-1 --out nowhere/r1 --url wss://a/ws", "cannot write"),
        ("robot-1 --out r1 --public-key x", "needs either --out or --public-key"),
        ("robot-1 --public-key x --url wss://a/ws", "--url and --authority are for enrol --out"),
        ("robot-1 --out r1 --url wss://a/ws --scope pnp", "is not a scope"),
    ],
)
def test_what_cannot_be_done_is_two_lines_and_leaves_neither_file_nor_robot(
    platform: Path, capsys: Capture, words: str, said: str
) -> None:
    Path("there").write_text("mine")
    Path("secret.pem").write_text("-----BEGIN CERTIFICATE-----\n-----BEGIN PRIVATE KEY-----\n")

    assert main(["robot", "enrol", *words.split()]) == 2

    lines = capsys.readouterr().err.splitlines()
    assert said in lines[0]
    assert lines[1].startswith("  hint: ")
    assert not Path("r1").exists()
    assert Path("there").read_text() == "mine"
    assert AccessControlStore(DirectoryStore(platform)).roster().robots == ()


def test_a_file_whose_authority_is_no_certificate_is_refused_before_anything_is_sent(tmp_path: Path) -> None:
    from rse_pf.auth.tokens import SigningKey

    key = json.loads(SigningKey.of_robot(b"r" * 32).to_json())
    file = tmp_path / "r1"
    Enrolment(url="wss://a/ws", authority="nonsense", robot="r", key=key).write(file)

    with pytest.raises(UsageError, match="the authority in the file is no certificate"):
        read_enrolment(file)
