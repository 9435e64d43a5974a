"""Robot tokens: one good kind, every other refused in the same words, and no clock but ours."""

from __future__ import annotations

import base64
import hashlib
import hmac
import json
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from rse_pf.auth import tokens
from rse_pf.auth.roster import DenyList, EnrolledRobot, Roster
from rse_pf.auth.tokens import KeySet, SigningKey, token_problem, verify_token
from rse_pf.config import AuthSettings
from rse_pf.errors import Unauthorized, UsageError

ROBOT_KEY = SigningKey.of_robot(bytes(range(2, 34)))
ENROLLED = EnrolledRobot(robot="robot-7", x=json.loads(ROBOT_KEY.public_json())["x"])

NOW = 1_790_000_000.0
SETTINGS = AuthSettings()
KEY = SigningKey.from_seed(bytes(range(32)), "key-1")
OTHER = SigningKey.from_seed(bytes(range(1, 33)), "key-1")
KEYS = KEY.key_set()
GOOD = {
    "iss": "rse-pf", "aud": "rse-pf", "sub": "robot-7", "jti": "t1", "iat": int(NOW), "exp": int(NOW) + 600,
}  # fmt: skip
HEADER = {"alg": "EdDSA", "typ": "robot+jwt", "kid": "key-1"}


def issue(**changes: Any) -> str:
    return KEY.issue("robot-7", now=NOW, token_id="t1", settings=SETTINGS, **changes)


def encoded(document: Any) -> str:
    return base64.urlsafe_b64encode(json.dumps(document).encode()).rstrip(b"=").decode()


def sign(claims: Any, header: Any = HEADER, key: SigningKey = KEY) -> str:
    """Return a token with any claims and header, signed in earnest."""
    signed = f"{encoded(header)}.{encoded(claims)}"
    signature = key._private.sign(signed.encode())
    return f"{signed}.{base64.urlsafe_b64encode(signature).rstrip(b'=').decode()}"


def refused(token: str, *, now: float = NOW, settings: AuthSettings = SETTINGS) -> str:
    """Return the reason in the log; fail if the token is accepted."""
    with pytest.raises(Unauthorized) as caught:
        verify_token(token, keys=KEYS, now=now, settings=settings)
    return token_problem(caught.value)


def without(name: str) -> dict[str, Any]:
    return {key: value for key, value in GOOD.items() if key != name}


PUBLIC = KEY._private.public_key().public_bytes_raw()


def hmac_with(secret: bytes, algorithm: str = "HS256") -> str:
    signed = f"{encoded({**HEADER, 'alg': algorithm})}.{encoded(GOOD)}"
    mac = hmac.new(secret, signed.encode(), hashlib.sha256).digest()
    return f"{signed}.{base64.urlsafe_b64encode(mac).rstrip(b'=').decode()}"


