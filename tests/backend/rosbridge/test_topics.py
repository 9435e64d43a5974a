"""Topics of rosbridge clients: who gets which message, when, and what a slow or greedy one costs."""

from __future__ import annotations

from typing import Any

from backend.rosbridge.clients import UNLIMITED, Client, call, rosbridge_worker

from rse_pf.backend.rosbridge import subscription as subscriptions
from rse_pf.backend.rosbridge import topics as limits
from rse_pf.backend.rosbridge.subscription import MAX_QUEUE_LENGTH


def subscribe(topic: str = "/chat", identity: Any = "s:1", **more: Any) -> dict[str, Any]:
    return {"op": "subscribe", "id": identity, "topic": topic, **more}


def publish(text: Any, topic: str = "/chat", **more: Any) -> dict[str, Any]:
    return {"op": "publish", "topic": topic, "msg": {"data": text}, **more}


def heard(client: Client) -> list[Any]:
    """Return, once, the data of the messages that a client was told."""
    return [each["msg"]["data"] for each in client.told() if each["op"] == "publish"]


def code(told: list[Any]) -> str:
    (only,) = told
    return str(only["code"])


def test_a_message_reaches_every_subscriber_of_the_tenant_and_nobody_else():
    with rosbridge_worker() as worker:
        talker, listener = worker.client("a"), worker.client("b")
        stranger = worker.client("c", tenant="other")
        for each in (talker, listener, stranger):
            each.say(subscribe())
        listener.say(subscribe("chat", "s:2"))
        own = talker.say({"op": "advertise", "topic": "chat", "type": "std_msgs/String"}, publish("hi"))

        assert listener.told() == [{"op": "publish", "topic": "/chat", "msg": {"data": "hi"}}]
        assert [each["msg"]["data"] for each in own] == ["hi"]
        assert heard(stranger) == []


def test_after_its_last_subscription_ends_a_client_hears_nothing():
    with rosbridge_worker() as worker:
        talker, listener = worker.client("a"), worker.client("b")
        listener.say(subscribe(identity="s:1"), subscribe(identity="s:2"))
        listener.say({"op": "unsubscribe", "topic": "/chat", "id": "s:1"})
        talker.say(publish(1))
        assert heard(listener) == [1]
        listener.say({"op": "unsubscribe", "topic": "/chat", "id": "s:2"})
        talker.say(publish(2))

        assert heard(listener) == []


def test_messages_come_no_faster_than_a_subscriber_asked_and_the_newest_survive():
    with rosbridge_worker() as worker:
        loop = worker.parts.loop
        talker, slow, queued = worker.client("a"), worker.client("b"), worker.client("c")
        slow.say(subscribe(throttle_rate=100))
        queued.say(subscribe(throttle_rate=100, queue_length=3))
        talker.say(*[publish(k) for k in range(10)])

        assert heard(slow) == heard(queued) == [0]
        loop.advance(0.35)
        assert heard(slow) == [9]
        assert heard(queued) == [7, 8, 9]
        talker.say(publish(10), publish(11))
        loop.advance(0.2)
        assert heard(slow) == [10, 11]
        assert heard(queued) == [10, 11]


def test_a_stalled_reader_gets_the_newest_only_and_delays_nobody():
    with rosbridge_worker() as worker:
        loop = worker.parts.loop
        talker, stalled, quick = worker.client("a"), worker.client("b"), worker.client("c")
        for each in (stalled, quick):
            each.say(subscribe())
        stalled.wire.unsent = 1 << 20
        talker.say(*[publish(k) for k in range(100)])

        assert heard(quick) == list(range(100))
        assert heard(stalled) == []
        stalled.wire.unsent = 0
        loop.advance(0.1)
        assert heard(stalled) == [99]
        assert worker.parts.dispatcher.snapshot()["gauges"]["rosbridge_replaced"] == 99


def test_what_waits_for_a_stalled_reader_is_bounded_in_bytes_and_number():
    with rosbridge_worker() as worker:
        talker, stalled = worker.client("a"), worker.client("b")
        stalled.wire.unsent = 1 << 20
        stalled.say(subscribe(queue_length=10_000), subscribe("/large", "s:2", queue_length=100))
        talker.say(*[publish(k) for k in range(150)])
        for _ in range(10):
            talker.say(publish("x" * 200_000, "/large"))
            worker.parts.loop.run_until(lambda: not talker.wire.holds)
        stalled.wire.unsent = 0
        worker.parts.loop.advance(0.1)

        told = heard(stalled)
        assert [each for each in told if isinstance(each, int)] == list(range(150 - MAX_QUEUE_LENGTH, 150))
        assert sum(isinstance(each, str) for each in told) == 5


def test_what_waits_for_all_stalled_readers_of_a_tenant_is_bounded_and_other_tenants_keep_theirs(monkeypatch):
    monkeypatch.setattr(subscriptions, "MAX_HELD_BYTES", 50_000)
    with rosbridge_worker(session=UNLIMITED) as worker:
        talker, rival = worker.client("a"), worker.client("b", tenant="other")
        readers = [worker.client(f"r{number}") for number in range(5)]
        other = worker.client("s", tenant="other")
        for each in (*readers, other):
            each.wire.unsent = 1 << 20
            each.say(subscribe(queue_length=100))
        for _ in range(40):
            talker.say(publish(1000 * "x"))
            rival.say(publish(1000 * "x"))
        for each in (*readers, other):
            each.wire.unsent = 0
        worker.parts.loop.advance(0.1)

        assert sum(len(heard(each)) for each in readers) <= 50 + len(readers)
        assert len(heard(other)) == 40


