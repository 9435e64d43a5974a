"""Topics of rosbridge clients: who gets which message, when, and what a greedy client is refused."""

from __future__ import annotations

import asyncio
import gc
from typing import Any

import pytest
from rosbridge.conftest import opened

from rse_pf.extensions.rosbridge import topics as limits
from rse_pf.extensions.rosbridge.client import Client as RosbridgeClient
from rse_pf.extensions.rosbridge.subscription import Subscription, TopicMessage
from tests.kit.guarded_server import GuardedServer
from tests.kit.rosbridge_clients import Client, call, publish, subscribe

HOUR_MS = 3_600_000


async def code(client: Client, *operations: Any) -> Any:
    """Return the code of the only refusal of *operations*; None if there is none."""
    await client.send(*operations)
    refused = await client.settle()
    if refused is not None:
        assert (await client.receive())["id"] == "settled"
        return refused["code"]
    return None


async def test_a_message_reaches_every_subscriber_of_the_tenant_and_nobody_else(
    server: GuardedServer,
) -> None:
    async with opened(server) as bridge:
        talker, listener = await bridge.client(), await bridge.client()
        outsider = await bridge.client(tenant="other")
        for each in (talker, listener, outsider):
            await each.send(subscribe())
        await listener.send(subscribe("chat", "s:2"))
        assert [await each.settle() for each in (talker, listener, outsider)] == [None] * 3
        await talker.send({"op": "advertise", "topic": "chat", "type": "std_msgs/String"}, publish("hi"))
        await outsider.send(publish("of another tenant"))

        assert await listener.receive() == {"op": "publish", "topic": "/chat", "msg": {"data": "hi"}}
        assert await talker.data() == ["hi"]
        assert await outsider.data() == ["of another tenant"]
        await talker.send(publish("next"))
        assert await listener.data() == ["next"], "one message for both subscriptions"


async def test_after_its_last_subscription_ends_a_client_gets_nothing(server: GuardedServer) -> None:
    async with opened(server) as bridge:
        client = await bridge.client()
        await client.send(subscribe(identity="s:1"), subscribe(identity="s:2"), subscribe("/other"))
        await client.send({"op": "unsubscribe", "topic": "/chat", "id": "s:1"}, publish(1))
        assert await client.data() == [1]
        await client.send(
            {"op": "unsubscribe", "topic": "/chat", "id": "s:2"}, publish(2), publish(3, "/other")
        )

        assert await client.data() == [3]


async def test_messages_come_no_faster_than_a_subscriber_asked_and_the_newest_survive(
    server: GuardedServer,
) -> None:
    async with opened(server) as bridge:
        client = await bridge.client()
        await client.send(subscribe(throttle_rate=1000, queue_length=3), publish(0))
        began = asyncio.get_running_loop().time()
        assert await client.data() == [0]
        await client.send(*[publish(number) for number in range(1, 10)])

        assert await client.data(3) == [7, 8, 9]
        assert asyncio.get_running_loop().time() - began > 2.5


async def test_a_burst_reaches_a_client_that_reads_in_time_as_a_whole(server: GuardedServer) -> None:
    async with opened(server) as bridge:
        talker, listener = await bridge.client(), await bridge.client()
        await listener.send(subscribe(queue_length=100))
        await listener.settle()
        await talker.send(*[publish(number) for number in range(100)])

        assert await listener.data(100) == list(range(100))


async def test_a_latched_message_waits_for_later_subscribers_until_its_publisher_leaves(
    server: GuardedServer,
) -> None:
    async with opened(server) as bridge:
        talker, early, late = await bridge.client(), await bridge.client(), await bridge.client()
        await talker.send({"op": "advertise", "topic": "/map", "latch": True}, publish("old", "/map"))
        await talker.send(publish("new", "/map"))
        await talker.settle()
        await early.send(subscribe("/map"))
        assert await early.data() == ["new"]
        await talker.send({"op": "unadvertise", "topic": "/map"})
        await talker.settle()
        await late.send(subscribe("/map"), publish("alive", "/map"))

        assert await late.data() == ["alive"]


async def test_both_names_of_a_type_are_one_type_and_another_type_is_a_conflict(
    server: GuardedServer,
) -> None:
    async with opened(server) as bridge:
        ros1, ros2 = await bridge.client(), await bridge.client()
        await ros1.send({"op": "advertise", "topic": "/chat", "type": "std_msgs/String"})
        assert await ros1.settle() is None
        assert await code(ros2, subscribe(type="std_msgs/msg/String")) is None
        await ros1.send(publish("hello"))

        assert await ros2.data() == ["hello"]
        assert await code(ros2, {"op": "advertise", "topic": "/chat", "type": "std_msgs/Int8"}) == "conflict"


