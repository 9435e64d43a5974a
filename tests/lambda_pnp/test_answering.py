"""The function answers as a backend server does: same bytes, same poses, same typed failures."""

from __future__ import annotations

import base64
import itertools
import json
import zlib
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from lambda_pnp.answering import Answering
from lambda_pnp.keys import KeyCache
from rse_pf.auth.tokens import SigningKey
from rse_pf.config import PlatformSettings
from rse_pf.wire import SUBPROTOCOLS, Command, Failure, Hello, Message, make_codec
from tests.kit.hostile_maps import hostile_maps

SETTINGS = PlatformSettings()
KEY = SigningKey.from_seed(bytes(range(32)), "key-1")
KEYS = KeyCache(lambda: KEY.key_set().to_json(), 60.0)
NOW_S = 1_800_000_000.0
TOKEN = KEY.issue("robot-1", now=NOW_S, token_id="t", settings=SETTINGS.auth)


def answering(settings: PlatformSettings = SETTINGS) -> Answering:
    return Answering(settings, KEYS)


def event(body: bytes, codec: str = "zlib", token: str = TOKEN) -> dict[str, Any]:
    """An event of a Function URL, payload format 2.0."""
    return {
        "version": "2.0",
        "rawPath": "/",
        "headers": {"authorization": f"Bearer {token}", "content-type": f"application/{SUBPROTOCOLS[codec]}"},
        "requestContext": {"http": {"method": "POST", "path": "/"}},
        "body": base64.b64encode(body).decode(),
        "isBase64Encoded": True,
    }


def answer(what: dict[str, Any], *, codec: str = "zlib", clock: Callable[[], float] = lambda: 0.0) -> Message:
    answered = answering().answer(what, now_s=NOW_S, left_ms=9e3, clock=clock)
    assert answered.status == 200
    return make_codec(codec).decode_from_server(answered.body)


def failure(what: dict[str, Any]) -> str:
    message = answer(what)
    assert isinstance(message, Failure)
    return message.code


def compressed(text: str) -> bytes:
    return zlib.compress(text.encode())


@pytest.mark.parametrize("token", ["", "a.b.c", TOKEN[:-4] + "AAAA"])
def test_a_bad_token_is_rejected_before_anything_is_decoded(token: str) -> None:
    answered = answering().answer(
        event(b"not even a message", token=token), now_s=NOW_S, left_ms=9e3, clock=lambda: 0.0
    )

    assert answered.status == 401
    assert json.loads(answered.body)["code"] == "unauthorized"


def test_an_expired_token_is_rejected() -> None:
    late = NOW_S + SETTINGS.auth.token_ttl_s + SETTINGS.auth.leeway_s + 1
    answered = answering().answer(event(b""), now_s=late, left_ms=9e3, clock=lambda: 0.0)

    assert answered.status == 401


def test_a_bomb_does_not_inflate() -> None:
    assert failure(event(zlib.compress(b" " * 50_000_000))) == "too-large"


@pytest.mark.parametrize("number", ["NaN", "Infinity", "1e999"])
def test_what_is_no_finite_number_is_a_bad_message(number: str) -> None:
    text = '{"type":"command","id":1,"service":"pnp","payload":{"points_world":[' + number + "]}}"

    assert failure(event(compressed(text))) in ("bad-message", "bad-request")


def test_what_is_not_base64_or_no_command_is_a_bad_message() -> None:
    assert failure({**event(b""), "body": "%%%"}) == "bad-message"
    assert failure(event(make_codec("zlib").encode(Hello()))) == "bad-message"


def test_a_late_answer_is_expired_before_and_after_the_work() -> None:
    body = make_codec("zlib").encode(Command(id=1, service="pnp", deadline_ms=0.0))
    slow = itertools.count()
    later = make_codec("zlib").encode(Command(id=1, service="pnp", deadline_ms=1500.0))

    assert failure(event(body)) == "expired"
    told = answer(event(later), clock=lambda: float(next(slow)))
    assert isinstance(told, Failure)
    assert told.code == "expired"
    assert told.id == 1


def of_a_load_balancer(what: dict[str, Any], **changes: Any) -> dict[str, Any]:
    """The same request as an ALB with lists of header values sends it."""
    headers = {name: [value] for name, value in what["headers"].items()}
    return {
        "requestContext": {"elb": {"targetGroupArn": "arn"}}, "httpMethod": "POST", "path": "/burst",
        "queryStringParameters": {}, "multiValueHeaders": headers, "body": what["body"],
        "isBase64Encoded": True, **changes,
    }  # fmt: skip


