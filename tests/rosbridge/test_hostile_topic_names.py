"""Names of topics that are long, lead out, look alike or belong to another tenant."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest
from rosbridge.conftest import opened

from tests.hostile.test_topic_names import NAMES
from tests.kit.guarded_server import GuardedServer

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