@pytest.mark.parametrize(
    ("operation", "refused"),
    [
        (subscribe("/a b"), "bad-request"),
        (subscribe(""), "bad-request"),
        (subscribe("/a/../b"), "bad-request"),
        (subscribe("/s\u0441an"), "bad-request"),
        (subscribe("/other:chat"), "bad-request"),
        (subscribe(compression="png"), "unsupported"),
    ],
)
async def test_what_cannot_be_is_refused_with_the_id_of_the_operation(
    server: GuardedServer, operation: dict[str, Any], refused: str
) -> None:
    async with opened(server) as bridge:
        client = await bridge.client()
        answer = await client.ask(operation)

        assert (answer["op"], answer["level"], answer["id"]) == ("status", "error", "s:1")
        assert answer["code"] == refused
        assert answer["msg"].isprintable()


async def test_topics_have_scopes(server: GuardedServer) -> None:
    async with opened(server) as bridge:
        reader = await bridge.client(scopes=("topics:read",))
        writer = await bridge.client(scopes=("topics:write",))
        assert await code(reader, subscribe()) is None
        assert await code(writer, subscribe()) == "forbidden"
        assert await code(reader, publish(1)) == "forbidden"
        await writer.send(publish(2))

        assert await reader.data() == [2]
        answer = await writer.ask(call("/rosapi/topics"))
        assert answer["values"] == {"topics": [], "types": []}


async def test_limits_of_a_client_are_typed_and_leave_nothing_behind(server: GuardedServer) -> None:
    async with opened(server) as bridge:
        client = await bridge.client(tenant="limits")
        subscriptions = [subscribe(f"/t{number}", number) for number in range(limits.MAX_SUBSCRIPTIONS)]
        topics = [{"op": "advertise", "topic": f"/p{number}"} for number in range(limits.MAX_TOPICS)]

        assert await code(client, *subscriptions, *topics) is None
        assert await code(client, subscribe("/more", "x")) == "quota"
        assert await code(client, {"op": "advertise", "topic": "/more"}) == "quota"
        assert await code(client, publish(1, "/another")) == "quota"

        await client.socket.close()
        after = await bridge.client(tenant="limits")
        while (await after.ask(call("/rosapi/topics")))["values"]["topics"]:
            pass


async def test_a_tenant_has_a_bounded_number_of_topics_and_latched_bytes(
    server: GuardedServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with opened(server) as bridge:
        monkeypatch.setattr(limits, "MAX_TOPICS_OF_TENANT", 2)
        monkeypatch.setattr(limits, "MAX_LATCHED_BYTES", 1000)
        client, other = await bridge.client(), await bridge.client(tenant="other")

        assert await code(client, *[{"op": "advertise", "topic": topic} for topic in ("/t1", "/t2")]) is None
        assert await code(client, subscribe("/t3", 3)) == "quota"
        assert await code(other, subscribe("/t1")) is None
        assert await code(client, publish("x" * 1000, "/t1", latch=True)) == "quota"
        assert await code(client, publish("x" * 500, "/t2", latch=True)) is None
        assert await code(client, publish("x" * 600, "/t1", latch=True)) == "quota"
        await other.send(subscribe("/t1"), publish(1, "/t1"))
        assert await other.data() == [1], "known topics continue"


async def test_a_client_that_left_is_held_by_nothing(server: GuardedServer) -> None:
    async with opened(server) as bridge:
        for _ in range(3):
            client = await bridge.client("leaves")
            for topic in ("/slow", "/quick"):
                rate = HOUR_MS if topic == "/slow" else 0
                await client.send(subscribe(topic, throttle_rate=rate, queue_length=100))
                await client.send(*[publish("x" * 1000, topic, latch=True) for _ in range(4)])
            await client.settle()
            await client.socket.close()
        deadline = asyncio.get_running_loop().time() + 30.0
        while _living(Subscription, TopicMessage, RosbridgeClient):
            assert asyncio.get_running_loop().time() < deadline
            await asyncio.sleep(0.01)


def _living(*kinds: type) -> int:
    gc.collect()
    return sum(isinstance(each, kinds) for each in gc.get_objects())
