"""Roster, deny-list, scopes: what an operator may say, and what it means for a token."""

from __future__ import annotations

import contextlib
import json

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from rse_pf.auth.roster import (
    DenyList,
    EnrolledRobot,
    Roster,
    check_quotas,
    check_scopes,
    from_json,
    key_id_of,
    public_key_of,
    scopes_allow,
    to_json,
)
from rse_pf.auth.tokens import Claims, KeySet, SigningKey, claims_problem, token_problem, verify_token
from rse_pf.config import AuthSettings
from rse_pf.errors import ConfigurationError, Unauthorized, UsageError

SETTINGS = AuthSettings()
NOW_S = 1_000_000.0
PLATFORM = SigningKey.from_seed(b"p" * 32, "p1")
ROBOT = SigningKey.of_robot(b"r" * 32)
ENROLLED = EnrolledRobot(
    robot="robot-1",
    tenant="lab",
    x=public_key_of(ROBOT.public_json()),
    scopes=("services:pnp",),
    quotas={"data_bytes": 10.0},
)
ROSTER = Roster(robots=(ENROLLED,))


def trusted(denied: DenyList | None = None, roster: Roster = ROSTER) -> KeySet:
    return PLATFORM.key_set().with_access_control(roster, denied or DenyList())


def token(key: SigningKey = ROBOT, robot: str = "robot-1", token_id: str = "t", **more: object) -> str:
    return key.issue(robot, now=NOW_S, token_id=token_id, settings=SETTINGS, **more)  # type: ignore[arg-type]


def verified(text: str, keys: KeySet, now: float = NOW_S) -> Claims:
    return verify_token(text, keys=keys, now=now, settings=SETTINGS)


def problem(text: str, keys: KeySet, now: float = NOW_S) -> str:
    with pytest.raises(Unauthorized) as caught:
        verified(text, keys, now)
    return token_problem(caught.value)


def test_a_robots_key_signs_for_no_other_robot():
    assert problem(token(robot="robot-2"), trusted()) == "wrong-robot"


def test_a_robots_key_id_cannot_name_a_key_of_the_platform():
    forger = SigningKey.from_seed(b"f" * 32, ROBOT.key_id)
    keys = KeySet.from_json(forger.key_set().to_json()).with_access_control(Roster(), DenyList())

    assert problem(token(forger), keys) == "unknown-key"


def test_the_key_id_is_the_thumbprint_of_rfc_7638():
    # RFC 8037, Appendix A.3: the thumbprint of the example key.
    x = "11qYAYKxCrfVS_7TyWQHO" + "g7hcvPapiMlrwIaaPcHURo"

    assert key_id_of(x) == "robot:kPrK_qmxVWaYVA9wwBF6Iuo3vVzz7TxHCTwXBygrS4k"


@pytest.mark.parametrize(
    ("denied", "reason"),
    [
        (DenyList().with_robot("lab", "robot-1", 0.0), "disabled"),
        (DenyList().with_token("lab", "robot-1", "t", NOW_S + 900), "revoked"),
        (DenyList().with_tokens_before("lab", "robot-1", NOW_S + 1), "issued-too-early"),
    ],
)
def test_denied_tokens_are_refused_and_end_their_connections(denied: DenyList, reason: str):
    claims = verified(token(), trusted())

    assert problem(token(), trusted(denied)) == reason
    assert claims_problem(claims, trusted()) == ""
    assert claims_problem(claims, trusted(denied)) == reason


@pytest.mark.parametrize(
    "denied",
    [
        DenyList().with_robot("other", "robot-1", 0.0),
        DenyList().with_robot("lab", "robot-2", 0.0),
        DenyList().with_token("lab", "robot-1", "u", NOW_S + 900),
        DenyList().with_token("lab", "robot-2", "t", NOW_S + 900),
        DenyList().with_tokens_before("lab", "robot-1", NOW_S),
        DenyList().with_robot("lab", "robot-1", 0.0).without_robot("lab", "robot-1"),
    ],
)
def test_a_denial_applies_to_its_own_robot_and_tenant_only(denied: DenyList):
    assert verified(token(), trusted(denied)).robot == ENROLLED.id


def test_enabling_a_robot_enables_no_robot_of_that_name_in_another_tenant():
    both = DenyList().with_robot("lab", "robot-1", 0.0).with_robot("other", "robot-1", 0.0)

    denied = both.without_robot("other", "robot-1")

    assert problem(token(), trusted(denied)) == "disabled"
    assert not denied.is_disabled("other", "robot-1")


