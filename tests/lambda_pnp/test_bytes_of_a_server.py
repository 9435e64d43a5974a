"""The burst function and a backend server answer a command in equal bytes, but for times and places."""

from __future__ import annotations

import asyncio
import base64
import time
import zlib
from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np
import pytest
import websockets

from lambda_pnp.answering import Answering
from lambda_pnp.keys import KeyCache
from rse_pf.pnp.problems import KINECT, make_degenerate, make_problem
from rse_pf.services.pnp import PnpRequest, make_request
from rse_pf.wire import CODECS, SUBPROTOCOLS, Command, Failure, Hello, Result, make_codec
from tests.kit.guarded_server import KEY, GuardedServer

pytestmark = pytest.mark.system
PNP = '{"type":"command","id":7,"service":"pnp","payload":%s}'


def compressed(text: str) -> bytes:
    return zlib.compress(text.encode())


MALFORMED = {
    "bomb": zlib.compress(b" " * 50_000_000),
    "no zlib": b"hello",
    "two streams": 2 * compressed("1"),
    "no JSON": compressed("{"),
    "no command": compressed('{"type":"something"}'),
    "NaN": compressed(PNP % '{"points_world":[NaN]}'),
    "infinite": compressed(PNP % '{"points_world":[1e999]}'),
    "deep": compressed("[" * 1000),
    "no payload": compressed(PNP % "{}"),
    "wrong type": compressed(PNP % '{"camera":5}'),
    "too few": compressed(
        PNP % '{"camera":{"fx":500,"fy":500,"cx":320,"cy":240,"width":640,"height":480},'
        '"points_world":[0,0,1],"pixels":[320,240]}'
    ),
}


def request(problem: Any, codec: str) -> PnpRequest:
    return make_request(problem.points_world, problem.pixels, problem.camera, binary=codec == "bin")


def commands(codec: str) -> dict[str, bytes]:
    """Return commands whose answers are a pose, a weak pose, and failures of several kinds."""
    weak = make_problem(seed=9, n=60, outlier_ratio=0.8)
    payloads: dict[str, Any] = {
        "pose": request(make_problem(seed=2), codec),
        "weak pose": request(weak, codec),
        "noise": request(make_degenerate("noise", seed=1), codec),
        "one point": request(make_degenerate("coincident", seed=1), codec),
        "no matches": PnpRequest(camera=KINECT, points_world=np.empty(0), pixels=np.empty(0)),
        "no request": {"camera": 1},
    }
    encode = make_codec(codec).encode
    return {
        name: encode(Command(id=number, service="pnp", payload=payload, trace="t"))
        for number, (name, payload) in enumerate(payloads.items())
    }


def comparable(data: bytes, codec: str) -> bytes:
    """Return the bytes of an answer without its times and the name of its server."""
    message = make_codec(codec).decode_from_server(data)
    assert isinstance(message, (Result, Failure))
    times = {"queue_ms": 0.0, "compute_ms": 0.0, "received_s": 0.0, "sent_s": 0.0}
    without: dict[str, Any] = {"server": "", **(times if isinstance(message, Result) else {})}
    return make_codec("json").encode(msgspec.structs.replace(message, **without))


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[GuardedServer]:
    with GuardedServer(tmp_path_factory.mktemp("server")) as server:
        yield server


async def of_a_server(server: GuardedServer, codec: str, sent: list[bytes]) -> list[bytes]:
    """Return the bytes of the answers that a robot gets over its socket."""
    headers = {"Authorization": f"Bearer {server.token('robot-1')}"}
    protocols = [websockets.Subprotocol(SUBPROTOCOLS[codec])]
    answers = []
    async with websockets.connect(
        server.url, subprotocols=protocols, compression=None, additional_headers=headers
    ) as socket:
        for data in (make_codec(codec).encode(Hello()), *sent):
            await socket.send(data.decode() if codec == "json" else data)
            answers.append(await asyncio.wait_for(socket.recv(decode=False), 30.0))
    return answers[1:]


def of_the_function(server: GuardedServer, codec: str, data: bytes) -> bytes:
    """Return the bytes that the function answers to an event of its URL."""
    function = Answering(server.settings, KeyCache(lambda: KEY.key_set().to_json(), 60.0))
    event = {
        "version": "2.0",
        "rawPath": "/",
        "headers": {
            "authorization": f"Bearer {server.token('robot-1')}",
            "content-type": f"application/{SUBPROTOCOLS[codec]}",
        },
        "requestContext": {"http": {"method": "POST", "path": "/"}},
        "body": base64.b64encode(data).decode(),
        "isBase64Encoded": True,
    }
    answered = function.answer(event, now_s=time.time(), left_ms=9e3, clock=time.monotonic)
    assert answered.status == 200
    return answered.body


@pytest.mark.parametrize("codec", CODECS)
def test_the_function_answers_what_a_server_answers(server: GuardedServer, codec: str) -> None:
    sent = commands(codec)

    expected = asyncio.run(of_a_server(server, codec, list(sent.values())))

    kinds = [type(make_codec(codec).decode_from_server(answer)) for answer in expected]
    assert kinds == [Result, Result, Failure, Failure, Failure, Failure]
    for (name, data), answer in zip(sent.items(), expected, strict=True):
        assert comparable(of_the_function(server, codec, data), codec) == comparable(answer, codec), name


@pytest.mark.parametrize("name", MALFORMED)
def test_the_function_refuses_what_a_server_refuses(server: GuardedServer, name: str) -> None:
    (refused,) = asyncio.run(of_a_server(server, "zlib", [MALFORMED[name]]))

    assert isinstance(make_codec("zlib").decode_from_server(refused), Failure)
    assert comparable(of_the_function(server, "zlib", MALFORMED[name]), "zlib") == comparable(refused, "zlib")
