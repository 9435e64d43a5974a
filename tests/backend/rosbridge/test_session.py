"""What a rosbridge client hears: its token first, then answers to calls, each typed."""

from __future__ import annotations

import json

import pytest
from backend.gateway.worker_parts import UNIX_S
from backend.rosbridge.clients import Client, call, rosbridge_worker

from rse_pf.backend.gateway.handshake import Accepted, Rejected
from rse_pf.identity import RobotId


def auth(token: str) -> dict[str, object]:
    return {
        "op": "auth", "mac": token, "client": "", "dest": "", "rand": "", "t": 0.5, "level": "", "end": 1.0,
    }  # fmt: skip


def test_a_call_reaches_the_service_and_the_answer_has_its_id_and_spelling():
    with rosbridge_worker() as worker:
        client = worker.client()

        told = [
            *client.say(call(args={"value": [1.5, None, "x"]})),
            *client.say(call("echo", 7, args={"value": 2})),
            *client.say(call()),
        ]

        values = {"value": [1.5, None, "x"]}
        assert told[0] == {
            "op": "service_response", "id": "call:1", "service": "/echo", "values": values, "result": True,
        }  # fmt: skip
        assert told[1]["id"] == 7
        assert told[1]["service"] == "echo"
        assert told[1]["values"] == {"value": 2}
        assert told[2]["result"] is True
        assert told[2]["values"] == {"value": None}
        assert not client.connection.session.codec.calls, "every call was forgotten with its answer"


def test_an_error_is_typed():
    with rosbridge_worker() as worker:
        (told,) = worker.client().say(call("/nothing-here", args={}))

        assert (told["result"], told["id"]) == (False, "call:1")
        assert told["values"]["code"] == "unknown-service"
        assert told["values"]["hint"]
        assert told["values"]["retry_after_ms"] is None


def test_a_call_beyond_its_scope_is_forbidden():
    with rosbridge_worker() as worker:
        (told,) = worker.client(scopes=("services:pnp",)).say(call(args={"value": 1}))

        assert told["values"]["code"] == "forbidden"


def test_a_client_is_a_robot_with_metrics_and_a_connection():
    with rosbridge_worker() as worker:
        client = worker.client("ros-1")
        client.say(call(args={"value": 1}))

        assert client.connection in worker.parts.dispatcher.connections
        assert worker.parts.metrics.requests["echo", "ok"] == 1
        arrived = worker.parts.told[0]
        assert (arrived["event"], arrived["robot"]) == ("arrived", RobotId("default", "ros-1"))


def test_the_path_is_not_there_unless_it_is_switched_on():
    with rosbridge_worker(rosbridge=False) as worker:
        assert worker.judge().status == 404
    with rosbridge_worker() as worker:
        assert isinstance(worker.judge("Bearer nonsense"), Rejected)
        assert worker.judge(path=b"/ws").status == 401
        assert worker.judge(path=b"/rosbridge?x=1").awaits_token
        assert worker.judge(origin="http://elsewhere", host="here").status == 403


def test_a_token_in_the_first_message_opens_the_connection():
    with rosbridge_worker() as worker:
        client = worker.stranger()
        assert client.connection not in worker.parts.dispatcher.connections

        assert client.say(auth(worker.token("ros-1"))) == []
        (told,) = client.say(call(args={"value": 1}))

        assert told["values"] == {"value": 1}
        assert client.connection.robot == RobotId("default", "ros-1")
        assert client.connection in worker.parts.dispatcher.connections
        worker.parts.loop.advance(3.5)
        assert not client.closed


def test_before_its_token_a_client_is_refused_everything_and_closed_in_time():
    with rosbridge_worker() as worker:
        client = worker.stranger()

        told = client.say(call(args={"value": 1}), {"op": "subscribe", "topic": "/x"}, call("/rosapi/topics"))

        assert [each.get("values", each)["code"] for each in told] == ["unauthorized"] * 3
        assert not worker.parts.metrics.requests
        worker.parts.loop.advance(2.9)
        assert not client.closed
        worker.parts.loop.advance(0.2)
        assert client.closed == 4401


@pytest.mark.parametrize("token", ["", "nonsense", "expired"])
def test_a_wrong_token_ends_the_connection_without_a_reason(token: str):
    with rosbridge_worker() as worker:
        client = worker.stranger()
        if token == "expired":
            token = worker.token("ros-1")
            worker.parts.loop.now += 2000.0
        (told,) = client.say(auth(token))

        assert told["code"] == "unauthorized"
        assert "expired" not in json.dumps(told)
        assert client.closed == 4401
        assert client.connection not in worker.parts.dispatcher.connections
        assert client.say(auth(worker.token("ros-1"))) == []


