"""Calls of rosbridge clients: their token first, then an answer or a typed error for each."""

from __future__ import annotations

import asyncio
import json
from typing import Any

import pytest
from rosbridge.conftest import opened
from websockets.exceptions import InvalidStatus

from tests.kit.guarded_server import GuardedServer
from tests.kit.rosbridge_clients import auth, call


async def test_a_call_reaches_the_service_and_the_answer_has_its_id_and_spelling(
    server: GuardedServer,
) -> None:
    async with opened(server) as bridge:
        client = await bridge.client()
        values = {"value": [1.5, None, "x"]}

        assert await client.ask(call(args=values)) == {
            "op": "service_response", "id": "call:1", "service": "/echo", "values": values, "result": True,
        }  # fmt: skip
        answer = await client.ask(call("echo", 7, args={"value": 2}))
        assert (answer["id"], answer["service"], answer["values"]) == (7, "echo", {"value": 2})
        assert (await client.ask(call()))["values"] == {"value": None}


@pytest.mark.parametrize(
    ("asked", "code"),
    [
        (call("/nothing-here", args={}), "unknown-service"),
        (call(args={"value": 1}, timeout=1e-5), "expired"),
        (call(args={"value": float("nan")}), "bad-message"),
        (call(args={"value": json.loads("[" * 40 + "]" * 40)}), "too-large"),
        (call("/rosapi/topics", args=json.loads("[" + "4e-324," * 999 + "0]")), "too-large"),
        (call(timeout="soon"), "bad-message"),
        (call("/rosapi/get_time"), "unknown-service"),
        (call("/rosapi/service_type", args={"service": 3}), "bad-request"),
    ],
)
async def test_a_call_that_fails_is_answered_with_its_id_and_a_typed_error(
    server: GuardedServer, asked: dict[str, Any], code: str
) -> None:
    async with opened(server) as bridge:
        client = await bridge.client()
        answer = await client.ask(asked)

        assert (answer["op"], answer["id"], answer["result"]) == ("service_response", "call:1", False)
        assert answer["values"]["code"] == code
        assert answer["values"]["message"]


@pytest.mark.parametrize(
    ("asked", "code"),
    [
        ('{"op":"call_service","id":"c","service":"/echo","args":{"value":1e999}}', "bad-request"),
        ('{"op":"call_service","id":"\\ud800","service":"/echo","args":{}}', "bad-message"),
    ],
)
async def test_what_cannot_be_decoded_or_named_is_refused_and_the_connection_stays(
    server: GuardedServer, asked: str, code: str
) -> None:
    async with opened(server) as bridge:
        client = await bridge.client()

        assert (await client.ask(asked))["values"]["code"] == code
        assert await client.settle() is None


async def test_a_client_without_a_token_is_closed_after_a_few_messages_or_a_long_one(
    server: GuardedServer,
) -> None:
    async with opened(server) as bridge:
        many, long = await bridge.open(), await bridge.open()
        await many.send(*['{"op":"x","id":"\\ud800"}'] * 12)
        await long.send(call(args={"value": "x" * 9000}))

        assert (await long.receive())["op"] == "status", "it was not read as a call"
        refusals = [await many.receive() for _ in range(11)]
        assert refusals[-1]["msg"].startswith("unauthorized: no token was sent;"), "after ten messages"
        assert [await each.close_code() for each in (many, long)] == [4401, 4401]


async def test_a_fresh_token_of_another_robot_is_refused_and_the_former_one_stays(
    server: GuardedServer,
) -> None:
    async with opened(server) as bridge:
        client = await bridge.client("keeper")
        for token in ("nonsense", bridge.server.token("another")):
            assert (await client.ask(auth(token)))["code"] == "unauthorized"

        assert (await client.ask(call()))["result"]


async def test_a_call_beyond_its_scope_is_forbidden(server: GuardedServer) -> None:
    async with opened(server) as bridge:
        client = await bridge.client(scopes=("services:pnp",))

        assert (await client.ask(call(args={"value": 1})))["values"]["code"] == "forbidden"


async def test_one_above_the_rate_is_refused_as_busy_with_the_id_of_its_call(server: GuardedServer) -> None:
    async with opened(server, session={"max_commands_per_s": 1.0}) as bridge:
        client = await bridge.client()
        await client.send(*[call("/rosapi/topics", f"c:{number}") for number in range(3)])
        answers = {answer["id"]: answer for answer in [await client.receive() for _ in range(3)]}

    assert [answers[f"c:{number}"]["result"] for number in range(3)] == [True, True, False]
    refused = answers["c:2"]["values"]
    assert refused["code"] == "busy"
    assert refused["retry_after_ms"] > 0