FORGED: dict[str, Callable[[], str]] = {
    "empty": lambda: "",
    "one part": lambda: "x",
    "too long": lambda: sign({**GOOD, "pad": "x" * 5000}),
    "not ascii": lambda: issue() + "é",
    "trailing dot": lambda: issue() + ".",
    "padding": lambda: issue() + "=",
    "whole padding": lambda: issue() + "==",
    "white space": lambda: " " + issue(),
    "deeply nested header": lambda: base64.urlsafe_b64encode(b"[" * 2900).decode().rstrip("=") + ".e30.AA",
    "header is a list": lambda: f"{encoded([1])}.e30.AA",
    "another key": lambda: sign(GOOD, key=OTHER),
    "unknown key id": lambda: sign(GOOD, {**HEADER, "kid": "key-2"}),
    "no key id": lambda: sign(GOOD, {"alg": "EdDSA", "typ": "robot+jwt"}),
    "key id is a list": lambda: sign(GOOD, {**HEADER, "kid": ["key-1"]}),
    "none": lambda: f"{encoded({**HEADER, 'alg': 'none'})}.{encoded(GOOD)}.",
    "None": lambda: f"{encoded({**HEADER, 'alg': 'None'})}.{encoded(GOOD)}.AA",
    "no algorithm": lambda: sign(GOOD, {"typ": "robot+jwt", "kid": "key-1"}),
    "HS256 with the public key": lambda: hmac_with(PUBLIC),
    "HS256 with the public key as JWKS": lambda: hmac_with(KEYS.to_json().encode()),
    "HS256 that calls itself EdDSA": lambda: hmac_with(PUBLIC, "EdDSA"),
    "another type": lambda: sign(GOOD, {**HEADER, "typ": "JWT"}),
    "critical header": lambda: sign(GOOD, {**HEADER, "crit": ["exp"]}),
    "critical header of a known extension": lambda: sign(GOOD, {**HEADER, "crit": ["b64"], "b64": True}),
    "payload without an encoding": lambda: sign(GOOD, {**HEADER, "crit": ["b64"], "b64": False}),
    "own key in the header": lambda: sign(
        GOOD, {**HEADER, "kid": "mine", "jwk": json.loads(OTHER.key_set().to_json())["keys"][0]}, OTHER
    ),
    "no signature": lambda: issue().rpartition(".")[0] + ".",
    "claims are a list": lambda: sign([1, 2]),
    **{f"no {name}": (lambda name=name: sign(without(name))) for name in GOOD},  # type: ignore[misc]
    "wrong audience": lambda: sign({**GOOD, "aud": "someone"}),
    "wrong issuer": lambda: sign({**GOOD, "iss": "someone"}),
    "subject is a number": lambda: sign({**GOOD, "sub": 7}),
    "subject is empty": lambda: sign({**GOOD, "sub": ""}),
    "subject is long": lambda: sign({**GOOD, "sub": "r" * 65}),
    "subject is half a character": lambda: sign({**GOOD, "sub": "\ud800"}),
    "id is half a character": lambda: sign({**GOOD, "jti": "\ud800"}),
    "tenant is half a character": lambda: sign({**GOOD, "tenant": "\ud800"}),
    "scope is half a character": lambda: sign({**GOOD, "scope": "\ud800"}),
    "tenant is null": lambda: sign({**GOOD, "tenant": None}),
    "tenant is empty": lambda: sign({**GOOD, "tenant": ""}),
    "scope is a list": lambda: sign({**GOOD, "scope": ["services:pnp"]}),
    "audience is a number and ours": lambda: sign({**GOOD, "aud": ["rse-pf", 1]}),
    "audience is an object": lambda: sign({**GOOD, "aud": {"rse-pf": 1}}),
    "id is empty": lambda: sign({**GOOD, "jti": ""}),
    "expires as a string": lambda: sign({**GOOD, "exp": str(GOOD["exp"])}),
    "expires as a truth": lambda: sign({**GOOD, "exp": True}),
    "expires never": lambda: sign({**GOOD, "exp": float("inf")}),
    "expires at nan": lambda: sign({**GOOD, "exp": float("nan")}),
    "issued before time": lambda: sign({**GOOD, "iat": -1}),
    "not before is a word": lambda: sign({**GOOD, "nbf": "now"}),
    "not before tomorrow": lambda: sign({**GOOD, "nbf": NOW + 86400}),
    "issued tomorrow": lambda: sign({**GOOD, "iat": NOW + 86400, "exp": NOW + 86500}),
    "lives too long": lambda: sign({**GOOD, "exp": int(NOW) + SETTINGS.token_ttl_s + 1}),
    "expired": lambda: sign({**GOOD, "iat": NOW - 800, "exp": NOW - 200}),
}


def test_every_refusal_is_in_the_same_words() -> None:
    reports = set()
    for forge in FORGED.values():
        with pytest.raises(Unauthorized) as caught:
            verify_token(forge(), keys=KEYS, now=NOW, settings=SETTINGS)
        reports.add((caught.value.code, caught.value.report()))

    assert len(reports) == 1


