"""What ROS programs write: NaN and Infinity, malformed messages, and texts that are passed on unchanged."""

from __future__ import annotations

import pytest
from rosbridge.conftest import opened

from tests.kit.guarded_server import GuardedServer
from tests.kit.rosbridge_clients import publish, subscribe

SCAN = """{"op":"publish","topic":"/scan","type":"sensor_msgs/LaserScan",
    "msg":{"range_max":30.0,"ranges":[1.0,NaN,Infinity,-Infinity,2.5]}}"""
FIX = """{"op":"publish","topic":"/fix","type":"sensor_msgs/msg/NavSatFix",
    "msg":{"latitude":NaN,"longitude":NaN,"altitude":NaN,"status":{"status":-1}}}"""


async def test_what_is_not_finite_arrives_as_null(server: GuardedServer) -> None:
    async with opened(server) as bridge:
        client = await bridge.client()
        await client.send(subscribe("/scan"), subscribe("/fix"), SCAN, FIX)
        assert (await client.receive())["msg"] == {"range_max": 30.0, "ranges": [1.0, None, None, None, 2.5]}
        nothing = dict.fromkeys(("latitude", "longitude", "altitude"))
        assert (await client.receive())["msg"] == {**nothing, "status": {"status": -1}}


async def test_a_message_is_passed_on_as_it_was_written(server: GuardedServer) -> None:
    async with opened(server) as bridge:
        client = await bridge.client()
        await client.send(subscribe(), '{"op":"publish","topic":"/chat","msg":{"x":1.50e1, "y":"\xe4"}}')

        assert await client.socket.recv() == '{"op":"publish","topic":"/chat","msg":{"x":1.50e1, "y":"\xe4"}}'


@pytest.mark.parametrize(
    ("malformed", "code"),
    [
        ("", "bad-message"),
        ("{", "bad-message"),
        ("[]", "bad-message"),
        ('{"op":5}', "bad-message"),
        (b"\xa2bop", "bad-message"),
        (b'{"op":"publish","topic":"/x","msg":"\xff"}', "bad-message"),
        ('{"op":"launch"}', "bad-message"),
        ('{"op":"publish","topic":"/x"}', "bad-message"),
        ('{"op":"publish","topic":"/x","msg":1e400,"type":NaN}', "bad-message"),
        ('{"op":"publish","topic":"/x","msg":' + "[" * 40 + "]" * 40 + "}", "too-large"),
        ('{"op":"publish","topic":"/x","msg":' + "[" * 3000, "too-large"),
        ('{"op":"png","data":"0"}', "unsupported"),
        ('{"op":"fragment","data":"0"}', "unsupported"),
        ('{"op":"advertise_service"}', "unsupported"),
    ],
)
async def test_a_malformed_message_is_answered_and_does_not_end_the_connection(
    server: GuardedServer, malformed: str | bytes, code: str
) -> None:
    async with opened(server) as bridge:
        client = await bridge.client()
        for _ in range(20):
            answer = await client.ask(malformed)
            assert (answer["op"], answer["code"]) == ("status", code)
        await client.send(subscribe(), publish("alive"))

        assert await client.data() == ["alive"]
