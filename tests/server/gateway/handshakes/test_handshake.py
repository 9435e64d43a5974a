"""Which handshakes are accepted, and the fixed answers for all others."""

from __future__ import annotations

import json

import pytest

from rse_pf.auth.roster import DenyList, EnrolledRobot, Roster
from rse_pf.auth.tokens import SigningKey
from rse_pf.config import PlatformSettings
from rse_pf.identity import RobotId
from rse_pf.server.gateway.handshake import (
    HEALTH,
    Accepted,
    HandshakePolicy,
    Rejected,
    RequestHead,
)
from rse_pf.wire import SUBPROTOCOLS

SETTINGS = PlatformSettings()
KEY = SigningKey.from_seed(b"d" * 32, "k1")
NOW_S = 1_000_000.0


def token(ttl_s: float = 100.0, now: float = NOW_S) -> str:
    return KEY.issue("robot-1", now=now, token_id="t", settings=SETTINGS.auth, ttl_s=ttl_s)


def judge(policy: HandshakePolicy | None = None, **changed: object) -> Accepted | Rejected:
    asked: dict = {
        "path": b"/ws", "authorization": f"Bearer {token()}", "offered": [SUBPROTOCOLS["bin"]], "origin": "",
        "host": "", "is_full": False, "anonymous": "anonymous-1", "now_s": NOW_S, **changed,
    }  # fmt: skip
    worker = {name: asked.pop(name) for name in ("is_full", "anonymous", "now_s")}
    policy = policy or HandshakePolicy(SETTINGS, KEY.key_set())
    headers = {
        b"authorization": asked["authorization"].encode("ascii", "surrogateescape"),
        b"sec-websocket-protocol": ", ".join(asked["offered"]).encode("ascii", "surrogateescape"),
        b"origin": asked["origin"].encode(),
        b"host": asked["host"].encode(),
    }
    return policy.decide(RequestHead(asked["path"], headers), **worker)


def test_a_browser_may_offer_its_token_as_a_subprotocol_which_is_never_selected():
    offered = [SUBPROTOCOLS["json"], f"rse-pf.token.{token()}"]

    accepted = judge(authorization="", offered=offered)
    wrong = judge(authorization="", offered=[SUBPROTOCOLS["json"], f"rse-pf.token.{token()}x"])

    assert isinstance(accepted, Accepted)
    assert (accepted.robot, accepted.subprotocol) == (RobotId("default", "robot-1"), SUBPROTOCOLS["json"])
    assert isinstance(wrong, Rejected)
    assert wrong.body == judge(authorization="").body


PAGE = "https://robots.example.org"
LISTED = PlatformSettings.from_dict({"serving": {"allowed_origins": f"{PAGE} http://10.0.0.5:9000"}})


@pytest.mark.parametrize(
    ("origin", "is_allowed"),
    [
        ("", True), (PAGE, True), (PAGE.upper(), True), ("http://10.0.0.5:9000", True),
        ("http://platform:8700", True), ("https://platform:8700", True),
        ("null", False), ("http://platform", False), ("http://platform:8701", False),
        ("http://10.0.0.5", False),
        ("http://robots.example.org", False), (f"{PAGE}.evil.example", False), (f"{PAGE}, {PAGE}", False),
        ("file://platform:8700", False), (f"{PAGE}/", False),
    ],
)  # fmt: skip
def test_a_web_page_connects_from_the_platform_itself_or_from_a_listed_origin(origin, is_allowed):
    policy = HandshakePolicy(LISTED, KEY.key_set())

    verdict = judge(policy, origin=origin, host="platform:8700")

    assert isinstance(verdict, Accepted) == is_allowed
    if isinstance(verdict, Rejected):
        assert (verdict.status, json.loads(verdict.body)["code"]) == (403, "forbidden")


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


# --- a robot that proved its key is told why ---------------------------------------------------------

ROBOT_KEY = SigningKey.of_robot(b"r" * 32)
OTHER_KEY = SigningKey.of_robot(b"o" * 32)
ENROLLED = EnrolledRobot(robot="robot-1", tenant="lab", x=json.loads(ROBOT_KEY.public_json())["x"])
UNTOLD = (
    b"HTTP/1.1 401 Unauthorized\r\nContent-Type: application/json\r\nWWW-Authenticate: Bearer\r\n"
    b"Content-Length: 138\r\nConnection: close\r\n\r\n"
    b'{"platform":"rse-pf","code":"unauthorized","message":"the token is missing or not valid",'
    b'"hint":"issue one with rse-pf token issue ROBOT"}'
)
"""What was answered, whatever was wrong, before robots were told why."""


def with_deny_list(denied: DenyList) -> HandshakePolicy:
    keys = KEY.key_set().with_access_control(Roster(robots=(ENROLLED,)), denied)
    return HandshakePolicy(SETTINGS, keys)


def own_token(
    key: SigningKey = ROBOT_KEY, *, robot: str = "robot-1", now_s: float = NOW_S, token_id: str = "t"
) -> str:
    return key.issue(robot, now=now_s, token_id=token_id, settings=SETTINGS.auth, ttl_s=100)


NOBODY_DENIED = DenyList()
CAUSES = {
    "disabled": (NOBODY_DENIED.with_robot("lab", "robot-1", NOW_S), {}),
    "revoked": (NOBODY_DENIED.with_token("lab", "robot-1", "t", NOW_S + 100), {}),
    "cut-off": (NOBODY_DENIED.with_tokens_before("lab", "robot-1", NOW_S + 1), {}),
    "not-yet-valid": (NOBODY_DENIED, {"now_s": NOW_S + 120}),
    "expired": (NOBODY_DENIED, {"now_s": NOW_S - 400}),
}


