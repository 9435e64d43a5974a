"""Names of topics that are long, lead out, look alike or belong to another tenant, and full quotas."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest
from rosbridge.conftest import opened

from rse_pf.errors import BadRequest
from rse_pf.wire.live_map import map_of_topic
from tests.kit.guarded_server import GuardedServer

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


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[GuardedServer]:
    """Return a backend server."""
    with GuardedServer(tmp_path_factory.mktemp("server"), workers=1) as started:
        yield started


async def test_a_hostile_name_is_a_typed_refusal_of_every_operation_and_makes_no_topic(
    server: GuardedServer,
) -> None:
    async with opened(server) as bridge:
        client = await bridge.client()
        for name in NAMES.values():
            for operation, fields in OPERATIONS.items():
                refused = await client.ask({"op": operation, "topic": name, **fields})
                assert refused["code"] in ("bad-request", "bad-message"), (operation, name)
                assert refused["hint"]
                assert len(json.dumps(refused)) < 1000
                assert refused["msg"].isprintable()
        assert (await client.ask({**OPERATIONS["subscribe"], "op": "subscribe", "topic": "a" * 5000}))["code"]
        answer = await client.ask({"op": "call_service", "service": "/rosapi/topics", "id": "1"})
        assert answer["values"]["topics"] == []


@pytest.mark.parametrize("name", NAMES)
def test_no_hostile_name_is_a_live_map(name: str) -> None:
    for topic in (NAMES[name], f"live/{NAMES[name]}"):
        with pytest.raises(BadRequest, match="no topic") as raised:
            map_of_topic(topic)
        assert len(raised.value.message) < 300


@pytest.mark.parametrize(
    "topic", ["m", "live/M", "live/m\n", "live/m ", "live/-m", "LIVE/m", "live/live/m", "/live/m"]
)
def test_a_name_that_is_nearly_that_of_a_live_map_is_none(topic: str) -> None:
    with pytest.raises(BadRequest, match="no topic"):
        map_of_topic(topic)


async def test_two_spellings_are_one_topic_and_two_cases_are_two(server: GuardedServer) -> None:
    async with opened(server) as bridge:
        talker, plain, slash, other = [await bridge.client(name) for name in "abcd"]
        for client, topic in ((plain, "scan"), (slash, "/scan"), (other, "/Scan")):
            await client.send({"op": "subscribe", "topic": topic})
            await client.settle()
        for topic in ("/scan", "/Scan"):
            await talker.send({"op": "publish", "topic": topic, "msg": {"data": topic}})

        assert [(await each.receive())["topic"] for each in (plain, slash)] == ["scan", "/scan"]
        assert await other.data() == ["/Scan"]


async def test_topics_of_another_tenant_are_neither_received_nor_named_nor_typed(
    server: GuardedServer,
) -> None:
    async with opened(server) as bridge:
        owner, outsider = await bridge.client("a"), await bridge.client("b", tenant="other")
        await owner.send({"op": "advertise", "topic": "/secret", "type": "a/B", "latch": True})
        await owner.send({"op": "publish", "topic": "/secret", "msg": {"data": 1}, "latch": True})
        await owner.settle()
        await outsider.send({"op": "subscribe", "topic": "/secret", "type": "c/D"})
        listed = await outsider.ask({"op": "call_service", "service": "/rosapi/topics", "id": "1"})
        assert listed["values"] == {"topics": ["/secret"], "types": ["c/D"]}, "its own subscription"
        await owner.send({"op": "publish", "topic": "/secret", "msg": {"data": 2}})
        await owner.settle()
        await outsider.send({"op": "publish", "topic": "/secret", "msg": {"data": 3}})

        assert await outsider.data() == [3]
