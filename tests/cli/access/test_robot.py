"""Robots on the command line: keys that stay on the robot, the roster, and disabling a robot."""

from __future__ import annotations

import asyncio
import base64
import io
import json
import stat
import time
from pathlib import Path

import pytest

from rse_pf.auth.robot_key import RobotKey
from rse_pf.auth.tokens import Claims, KeySet, SigningKey, token_problem, verify_token
from rse_pf.auth.trust_store import AccessControlStore
from rse_pf.cli.main import main
from rse_pf.config import AuthSettings
from rse_pf.errors import Unauthorized, UsageError
from rse_pf.identity import RobotId
from rse_pf.local.firewall import key_file, key_set_file
from rse_pf.storage.object_store import DirectoryStore

Capture = pytest.CaptureFixture[str]
SETTINGS = AuthSettings()


def said(capsys: Capture, *words: str) -> str:
    """Return what a command printed that went well."""
    assert main(list(words)) == 0
    return capsys.readouterr().out


def refused(capsys: Capture, *words: str) -> list[str]:
    """Return the two lines of a command that was called wrongly."""
    assert main(list(words)) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2
    assert "hint" in lines[1]
    return lines


def enrolled(capsys: Capture, name: str = "robot-1", *options: str) -> RobotKey:
    """Make a key and enrol a robot with it."""
    public = said(capsys, "robot", "keygen", "--out", f"{name}.key")
    Path(f"{name}.json").write_text(public)
    said(capsys, "robot", "enrol", name, "--public-key", f"{name}.json", *options)
    return RobotKey(f"{name}.key", name)


def trusted(folder: Path) -> KeySet:
    """Return what a server of the platform would trust."""
    room = AccessControlStore(DirectoryStore(folder))
    keys = KeySet.from_json(key_set_file(folder).read_text())
    return keys.with_access_control(room.roster(), room.deny_list())


def problem(folder: Path, token: str) -> str:
    """Return why a server of the platform refuses *token*; empty if it does not."""
    try:
        verify_token(token, keys=trusted(folder), now=time.time(), settings=SETTINGS)
    except Unauthorized as error:
        return token_problem(error)
    return ""


def issued(capsys: Capture, name: str = "robot-1", *options: str) -> str:
    return said(capsys, "token", "issue", name, *options).strip()


def test_a_key_is_its_owners_alone_and_only_its_public_half_is_printed(
    capsys: Capture, platform: Path
) -> None:
    public = json.loads(said(capsys, "robot", "keygen", "--out", "robot.key"))

    private = json.loads(Path("robot.key").read_text())
    assert stat.S_IMODE(Path("robot.key").stat().st_mode) == 0o600
    assert "d" in private
    assert public == {name: value for name, value in private.items() if name != "d"}
    assert "already" in refused(capsys, "robot", "keygen", "--out", "robot.key")[0]


def test_an_enrolled_robot_is_accepted_with_tokens_that_it_signed(capsys: Capture, platform: Path) -> None:
    key = enrolled(capsys, "robot-1", "--scope", "services:pnp", "--scope", "maps:read", "--tenant", "lab")
    token = asyncio.run(key.token())

    claims = verify_token(token, keys=trusted(platform), now=_issued_s(token), settings=SETTINGS)

    assert (claims.robot.tenant, claims.robot.name) == ("lab", "robot-1")
    assert claims.scopes == ("services:pnp", "maps:read")
    assert json.loads(said(capsys, "token", "inspect", token))["verified"] == "yes"


def _issued_s(token: str) -> float:
    body = token.split(".")[1]
    return float(json.loads(base64.urlsafe_b64decode(body + "=" * (-len(body) % 4)))["iat"])


def test_a_key_that_others_may_read_signs_nothing(capsys: Capture, platform: Path) -> None:
    key = enrolled(capsys)
    Path("robot-1.key").chmod(0o640)

    with pytest.raises(UsageError, match="others may read"):
        asyncio.run(key.token())