def test_a_subscription_that_ended_holds_nothing_for_its_tenant():
    held = subscriptions.HeldBytes()
    one = subscriptions.Subscription(None, "/chat", held)
    for _ in range(3):
        one.put(subscriptions.TopicMessage(bytes(1000)))
    assert held.of_tenant == 3000
    one.requests["s"] = 0.0, 2
    one.drop_surplus()
    one.take(0.0)
    assert held.of_tenant == 1000

    one.clear()

    assert held.of_tenant == 0


def test_a_latched_message_waits_for_its_first_subscriber_until_its_publisher_leaves():
    with rosbridge_worker() as worker:
        talker = worker.client("a")
        talker.say({"op": "advertise", "topic": "/map", "latch": True}, publish("old", "/map"))
        talker.say(publish("new", "/map"))
        early = worker.client("b")
        (told,) = early.say(subscribe("/map"))
        talker.connection.on_socket_end()
        late = worker.client("c")

        assert told["msg"] == {"data": "new"}
        assert late.say(subscribe("/map")) == []


def test_limits_are_typed_and_leave_nothing_behind():
    with rosbridge_worker() as worker:
        client = worker.client()
        assert client.say(*[subscribe(f"/t{k}", k) for k in range(limits.MAX_SUBSCRIPTIONS)]) == []
        assert code(client.say(subscribe("/more", "x"))) == "quota"
        assert client.say(*[{"op": "advertise", "topic": f"/p{k}"} for k in range(limits.MAX_TOPICS)]) == []
        assert code(client.say({"op": "advertise", "topic": "/more"})) == "quota"
        assert code(client.say(publish(1, "/another"))) == "quota"
        assert not client.closed
        client.connection.on_socket_end()

        gauges = worker.parts.dispatcher.snapshot()["gauges"]
        assert (gauges["rosbridge_topics"], gauges["rosbridge_subscriptions"]) == (0.0, 0.0)


def test_a_tenant_has_a_bounded_number_of_topics_and_latched_bytes(monkeypatch):
    monkeypatch.setattr(limits, "MAX_TOPICS_OF_TENANT", 2)
    monkeypatch.setattr(limits, "MAX_LATCHED_BYTES", 1000)
    with rosbridge_worker() as worker:
        client, other = worker.client("a"), worker.client("b", tenant="other")
        client.say(*[{"op": "advertise", "topic": topic} for topic in ("/t1", "/t2")])
        assert code(client.say(subscribe("/t3", 3))) == "quota"
        assert other.say(subscribe("/t1")) == []
        assert code(client.say(publish("x" * 1000, "/t1", latch=True))) == "quota"
        assert client.say(publish("x" * 500, "/t2", latch=True)) == []
        assert code(client.say(publish("x" * 600, "/t1", latch=True))) == "quota"


def test_a_name_a_type_or_a_compression_that_cannot_be_is_refused():
    with rosbridge_worker() as worker:
        client = worker.client()
        assert code(client.say(subscribe("/a b"))) == "bad-request"
        assert code(client.say(subscribe(""))) == "bad-request"
        assert code(client.say(subscribe(compression="png"))) == "unsupported"
        client.say(subscribe(type="std_msgs/String"))
        assert code(client.say({"op": "advertise", "topic": "/chat", "type": "std_msgs/Int8"})) == "conflict"


def test_topics_have_scopes():
    with rosbridge_worker() as worker:
        reader = worker.client("a", scopes=("topics:read",))
        writer = worker.client("b", scopes=("topics:write",))
        assert reader.say(subscribe()) == []
        assert code(writer.say(subscribe())) == "forbidden"
        assert code(reader.say(publish(1))) == "forbidden"
        writer.say(publish(2))

        assert heard(reader) == [2]
        (told,) = writer.say(call("/rosapi/topics"))
        assert told["values"] == {"topics": [], "types": []}


def test_rosapi_tells_services_and_topics():
    with rosbridge_worker() as worker:
        client = worker.client(scopes=("services:echo", "topics:*"))
        client.say({"op": "advertise", "topic": "/chat", "type": "std_msgs/String"})

        def ask(what: str, **args: str) -> Any:
            (told,) = client.say(call(f"/rosapi/{what}", args=args))
            return told["values"]

        assert ask("services") == {"services": ["/echo"]}
        assert ask("topics") == {"topics": ["/chat"], "types": ["std_msgs/String"]}
        assert ask("service_type", service="/echo") == {"type": "rse_pf/echo"}
        assert ask("service_type", service="/pnp") == {"type": ""}
        assert ask("topic_type", topic="/chat") == {"type": "std_msgs/String"}
        assert ask("get_time")["code"] == "unknown-service"
        assert ask("service_type", service=3)["code"] == "bad-request"  # type: ignore[arg-type]


def test_a_message_is_passed_on_as_it_was_written():
    with rosbridge_worker() as worker:
        talker, listener = worker.client("a"), worker.client("b")
        listener.say(subscribe())
        seen: list[bytes] = []
        listener.wire.send = lambda data, is_text: seen.append(data)  # type: ignore[method-assign]
        talker.say(b'{"op":"publish","topic":"/chat","msg":{"x":1.50e1, "y":"\xc3\xa4"}}')

        assert seen == [b'{"op":"publish","topic":"/chat","msg":{"x":1.50e1, "y":"\xc3\xa4"}}']
