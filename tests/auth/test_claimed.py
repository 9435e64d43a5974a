"""Names in tokens that nobody verified: bounded, of one line, and never believed."""

from __future__ import annotations

import base64
import json
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rse_pf.auth.claimed import claimed_by, source_address
from rse_pf.auth.roster import EnrolledRobot, Roster
from rse_pf.auth.tokens import KeySet
from rse_pf.terminal import json_line

HOSTILE = [
    "robot\n{\"event\":\"accepted\"}", "\x1b[31mrobot", "\u202erobot", "robot\x00", "r" * 1000,
    "\r\nHTTP/1.1 200 OK", "../../etc/passwd", "\u2028robot\x9b",
]  # fmt: skip


def part_of(value: Any) -> str:
    return base64.urlsafe_b64encode(json.dumps(value).encode()).rstrip(b"=").decode()


def token_of(claims: Any, key_id: Any = None) -> str:
    return f"{part_of({'alg': 'EdDSA', 'kid': key_id})}.{part_of(claims)}.c2ln"


def test_the_tenant_of_a_robots_own_key_is_that_of_the_roster():
    robot = EnrolledRobot(robot="robot-9", tenant="acme", x="A" * 43)
    keys = KeySet({}, roster=Roster(robots=(robot,)))
    claims = {"sub": "robot-9", "tenant": "default", "jti": "t-9"}
    named = {"claimed_robot": "robot-9", "claimed_token": "t-9"}

    enrolled = claimed_by(token_of(claims, robot.key_id), keys)
    removed = claimed_by(token_of(claims, robot.key_id), KeySet({}))

    assert enrolled == {**named, "claimed_tenant": "acme", "claimed_key": robot.key_id}
    assert removed == {**named, "claimed_key": robot.key_id}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_name_is_cut_and_breaks_no_line_of_a_log(name: str):
    told = claimed_by(token_of({"sub": name, "tenant": name, "jti": name}))

    line = json_line(told, msgspec.json.encode)

    assert set(told) == {"claimed_robot", "claimed_tenant", "claimed_token"}
    assert all(len(value) <= 64 for value in told.values())
    assert len(line.splitlines()) == len(line.decode().splitlines()) == 1
    assert not any(sign in line.decode() for sign in "\x1b\x00\x9b\u202e\u2028")


@given(st.text())
def test_no_text_raises(text: str):
    claimed_by(text)
    claimed_by(f"a.{text}.b")


def test_a_deep_or_damaged_token_claims_nothing():
    deep = base64.urlsafe_b64encode(b'{"sub":' + b"[" * 5000).decode()

    assert claimed_by(f"a.{deep}.b") == claimed_by("a.!!!.b") == claimed_by("") == {}


def test_an_address_that_the_sender_wrote_itself_is_not_believed():
    assert source_address("10.0.0.1", "6.6.6.6, 192.0.2.7", 1) == "192.0.2.7"
    assert source_address("10.0.0.1", "6.6.6.6", 0) == "10.0.0.1"
    assert source_address("10.0.0.1", 'x"\n', 1) == "10.0.0.1"
    assert source_address("10.0.0.1", "6.6.6.6", 2) == "10.0.0.1"