def test_a_robot_that_is_removed_or_has_a_new_key_loses_its_connections():
    claims = verified(token(), trusted())
    other = EnrolledRobot(robot="robot-2", tenant="lab", x=ENROLLED.x)

    assert claims_problem(claims, trusted(roster=Roster())) == "unknown-key"
    assert claims_problem(claims, trusted(roster=Roster(robots=(other,)))) == "wrong-robot"
    assert claims_problem(replace(claims, key_id="p1"), KeySet({})) == "unknown-key"


def test_pruning_removes_only_entries_about_expired_tokens():
    denied = DenyList().with_token("d", "r", "t", 1000.0).with_tokens_before("d", "r", 500.0)
    denied = denied.with_robot("d", "s", 1.0)

    assert denied.pruned(now=1400.0, max_token_s=930.0) == denied
    later = denied.pruned(now=5000.0, max_token_s=930.0)
    assert (later.tokens, later.not_before, later.disabled) == ((), (), denied.disabled)


def test_a_later_revocation_keeps_an_earlier_one():
    denied = DenyList().with_tokens_before("d", "r", 500.0).with_tokens_before("d", "r", 400.0)

    assert [each.at_s for each in denied.not_before] == [500.0]


def test_a_name_has_one_key_and_a_key_one_name():
    fresh = EnrolledRobot(robot="robot-1", tenant="lab", x="A" * 43)

    assert ROSTER.enrolled(fresh).robots == (fresh,)
    with pytest.raises(UsageError, match="has this key already"):
        ROSTER.enrolled(EnrolledRobot(robot="robot-2", tenant="lab", x=ENROLLED.x))


def test_both_survive_their_json():
    denied = DenyList().with_token("d", "r", "t", 9.0).with_robot("d", "s", 1.0)

    assert from_json(to_json(ROSTER), Roster) == ROSTER
    assert from_json(to_json(denied), DenyList) == denied


@given(st.binary(max_size=60) | st.text(max_size=60).map(str.encode))
def test_invalid_json_is_a_configuration_error(data: bytes):
    with contextlib.suppress(ConfigurationError):
        assert isinstance(from_json(data, DenyList), DenyList)


@pytest.mark.parametrize(
    ("scopes", "right", "name", "allowed"),
    [
        ((), "services:pnp", "", True),
        (("services:pnp",), "services:pnp", "", True),
        (("services:pnp",), "services:pnp2", "", False),
        (("services:*",), "services:icp", "", True),
        (("services:*",), "data:read", "", False),
        (("data:read",), "data:write", "", False),
        (("data:*",), "data:write", "", True),
        (("maps:write/kitchen",), "maps:write", "kitchen", True),
        (("maps:write/kitchen",), "maps:write", "kitchen2", False),
        (("maps:write/kitchen",), "maps:write", "", False),
        (("maps:write/kitchen",), "maps:read", "kitchen", False),
        (("maps:*/kitchen",), "maps:read", "kitchen", True),
        (("maps:write",), "maps:write", "kitchen", True),
        (("maps:watch/kitchen",), "maps:watch", "kitchen", True),
        (("maps:watch/kitchen",), "maps:watch", "garage", False),
        (("maps:watch",), "maps:live", "kitchen", False),
        (("maps:watch",), "maps:read", "kitchen", False),
        (("maps:live",), "maps:watch", "kitchen", False),
        (("maps:*",), "maps:watch", "kitchen", True),
    ],
)
def test_scopes_allow_what_they_say_and_nothing_else(scopes, right, name, allowed):
    assert scopes_allow(scopes, right, name) is allowed
    assert check_scopes(scopes) == scopes


@pytest.mark.parametrize(
    "scope", ["pnp", "services:", "services:a b", "maps:write/", "data:read/x", "*", "a:b"]
)
def test_what_is_no_scope_is_refused_before_it_is_stored(scope: str):
    with pytest.raises(UsageError, match="is not a scope"):
        check_scopes((scope,))


@pytest.mark.parametrize("quotas", [{"bytes": 1.0}, {"data_bytes": 0.0}, {"data_bytes": float("nan")}])
def test_what_is_no_quota_is_refused_before_it_is_stored(quotas: dict[str, float]):
    with pytest.raises(UsageError, match="quota"):
        check_quotas(quotas)


def test_a_private_key_is_not_taken_for_a_public_one():
    with pytest.raises(UsageError, match="private"):
        public_key_of(ROBOT.to_json())


@pytest.mark.parametrize("text", ["", "[]", "{}", json.dumps({"kty": "OKP", "crv": "Ed25519", "x": "short"})])
def test_what_is_no_public_key_is_refused(text: str):
    with pytest.raises(UsageError, match="not a public"):
        public_key_of(text)