async def test_a_token_in_the_first_message_opens_the_connection(server: GuardedServer) -> None:
    async with opened(server) as bridge:
        client = await bridge.open()
        refused = await client.ask(call(args={"value": 1}))
        assert refused["values"]["code"] == "unauthorized"
        assert (await client.ask({"op": "subscribe", "topic": "/x", "id": "s"}))["id"] == "s"

        answer = await client.ask(auth(bridge.server.token("first-message")), call(args={"value": 2}))

        assert answer["values"] == {"value": 2}


@pytest.mark.parametrize("is_in_header", [True, False])
async def test_a_wrong_token_ends_the_connection(server: GuardedServer, is_in_header: bool) -> None:
    async with opened(server) as bridge:
        client = await bridge.open("nonsense" if is_in_header else "")
        if not is_in_header:
            await client.send(auth("nonsense"))

        assert (await client.receive())["code"] == "unauthorized"
        assert await client.close_code() == 4401


@pytest.mark.slow
async def test_who_shows_no_token_is_closed_and_bounded_for_each_address(server: GuardedServer) -> None:
    serving = {"max_unauthenticated_per_source": 2}
    async with opened(server, serving=serving) as bridge:
        near = [await bridge.open(headers={"X-Forwarded-For": "10.0.0.1"}) for _ in range(3)]
        far = await bridge.open(headers={"X-Forwarded-For": "10.0.0.2"})

        assert await near[0].close_code() == 4401, "who waited longest leaves at once"
        assert (await far.ask(call()))["values"]["code"] == "unauthorized"
        assert [await each.close_code() for each in (*near[1:], far)] == [4401] * 3


async def test_one_address_has_its_own_rate_of_handshakes(server: GuardedServer) -> None:
    async with opened(server) as bridge:
        port = int(bridge.url.split(":")[2].partition("/")[0])

        async def status(source: str) -> str:
            reader, writer = await asyncio.open_connection("127.0.0.1", port)
            writer.write(f"GET /rosbridge HTTP/1.1\r\nHost: x\r\nX-Forwarded-For: {source}\r\n\r\n".encode())
            line = await reader.readline()
            writer.close()
            return line.decode().split()[1]

        seen = [await status("10.0.0.1") for _ in range(1200)]

        assert seen[0] != "429"
        assert "429" in seen[1000:]
        assert await status("10.0.0.2") == seen[0]


@pytest.mark.slow
async def test_a_client_outlives_its_token_by_a_fresh_one_and_ends_with_it(server: GuardedServer) -> None:
    async with opened(server) as bridge:
        began = asyncio.get_running_loop().time()
        token = bridge.server.token("short", ttl_s=10)
        client = await bridge.open(token)
        await client.send(auth(bridge.server.token("short", ttl_s=12)))
        assert (await client.ask(call()))["result"]

        assert await client.close_code() == 4401
        assert asyncio.get_running_loop().time() - began > 11.5, "the first token ends after 11 s"


async def test_a_revoked_client_and_one_that_is_replaced_are_closed(server: GuardedServer) -> None:
    async with opened(server) as bridge:
        older = await bridge.client("twice")
        await older.settle()
        newer = await bridge.client("twice")
        assert (await newer.ask(call()))["result"]
        assert await older.close_code() == 4409

        bridge.server.access.change_deny_list(lambda denied: denied.with_robot("default", "twice", 0.0))
        assert await newer.close_code() == 4401


async def test_pages_of_other_origins_and_other_paths_are_refused(server: GuardedServer) -> None:
    async with opened(server) as bridge:
        for url, headers, status in (
            (bridge.url, {"Origin": "http://elsewhere"}, 403),
            (bridge.url.replace("/rosbridge", "/ws"), {}, 404),
        ):
            bridge.url = url
            with pytest.raises(InvalidStatus) as refused:
                await bridge.open(headers=headers)
            assert refused.value.response.status_code == status


@pytest.mark.slow
async def test_calls_of_a_client_survive_a_killed_server(server: GuardedServer) -> None:
    async with opened(server) as bridge:
        client = await bridge.client()
        assert (await client.ask(call()))["result"]
        await asyncio.to_thread(server.restart, server.port)
        answer = await client.ask(call(args={"value": "after"}, timeout=30))

        assert answer["values"] == {"value": "after"}


async def test_rosapi_lists_what_the_token_allows(server: GuardedServer) -> None:
    async with opened(server) as bridge:
        client = await bridge.client(scopes=("services:echo", "topics:*"))
        await client.send({"op": "advertise", "topic": "/listed", "type": "std_msgs/String"})

        async def ask(what: str, **args: str) -> Any:
            return (await client.ask(call(f"/rosapi/{what}", args=args)))["values"]

        assert await ask("services") == {"services": ["/echo"]}
        assert await ask("topics") == {"topics": ["/listed"], "types": ["std_msgs/String"]}
        assert await ask("service_type", service="/echo") == {"type": "rse_pf/echo"}
        assert await ask("service_type", service="/pnp") == {"type": ""}
        assert await ask("topic_type", topic="/listed") == {"type": "std_msgs/String"}