@pytest.mark.parametrize("cause", CAUSES)
def test_a_robot_that_signed_with_its_enrolled_key_is_told_why_it_is_refused(cause):
    denied, signed = CAUSES[cause]

    refused = judge(with_deny_list(denied), authorization=f"Bearer {own_token(**signed)}")

    told = json.loads(refused.body)
    assert (refused.status, told["platform"], told["code"]) == (401, "rse-pf", "unauthorized")
    assert (told["cause"], told["server_s"]) == (cause, NOW_S)
    assert told.get("valid_from_s") == (NOW_S + 1 if cause == "cut-off" else None)
    assert told["message"] != json.loads(UNTOLD.partition(b"\r\n\r\n")[2])["message"]
    assert told["hint"]
    assert refused.answer.endswith(refused.body)


def test_a_clock_that_is_wrong_is_named_with_its_error():
    ahead = judge(with_deny_list(NOBODY_DENIED), authorization=f"Bearer {own_token(now_s=NOW_S + 120)}")
    behind = judge(
        with_deny_list(CAUSES["cut-off"][0]), authorization=f"Bearer {own_token(now_s=NOW_S - 90)}"
    )

    assert "clock of this robot is 120 s ahead" in json.loads(ahead.body)["message"]
    assert "issued 90 s before the server's present time" in json.loads(behind.body)["message"]


@pytest.mark.parametrize("cause", CAUSES)
@pytest.mark.parametrize(
    "shown",
    [
        "nothing", "no token", "a key that nobody enrolled", "the key id of the robot with another signature",
        "the robot's key with another name", "a cut signature", "the platform's key",
    ],
)  # fmt: skip
def test_strangers_get_the_same_bytes_whatever_the_state_of_the_robot_is(cause, shown):
    denied, signed = CAUSES[cause]
    mine = own_token(**signed)
    head, claims, _ = mine.split(".")
    forged = f"{head}.{claims}.{own_token(OTHER_KEY, **signed).split('.')[2]}"
    earlier_s = {"now_s": NOW_S - 1, **signed}["now_s"]
    lab = KEY.issue("robot-1", now=earlier_s, token_id="t", settings=SETTINGS.auth, ttl_s=100, tenant="lab")
    authorization = {
        "nothing": "",
        "no token": "Bearer x",
        "a key that nobody enrolled": f"Bearer {own_token(OTHER_KEY, **signed)}",
        "the key id of the robot with another signature": f"Bearer {forged}",
        "the robot's key with another name": f"Bearer {own_token(robot='robot-2', **signed)}",
        "a cut signature": f"Bearer {mine[:-2]}",
        "the platform's key": f"Bearer {lab}",
    }[shown]

    refused = judge(with_deny_list(denied), authorization=authorization)

    assert isinstance(refused, Rejected)
    assert refused.answer == UNTOLD


def test_without_keys_robots_are_anonymous_and_never_expire():
    assert judge(HandshakePolicy(SETTINGS, None)) == Accepted(
        robot=RobotId("default", "anonymous-1"), codec="bin", subprotocol=SUBPROTOCOLS["bin"], expires_s=None
    )


def test_the_health_page_has_one_answer_also_when_the_server_is_full():
    answers = [
        judge(path=b"/healthz", authorization=each, is_full=full) for each in ("", "x") for full in (0, 1)
    ]

    assert all(answer == answers[0] for answer in answers)
    assert isinstance(answers[0], Rejected)
    assert (answers[0].status, answers[0].body, answers[0].result) == (200, b'{"status":"ok"}', HEALTH)
    assert judge(path=b"/healthz?x").status == 404


# --- the head of a request -------------------------------------------------------------------------


@pytest.mark.parametrize(
    "data",
    [
        b"", b"GET /ws HTTP/1.0", b"POST /ws HTTP/1.1", b"GET  HTTP/1.1", b"GET /a b HTTP/1.1",
        b"GET /ws HTTP/1.1\r\nbroken", b"GET /ws HTTP/1.1\r\nA: b\r\n c", b"GET /ws HTTP/1.1\r\nA : b",
        b"GET /ws HTTP/1.1\r\n: b", b"GET /ws HTTP/1.1\r\nA: \x00", b"GET /ws HTTP/1.1\r\nA: b\nC: d",
        b"GET /ws HTTP/1.1\r\nTransfer-Encoding: chunked", b"GET /ws HTTP/1.1\r\nContent-Length: 1",
        b"GET /ws HTTP/1.1\r\nContent-Length: 0\r\nContent-Length: 0", b"GET /ws HTTP/1.1\r\nContent-Length:",
        b"GET /ws HTTP/1.1" + b"\r\nA: b" * 129,
    ],
)  # fmt: skip
def test_what_is_no_plain_request_is_none(data):
    assert RequestHead.parse(data) is None


def test_the_header_counts_where_a_subprotocol_carries_another_token():
    refused = judge(authorization="Bearer x", offered=[SUBPROTOCOLS["json"], f"rse-pf.token.{token()}"])

    assert (refused.status, refused.result) == (401, "unauthorized")


def test_a_connection_with_a_token_within_its_leeway_ends_with_the_leeway():
    verdict = judge(authorization=f"Bearer {token(10.0)}", now_s=NOW_S + 20)

    assert isinstance(verdict, Accepted)
    assert verdict.expires_s == NOW_S + 10 + SETTINGS.auth.leeway_s
