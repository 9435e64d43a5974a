"""Names of topics that are long, lead out, look alike or belong to another tenant, and full quotas."""

from __future__ import annotations

import json
from typing import Any

import pytest
from backend.rosbridge.clients import rosbridge_worker

from rse_pf.backend.rosbridge import topics
from rse_pf.errors import BadRequest
from rse_pf.wire.live_map import map_of_topic

NAMES = {
    "nothing": "",
    "a slash": "/",
    "two slashes": "//scan",
    "a slash inside": "/a//b",
    "a slash at the end": "/a/",
    "the folder above": "../a",
    "a folder above inside": "/a/../b",
    "at the end": "/a/..",
    "the same": "/a/./b",
    "a long segment": "/a/" + "b" * 129,
    "many segments": "/a" * 18,
    "a long name": "a" * 256,
    "NUL": "/a\x00b",
    "a line": "/a\nb",
    "a line at the end": "/a\n",
    "an escape sequence": "/a\x1b[2Jb",
    "delete": "/a\x7f",
    "from right to left": "/a\u202eb",
    "invisible": "/a\u200bb",
    "another alphabet": "/s\u0441an",
    "wide": "/\uff53can",
    "combining": "/e\u0301",
    "composed": "/\xe9",
    "a line of Unicode": "/a\u2028b",
    "a digit first": "/1scan",
    "a star": "/*",
    "a wildcard of levels": "/scan/#",
    "a wildcard of one": "/+/scan",
    "a pattern": "/s?an",
    "brackets": "/[a]",
    "a percent": "/a%2fb",
    "a backslash": "/a\\b",
    "a space": "/a b",
    "a colon": "/other:chat",
    "a tenant": "/@other/chat",
}
OPERATIONS: dict[str, dict[str, Any]] = {
    "subscribe": {"id": 1}, "unsubscribe": {}, "advertise": {"type": "a/B"}, "publish": {"msg": {"data": 1}},
    "unadvertise": {},
}  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_a_hostile_name_is_a_typed_refusal_of_every_operation_and_makes_no_topic(name: str) -> None:
    with rosbridge_worker() as worker:
        client = worker.client()
        for operation, fields in OPERATIONS.items():
            (told,) = client.say({"op": operation, "topic": NAMES[name], **fields})
            assert told["code"] == "bad-request", operation
            assert told["hint"]
            assert len(json.dumps(told)) < 1000
            assert all(each.isprintable() for each in told["msg"])
        assert worker.parts.dispatcher.snapshot()["gauges"]["rosbridge_topics"] == 0.0
        assert not client.closed


def test_a_name_beyond_every_bound_is_refused_in_few_words() -> None:
    with rosbridge_worker() as worker:
        client = worker.client()
        for _ in range(5):
            (told,) = client.say({"op": "subscribe", "topic": "/" + "a" * 5_000})
            assert len(json.dumps(told)) < 1000
        assert worker.parts.dispatcher.snapshot()["gauges"]["rosbridge_topics"] == 0.0


@pytest.mark.parametrize("name", NAMES)
def test_no_hostile_name_is_a_live_map(name: str) -> None:
    for topic in (NAMES[name], f"live/{NAMES[name]}"):
        with pytest.raises(BadRequest, match="no topic") as raised:
            map_of_topic(topic)
        assert len(raised.value.message) < 300


@pytest.mark.parametrize(
    "topic", ["live/M", "live/m\n", "live/m ", "live/-m", "LIVE/m", "live/live/m", "/live/m"]
)
def test_a_name_that_is_nearly_that_of_a_live_map_is_none(topic: str) -> None:
    with pytest.raises(BadRequest, match="no topic"):
        map_of_topic(topic)


def test_two_spellings_are_one_topic_and_two_cases_are_two() -> None:
    with rosbridge_worker() as worker:
        talker, plain, slash, other = (worker.client(name) for name in "abcd")
        plain.say({"op": "subscribe", "topic": "scan"})
        slash.say({"op": "subscribe", "topic": "/scan"})
        other.say({"op": "subscribe", "topic": "/Scan"})
        talker.say({"op": "publish", "topic": "/scan", "msg": {"data": 1}})

        assert [each["topic"] for each in (*plain.told(), *slash.told())] == ["scan", "/scan"]
        assert other.told() == []


def test_topics_of_another_tenant_are_neither_heard_nor_named_nor_typed() -> None:
    with rosbridge_worker() as worker:
        owner = worker.client("a")
        owner.say({"op": "advertise", "topic": "/secret", "type": "a/B", "latch": True})
        owner.say({"op": "publish", "topic": "/secret", "msg": {"data": 1}, "latch": True})
        stranger = worker.client("b", tenant="other")

        assert stranger.say({"op": "subscribe", "topic": "/secret", "type": "c/D"}) == []
        (listed,) = stranger.say({"op": "call_service", "service": "/rosapi/topics", "id": "1"})
        assert listed["values"] == {"topics": ["/secret"], "types": ["c/D"]}, "its own subscription"
        owner.say({"op": "publish", "topic": "/secret", "msg": {"data": 2}})
        assert stranger.told() == []


def test_beyond_the_quota_of_a_tenant_known_topics_and_other_tenants_go_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(topics, "MAX_TOPICS_OF_TENANT", 3)
    with rosbridge_worker() as worker:
        greedy, listener = worker.client("a"), worker.client("b")
        other = worker.client("c", tenant="other")
        listener.say({"op": "subscribe", "topic": "/known"})
        greedy.say(*[{"op": "advertise", "topic": f"/t{number}"} for number in range(2)])
        for number in range(20):
            (told,) = greedy.say({"op": "advertise", "topic": f"/more{number}"})
            assert told["code"] == "quota"
        (told,) = listener.say({"op": "subscribe", "topic": "/late"})
        assert told["code"] == "quota"

        assert greedy.say({"op": "publish", "topic": "/known", "msg": {"data": 1}}) == []
        assert [each["msg"]["data"] for each in listener.told()] == [1]
        assert other.say({"op": "advertise", "topic": "/t0"}, {"op": "subscribe", "topic": "/t9"}) == []
        greedy.connection.on_socket_end()
        assert listener.say({"op": "subscribe", "topic": "/late"}) == []