def test_strangers_are_bounded_for_each_address():
    with rosbridge_worker(max_unauthenticated_per_source=3) as worker:
        verdict = worker.judge()
        near = [
            Client(worker.parts, Accepted(robot=verdict.robot, codec="rosbridge", subprotocol="",
                                          awaits_token=True, source="10.0.0.1"))
            for _ in range(5)
        ]  # fmt: skip
        far = worker.stranger()

        assert [each.closed for each in near] == [4401, 4401, 0, 0, 0], "who waited longest leaves"
        assert not far.closed


def test_a_long_first_message_is_not_read():
    with rosbridge_worker() as worker:
        client = worker.stranger()
        client.say(auth("x" * 9000))

        assert client.closed == 4400


def test_a_fresh_token_prolongs_the_connection_and_one_of_another_robot_does_not():
    with rosbridge_worker() as worker:
        client = worker.client("ros-1")
        client.say({"op": "set_level", "level": "info"})
        (refused,) = client.say(auth(worker.token("ros-2")))
        assert refused["code"] == "unauthorized"
        worker.parts.loop.now += 1.5
        fresh = worker.token("ros-1")
        (told,) = client.say(auth(fresh))

        assert (told["op"], told["level"]) == ("status", "info")
        assert not client.closed


def test_the_connection_ends_with_its_token():
    with rosbridge_worker(session={"ping_timeout_s": 10_000.0}) as worker:
        client = worker.client(ttl_s=60)
        worker.parts.loop.advance(59.0)
        assert not client.closed
        worker.parts.loop.advance(2.0)
        assert client.closed == 4401
        assert worker.parts.clocks.wall() > UNIX_S + 60


@pytest.mark.parametrize("op", ["png", "fragment", "cbor", "advertise_service"])
def test_what_is_not_supported_is_refused_with_a_typed_status(op: str):
    with rosbridge_worker() as worker:
        client = worker.client()
        (told,) = client.say({"op": op, "id": "x:1", "data": "0" * 100})

        assert (told["op"], told["level"], told["id"]) == ("status", "error", "x:1")
        assert told["code"] == "unsupported"
        assert "not supported" in told["msg"]


@pytest.mark.parametrize(
    "garbage",
    [
        b"", b"{", b"[]", b"null", b'{"op":5}', b"\xa2bop", b'{"op":"publish","topic":"/x","msg":"\xff"}',
        b'{"op":"launch"}', b'{"op":"publish","topic":"/x"}', b'{"op":"publish","topic":"/x","msg":NaN}',
        b'{"op":"publish","topic":"/x","msg":' + b"[" * 40 + b"]" * 40 + b"}",
        b'{"op":"publish","topic":"/x","msg":' + b"[" * 3000,
        json.dumps({"op": "publish", "topic": "/x", "msg": {}, "id": "i" * 300}).encode(),
    ],
)  # fmt: skip
def test_garbage_is_answered_by_a_typed_status_and_closed_after_ten(garbage: bytes):
    with rosbridge_worker() as worker:
        client = worker.client()
        (told,) = client.say(garbage)

        assert told["op"] == "status"
        assert told["code"] in ("bad-message", "too-large")
        client.say(*[garbage] * 10)
        assert client.closed == 4400


def test_a_payload_that_breaks_a_limit_is_answered_by_its_call():
    with rosbridge_worker() as worker:
        deep = json.loads("[" * 40 + "]" * 40)
        (told,) = worker.client().say(call(args={"value": deep}))

        assert (told["id"], told["result"], told["values"]["code"]) == ("call:1", False, "too-large")


def test_one_above_the_rate_is_refused_as_busy_with_the_id_of_its_call():
    with rosbridge_worker(session={"max_commands_per_s": 1.0}) as worker:
        client = worker.client()
        first, second, third = sorted(
            client.say(*[call(identity=f"c:{k}", args={"value": k}) for k in range(3)]),
            key=lambda told: told["id"],
        )

        assert first["result"]
        assert second["result"]
        assert (third["id"], third["values"]["code"]) == ("c:2", "busy")
        assert third["values"]["retry_after_ms"] > 0
        assert not client.connection.session.codec.calls


def test_the_timeout_of_a_call_is_its_deadline():
    with rosbridge_worker() as worker:
        client = worker.client()
        seen = []
        submit = worker.parts.dispatcher.submit
        worker.parts.dispatcher.submit = lambda *arguments: seen.append(arguments[1]) or submit(*arguments)
        client.say(call(args={"value": 1}, timeout=0.25), call(args={"value": 1}, timeout=-1))

        assert [each.deadline_ms for each in seen] == [250.0, None]


def test_a_server_that_leaves_closes_a_client_which_connects_again():
    with rosbridge_worker() as worker:
        client = worker.client()
        client.say({"op": "set_level", "level": "warning"})
        worker.parts.dispatcher.move_all("drain", 5000.0)

        assert client.closed == 1001
        assert client.told()[0]["level"] == "warning"
        assert worker.client("late").closed == 1001


def test_a_status_below_the_level_is_not_sent():
    with rosbridge_worker() as worker:
        client = worker.client()
        assert client.say({"op": "set_level", "level": "none"}, {"op": "png", "data": ""}) == []