def test_a_load_balancer_gets_the_answer_of_a_function_url_and_headers_in_its_own_form() -> None:
    command = Command(id=1, service="pnp", deadline_ms=0.0)
    plain = event(make_codec("zlib").encode(command))
    listed = of_a_load_balancer(plain)
    single = {**listed, "headers": plain["headers"]}
    del single["multiValueHeaders"]

    made = [
        answering()
        .answer(what, now_s=NOW_S, left_ms=9e3, clock=lambda: 0.0)
        .as_http(what, init_ms=0.0, cold=False)
        for what in (plain, single, listed)
    ]

    assert [each["body"] for each in made] == [made[0]["body"]] * 3
    assert made[0] == made[1]
    assert made[2]["multiValueHeaders"] == {name: [value] for name, value in made[0]["headers"].items()}
    assert "headers" not in made[2]


@pytest.mark.parametrize("name", ["authorization", "content-type"])
def test_a_header_that_came_twice_is_not_guessed_at(name: str) -> None:
    what = of_a_load_balancer(event(b""))
    what["multiValueHeaders"][name] *= 2
    assert rejected(what) == (400, "bad-message")
    what = of_a_load_balancer(event(b""))
    what["multiValueHeaders"][name.title()] = what["multiValueHeaders"][name]
    assert rejected(what) == (400, "bad-message")
    what = of_a_load_balancer(event(b""))
    what["multiValueHeaders"]["x-forwarded-for"] = ["203.0.113.7", "198.51.100.4"]
    assert answer(what) is not None


def test_the_health_check_of_a_load_balancer_is_answered_without_work() -> None:
    asked = {"requestContext": {"elb": {}}, "httpMethod": "GET", "path": "/", "headers": {}, "body": ""}

    assert rejected(asked) == (401, "unauthorized")


@pytest.mark.parametrize("body", [b"nonsense", make_codec("zlib").encode(Command(id=1, service="pnp"))])
def test_a_token_without_the_scope_gets_nothing_decoded(body: bytes) -> None:
    token = KEY.issue("robot-2", now=NOW_S, token_id="t", settings=SETTINGS.auth, scopes=("maps:read",))

    assert failure(event(body, token=token)) == "forbidden"


def rejected(what: Any) -> tuple[int, str]:
    answered = answering().answer(what, now_s=NOW_S, left_ms=9e3, clock=lambda: 0.0)
    return answered.status, json.loads(answered.body)["code"]


@pytest.mark.parametrize(
    "what",
    [
        None, 7, "text", [], b"bytes", {"headers": 7}, {"headers": "a: b"}, {"headers": [["a", "b"]]},
        {"headers": {"authorization": None}}, {"headers": {"authorization": ["Bearer", TOKEN]}},
        {"headers": {7: "seven"}}, {"headers": {f"h{n}": "" for n in range(300)}}, event(b"") | {"body": 7},
        event(b"") | {"body": ["a"]}, event(b"") | {"body": b"bytes"}, event(b"") | {"body": {"a": 1}},
        event(b"") | {"body": "\ud800", "isBase64Encoded": False},
    ],
)  # fmt: skip
def test_an_event_of_another_form_is_a_typed_400(what: Any) -> None:
    assert rejected(what) == (400, "bad-message")


@pytest.mark.parametrize(
    "what", [{}, {"headers": None, "body": None}, {"headers": {}}, {"isBase64Encoded": 7}]
)
def test_an_event_without_a_token_is_unauthorized(what: Any) -> None:
    assert rejected(what) == (401, "unauthorized")


def test_a_huge_body_is_refused_by_its_length_before_it_is_decoded() -> None:
    assert failure(event(b"") | {"body": "*" * 6_000_000}) == "too-large"


@given(
    what=st.dictionaries(
        st.sampled_from(["headers", "body", "isBase64Encoded", "requestContext"]),
        st.recursive(
            st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.binary(max_size=20),
            lambda inner: (
                st.lists(inner, max_size=3)
                | st.dictionaries(
                    st.sampled_from(["authorization", "content-type", "Content-Type", "x"]), inner
                )
            ),
            max_leaves=6,
        ),
    )
)
@hypothesis_settings(max_examples=60, deadline=None)
def test_no_event_raises(what: dict[str, Any]) -> None:
    assert rejected(what)[0] in (400, 401)
    signed = what | {"headers": event(b"")["headers"]}
    answered = answering().answer(signed, now_s=NOW_S, left_ms=9e3, clock=lambda: 0.0)
    assert answered.status in (200, 400)


def test_every_large_hostile_map_is_refused_as_a_message() -> None:
    large = {name: data for name, data in hostile_maps().items() if len(data) > 5000}

    answers = {name: failure(event(data[8:])) for name, data in large.items()}

    assert len(answers) > 20
    assert set(answers.values()) == {"too-large"}