def test_the_log_gets_one_of_a_fixed_set_of_reasons() -> None:
    assert {refused(forge()) for forge in FORGED.values()} == {
        "missing-or-too-long", "malformed", "wrong-algorithm-or-type", "unknown-key",
        "bad-signature-or-claims", "bad-time", "ttl-too-long", "expired", "not-yet-valid", "bad-subject",
    }  # fmt: skip


def test_no_flip_of_any_one_bit_is_accepted() -> None:
    token = issue().encode()
    accepted = []
    for position in range(8 * len(token)):
        flipped = bytearray(token)
        flipped[position // 8] ^= 1 << position % 8
        try:
            verify_token(flipped.decode("latin-1"), keys=KEYS, now=NOW, settings=SETTINGS)
        except Unauthorized:
            continue
        accepted.append(position)

    assert len(token) * 8 > 2000
    assert accepted == []


@given(st.text(max_size=200) | st.binary(max_size=200).map(lambda data: data.decode("latin-1")))
@example("..")
@example("e30.e30.e30")
@example("\ud800.a.b")
def test_any_text_is_refused_and_nothing_else(text: str) -> None:
    refused(text)


ODD = st.none() | st.integers() | st.text() | st.lists(st.integers())


@given(st.dictionaries(st.sampled_from([*GOOD, "nbf", "tenant", "scope"]), ODD))
def test_odd_claims_under_a_good_signature_are_accepted_or_refused(changes: dict[str, Any]) -> None:
    try:
        claims = verify_token(sign({**GOOD, **changes}), keys=KEYS, now=NOW, settings=SETTINGS)
    except Unauthorized:
        return
    assert 0 < len(claims.robot) <= 64
    assert claims.expires_s - claims.issued_s <= SETTINGS.token_ttl_s


@pytest.mark.parametrize("now", [1000.0, NOW, 9e10], ids=["1970", "2026", "the year 4821"])
def test_time_is_an_argument_and_the_machines_clock_never_decides(now: float) -> None:
    token = KEY.issue("robot-7", now=now, token_id="t1", settings=SETTINGS)

    assert verify_token(token, keys=KEYS, now=now + 1, settings=SETTINGS).robot.name == "robot-7"
    assert refused(token, now=now + SETTINGS.token_ttl_s + SETTINGS.leeway_s + 2) == "expired"


def test_the_leeway_is_kept_to_the_second() -> None:
    token = issue(ttl_s=60.0)

    verify_token(token, keys=KEYS, now=NOW + 60 + SETTINGS.leeway_s, settings=SETTINGS)
    verify_token(token, keys=KEYS, now=NOW - SETTINGS.leeway_s, settings=SETTINGS)
    assert refused(token, now=NOW + 61 + SETTINGS.leeway_s) == "expired"
    assert refused(token, now=NOW - 1 - SETTINGS.leeway_s) == "not-yet-valid"


def test_not_before_has_the_same_leeway() -> None:
    token = sign({**GOOD, "nbf": NOW + SETTINGS.leeway_s})

    assert verify_token(token, keys=KEYS, now=NOW, settings=SETTINGS).robot.name == "robot-7"
    assert refused(token, now=NOW - 1) == "not-yet-valid"


@pytest.mark.parametrize("ttl_s", [0.0, -1.0, SETTINGS.token_ttl_s + 1.0, float("nan"), float("inf")])
def test_a_ttl_outside_the_settings_is_not_issued(ttl_s: float) -> None:
    with pytest.raises(UsageError, match="a time to live of"):
        issue(ttl_s=ttl_s)


@pytest.mark.parametrize("robot", ["", "r" * 65, "a\nb", "\x1b[31m"])
def test_a_name_that_could_harm_a_log_is_not_issued(robot: str) -> None:
    with pytest.raises(UsageError, match="not a valid name for a robot"):
        KEY.issue(robot, now=NOW, token_id="t", settings=SETTINGS)


@pytest.mark.parametrize("token_id", ["", "t" * 65])
def test_a_token_id_that_no_server_would_accept_is_not_issued(token_id: str) -> None:
    with pytest.raises(UsageError, match="token id"):
        KEY.issue("robot-7", now=NOW, token_id=token_id, settings=SETTINGS)


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"d": 3, "kid": "x"}', '{"d": "AA", "kid": "x"}', "[" * 9999]
)
def test_what_is_no_signing_key_is_a_usage_error(text: str) -> None:
    with pytest.raises(UsageError):
        SigningKey.from_json(text)


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"keys": [{}]}', '{"keys": [{"kid": "a", "x": "AA"}]}', "[" * 9999]
)
def test_what_is_no_key_set_is_a_usage_error(text: str) -> None:
    with pytest.raises(UsageError):
        KeySet.from_json(text)