def test_a_disabled_robot_is_refused_whoever_signed_and_an_enabled_one_needs_a_fresh_token(
    capsys: Capture, platform: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    key = enrolled(capsys)
    before = [asyncio.run(key.token()), issued(capsys)]
    assert [problem(platform, token) for token in before] == ["", ""]

    said(capsys, "robot", "disable", "robot-1")
    assert [problem(platform, token) for token in before] == ["disabled", "disabled"]
    assert "robot-1  disabled" in said(capsys, "robot", "list")
    monkeypatch.setattr("rse_pf.cli.access.robot.time.time", lambda: _issued_s(before[0]) + 5.0)
    said(capsys, "robot", "enable", "robot-1")

    assert [problem(platform, token) for token in before] == ["issued-too-early"] * 2
    assert json.loads(said(capsys, "robot", "list", "--json"))[0]["state"] == "enrolled"


def test_one_token_is_revoked_and_the_next_one_is_good(
    capsys: Capture, platform: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = issued(capsys), issued(capsys)
    monkeypatch.setattr("sys.stdin", io.StringIO(first + "\n"))

    told = said(capsys, "token", "revoke", "-")

    assert "revoked" in told
    assert first not in told
    assert (problem(platform, first), problem(platform, second)) == ("revoked", "")
    assert main(["token", "inspect", first]) == 1
    assert "no: revoked" in capsys.readouterr().out


def test_a_token_is_issued_for_an_enrolled_robot_of_another_tenant_only_with_its_tenant(
    capsys: Capture, platform: Path
) -> None:
    enrolled(capsys, "robot-1", "--tenant", "acme")

    assert "is of tenant 'acme', and not of 'default'" in refused(capsys, "token", "issue", "robot-1")[0]

    for tenant in ("acme", "default"):
        token = issued(capsys, "robot-1", "--tenant", tenant)
        assert json.loads(said(capsys, "token", "inspect", token))["claims"]["tenant"] == tenant


CHANGES = ("robot disable", "robot remove", "robot adopt", "token revoke --all-of")


@pytest.mark.parametrize("change", CHANGES)
def test_a_robot_of_another_tenant_is_changed_only_with_its_tenant(
    capsys: Capture, platform: Path, change: str
) -> None:
    token = asyncio.run(enrolled(capsys, "robot-1", "--tenant", "acme").token())
    (platform / "objects").mkdir()
    words = (*change.split(), "robot-1")

    for tenant in ([], ["--tenant", "acmee"]):
        problem_line, hint = refused(capsys, *words, *tenant)
        assert "the enrolled robot 'robot-1' is of tenant 'acme', and not of" in problem_line
        assert "--tenant acme" in hint
    assert problem(platform, token) == ""
    assert "'robot-1' of tenant 'acme'" in said(capsys, *words, "--tenant", "acme").replace(
        "acme/robot-1", ""
    )
    assert (problem(platform, token) != "") == (change != "robot adopt")


@pytest.mark.parametrize("change", CHANGES)
def test_a_name_that_two_tenants_have_is_changed_only_with_its_tenant(
    capsys: Capture, platform: Path, change: str
) -> None:
    for tenant in ("default", "acme"):
        Path("robot-1.key").unlink(missing_ok=True)
        enrolled(capsys, "robot-1", "--tenant", tenant)

    problem_line, hint = refused(capsys, *change.split(), "robot-1")

    assert "is of tenants 'acme', 'default'" in problem_line
    assert "--tenant acme" in hint


@pytest.mark.parametrize("change", CHANGES)
def test_a_robot_that_is_nowhere_is_not_changed(capsys: Capture, platform: Path, change: str) -> None:
    enrolled(capsys, "robot-1")

    assert "robot 'robot-2' is not enrolled in any tenant" in refused(capsys, *change.split(), "robot-2")[0]

    assert trusted(platform).denies(_claims("robot-2")) == ""


def _claims(robot: str) -> Claims:
    return Claims(robot=RobotId("default", robot), token_id="t", issued_s=1.0, expires_s=2.0, key_id="k")


def test_a_disabled_robot_of_another_tenant_is_enabled_only_with_its_tenant(
    capsys: Capture, platform: Path
) -> None:
    enrolled(capsys, "robot-1", "--tenant", "acme")
    said(capsys, "robot", "disable", "robot-1", "--tenant", "acme")

    assert "is of tenant 'acme', and not of 'default'" in refused(capsys, "robot", "enable", "robot-1")[0]

    assert "of tenant 'acme'" in said(capsys, "robot", "enable", "robot-1", "--tenant", "acme")


def test_after_a_rotation_both_keys_are_trusted_and_after_two_the_first_is_not(
    capsys: Capture, platform: Path
) -> None:
    first = issued(capsys)
    said(capsys, "token", "rotate-keys")
    second = issued(capsys)

    assert [problem(platform, token) for token in (first, second)] == ["", ""]
    assert stat.S_IMODE(key_file(platform).stat().st_mode) == 0o600
    said(capsys, "token", "rotate-keys")
    assert [problem(platform, token) for token in (first, second, issued(capsys))] == ["unknown-key", "", ""]


def test_a_token_is_issued_with_scopes_and_tenant(capsys: Capture, platform: Path) -> None:
    token = issued(capsys, "robot-1", "--scope", "services:pnp", "--tenant", "lab")

    claims = json.loads(said(capsys, "token", "inspect", token))["claims"]

    assert (claims["scope"], claims["tenant"]) == ("services:pnp", "lab")


@pytest.mark.parametrize(
    ("words", "first"),
    [
        ("robot enrol robot-1", "--public-key"),
        ("robot enrol --public-key x.json", "arguments are required: ROBOT"),
        ("robot enrol robot-1 --public-key missing.json", "cannot read"),
        ("robot enrol robot-1 --public-key private.json", "private key"),
        ("robot enrol robot-1 --public-key public.json --scope pnp", "is not a scope"),
        ("robot enrol robot-1 --public-key public.json --quota x=1", "is not a quota"),
        ("robot enrol robot-1 --public-key public.json --quota data_bytes", "is not a quota"),
        ("robot disable", "arguments are required: ROBOT"),
        ("robot disable robot-1 --scope services:pnp", "--scope"),
        ("robot remove robot-1 --not-enrolled", "--not-enrolled"),
        ("token revoke x.y.z --not-enrolled", "--not-enrolled"),
        ("robot enable robot-1", "is not disabled"),
        ("robot list robot-1", "unrecognized arguments: robot-1"),
        ("robot list --name nowhere", "no platform"),
        ("robot keygen", "--out"),
        ("robot keygen --out nowhere/robot.key", "cannot write"),
        ("token revoke", "needs a token"),
        ("token revoke x.y.z", "not a token"),
        ("token revoke x --all-of robot-1", "needs a token"),
        ("token issue robot-1 --scope pnp", "is not a scope"),
        ("token issue robot-1 --all-of robot-1", "--all-of"),
        ("token rotate-keys robot-1", "unrecognized arguments: robot-1"),
    ],
)
def test_bad_input_is_one_line_and_a_hint(capsys: Capture, platform: Path, words: str, first: str) -> None:
    public = said(capsys, "robot", "keygen", "--out", "private.json")
    Path("public.json").write_text(public)

    assert first in refused(capsys, *words.split())[0]


def test_a_token_that_a_robot_signed_is_revoked_in_the_tenant_of_the_roster(
    capsys: Capture, platform: Path
) -> None:
    token = asyncio.run(enrolled(capsys, "robot-1", "--tenant", "lab").token())

    said(capsys, "token", "revoke", token)

    assert problem(platform, token) == "revoked"


def test_all_tokens_of_a_robot_until_now_are_revoked(capsys: Capture, platform: Path) -> None:
    mine, others = issued(capsys), issued(capsys, "robot-2")

    said(capsys, "token", "revoke", "--all-of", "robot-1", "--not-enrolled")

    assert (problem(platform, mine), problem(platform, others)) == ("issued-too-early", "")


def test_a_token_of_another_platform_is_not_revoked(capsys: Capture, platform: Path) -> None:
    signer = SigningKey.from_seed(b"t" * 32, "another")
    token = signer.issue("robot-1", now=time.time(), token_id="t", settings=SETTINGS)

    assert "the key 'another' is not known" in refused(capsys, "token", "revoke", token)[0]
