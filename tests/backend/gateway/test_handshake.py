"""Which handshakes are accepted, and the fixed answers for all others."""

from __future__ import annotations

import json

import pytest

from rse_pf.auth.tokens import SigningKey
from rse_pf.backend.gateway.handshake import HEALTH, Accepted, HandshakePolicy, Rejected
from rse_pf.config import PlatformSettings
from rse_pf.identity import RobotId
from rse_pf.wire import SUBPROTOCOLS

SETTINGS = PlatformSettings()
KEY = SigningKey.from_seed(b"d" * 32, "k1")
NOW_S = 1_000_000.0


def token(ttl_s: float = 100.0, now: float = NOW_S) -> str:
    return KEY.issue("robot-1", now=now, token_id="t", settings=SETTINGS.auth, ttl_s=ttl_s)


def judge(policy: HandshakePolicy | None = None, **changed: object) -> Accepted | Rejected:
    asked: dict = {
        "path": b"/ws", "authorization": f"Bearer {token()}", "offered": [SUBPROTOCOLS["bin"]],
        "is_full": False, "anonymous": "anonymous-1", "now_s": NOW_S, **changed,
    }  # fmt: skip
    return (policy or HandshakePolicy(SETTINGS, KEY.key_set())).judge(**asked)


def test_a_valid_token_gives_the_robot_and_the_end_of_its_connection():
    assert judge() == Accepted(
        robot=RobotId("default", "robot-1"),
        codec="bin",
        subprotocol=SUBPROTOCOLS["bin"],
        expires_s=NOW_S + 100,
    )


def test_a_connection_with_a_token_within_its_leeway_ends_with_the_leeway():
    verdict = judge(authorization=f"Bearer {token(10.0)}", now_s=NOW_S + 20)

    assert isinstance(verdict, Accepted)
    assert verdict.expires_s == NOW_S + 10 + SETTINGS.auth.leeway_s


def test_the_query_of_the_path_does_not_matter():
    assert isinstance(judge(path=b"/ws?x=1"), Accepted)


def test_the_first_offered_subprotocol_that_the_server_speaks_is_chosen():
    verdict = judge(offered=["chat", SUBPROTOCOLS["json"], SUBPROTOCOLS["bin"]])

    assert isinstance(verdict, Accepted)
    assert verdict.codec == "json"


def test_a_browser_may_offer_its_token_as_a_subprotocol_which_is_never_selected():
    offered = [SUBPROTOCOLS["json"], f"bearer.{token()}"]

    accepted = judge(authorization="", offered=offered)
    wrong = judge(authorization="", offered=[SUBPROTOCOLS["json"], f"bearer.{token()}x"])

    assert isinstance(accepted, Accepted)
    assert (accepted.robot, accepted.subprotocol) == (RobotId("default", "robot-1"), SUBPROTOCOLS["json"])
    assert isinstance(wrong, Rejected)
    assert wrong.body == judge(authorization="").body


@pytest.mark.parametrize(
    ("changed", "status", "result"),
    [
        ({"path": b"/other"}, 404, "not-found"),
        ({"is_full": True}, 503, "full"),
        ({"authorization": ""}, 401, "unauthorized"),
        ({"authorization": token()}, 401, "unauthorized"),
        ({"now_s": NOW_S + 1000}, 401, "unauthorized"),
        ({"offered": []}, 400, "unsupported"),
    ],
)
def test_other_handshakes_are_rejected(changed, status, result):
    verdict = judge(**changed)

    assert isinstance(verdict, Rejected)
    assert (verdict.status, verdict.result) == (status, result)
    assert json.loads(verdict.body)["code"] == result


def test_all_causes_of_a_bad_token_get_the_same_bytes_but_the_log_knows():
    stranger = SigningKey.from_seed(b"s" * 32, "k1").issue(
        "robot-1", now=NOW_S, token_id="t", settings=SETTINGS.auth
    )
    verdicts = [
        judge(authorization=a, now_s=now)
        for a, now in [
            ("", NOW_S), ("Bearer x", NOW_S), (f"Bearer {stranger}", NOW_S),
            (f"Bearer {token()}", NOW_S + 999),
        ]
    ]  # fmt: skip

    assert len({(v.status, v.body, tuple(v.headers.items())) for v in verdicts}) == 1
    assert len({v.reason for v in verdicts}) == 4


def test_without_keys_robots_are_anonymous_and_never_expire():
    assert judge(HandshakePolicy(SETTINGS, None)) == Accepted(
        robot=RobotId("default", "anonymous-1"), codec="bin", subprotocol=SUBPROTOCOLS["bin"], expires_s=None
    )


def test_the_conformance_echo_accepts_every_handshake():
    policy = HandshakePolicy(SETTINGS, None, conformance_echo=True)

    assert judge(policy, path=b"/", offered=[], authorization="") == Accepted(
        robot=RobotId("default", "anonymous-1"), codec="", subprotocol=""
    )


def test_the_health_page_has_one_answer_also_when_the_server_is_full():
    answers = [
        judge(path=b"/healthz", authorization=each, is_full=full) for each in ("", "x") for full in (0, 1)
    ]

    assert all(answer == answers[0] for answer in answers)
    assert isinstance(answers[0], Rejected)
    assert (answers[0].status, answers[0].body, answers[0].result) == (200, b'{"status":"ok"}', HEALTH)
    assert judge(path=b"/healthz?x").status == 404