# --- tokens that were verified before ---------------------------------------------------------------


class Counting(KeySet):
    """Counts how often a key was taken, to verify a signature."""

    taken = 0

    def get(self, key_id: Any) -> Any:
        self.taken += 1
        return super().get(key_id)


def trusted(roster: Roster | None = None, denied: DenyList | None = None) -> Counting:
    return Counting(KEYS._keys, roster=roster, denied=denied)


def test_the_times_of_a_verified_token_are_validated_every_time():
    keys, token = trusted(), issue(ttl_s=60.0)
    verify_token(token, keys=keys, now=NOW, settings=SETTINGS)

    for now, reason in ((NOW + 200, "expired"), (NOW - 200, "not-yet-valid")):
        with pytest.raises(Unauthorized) as caught:
            verify_token(token, keys=keys, now=now, settings=SETTINGS)
        assert token_problem(caught.value) == reason


def test_a_verified_token_counts_for_the_issuer_and_the_audience_that_it_was_verified_for():
    keys, token = trusted(), issue()
    verify_token(token, keys=keys, now=NOW, settings=SETTINGS)

    with pytest.raises(Unauthorized):
        verify_token(token, keys=keys, now=NOW, settings=AuthSettings(audience="another"))


def test_another_roster_or_deny_list_remembers_no_token():
    token = issue()
    verify_token(token, keys=(keys := trusted()), now=NOW, settings=SETTINGS)

    denied = DenyList().with_token("default", "robot-7", "t1", NOW + 600)
    with pytest.raises(Unauthorized) as caught:
        verify_token(token, keys=keys.with_access_control(Roster(), denied), now=NOW, settings=SETTINGS)
    assert token_problem(caught.value) == "revoked"


def test_tokens_that_are_refused_are_not_remembered():
    keys = trusted(Roster(robots=(ENROLLED,)))
    wrong = ROBOT_KEY.issue("robot-8", now=NOW, token_id="t", settings=SETTINGS)
    for token in (wrong, sign(GOOD, key=OTHER), issue()[:-4] + "AAAA"):
        for _ in range(2):
            with pytest.raises(Unauthorized):
                verify_token(token, keys=keys, now=NOW, settings=SETTINGS)

    assert (len(keys._signed), len(keys._digests)) == (0, 0)


def test_a_robot_has_one_place_among_the_remembered_tokens_and_their_number_is_bounded(monkeypatch):
    monkeypatch.setattr(tokens, "_MAX_REMEMBERED", 3)
    keys = trusted()
    mine = [KEY.issue("robot-7", now=NOW, token_id=f"t{n}", settings=SETTINGS) for n in range(9)]
    other = KEY.issue("robot-8", now=NOW, token_id="t", settings=SETTINGS)
    for token in (other, *mine):
        verify_token(token, keys=keys, now=NOW, settings=SETTINGS)
    verify_token(other, keys=keys, now=NOW, settings=SETTINGS)

    assert keys.taken == 10, "the tokens of robot-7 did not drive out that of robot-8"
    for n in range(9):
        token = KEY.issue(f"r{n}", now=NOW, token_id="t", settings=SETTINGS)
        verify_token(token, keys=keys, now=NOW, settings=SETTINGS)
    assert len(keys._signed) == len(keys._digests) == 3
