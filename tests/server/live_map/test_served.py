"""A live map with a real backend server, two workers and a real map server: rights, tenants, updates."""

from __future__ import annotations

import asyncio
import random
import time
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed

import client_sdk
from rse_pf.auth.roster import scopes_allow
from rse_pf.data_server.routes import ROUTES
from rse_pf.errors import Forbidden
from rse_pf.geometry import Camera
from rse_pf.server.live_map.router import LIVE_SERVICES
from rse_pf.services.builtin import builtin_services
from rse_pf.slam.keyframe import SentKeyframe, encode_keyframe, make_features
from rse_pf.wire import SUBPROTOCOLS, make_codec, messages
from rse_pf.wire.server_session import CLOSE_PROTOCOL, UPDATES
from tests.kit.guarded_server import KEY, GuardedServer

pytestmark = [pytest.mark.slow, pytest.mark.system]

CAMERA = {"fx": 525.0, "fy": 525.0, "cx": 319.5, "cy": 239.5, "width": 640, "height": 480}


def keyframe(number: int) -> dict[str, Any]:
    """Return the request of a keyframe with random features."""
    noise = np.random.default_rng(number)
    seen = (
        noise.uniform(10, 400, (300, 2)),
        np.full(300, 2.0),
        noise.integers(0, 255, (300, 32), dtype=np.uint8),
    )
    sent = SentKeyframe(
        timestamp_s=float(number),
        T_odom_camera=np.eye(4),
        camera=Camera(**CAMERA),
        features=make_features(*seen),
    )
    return {"map": "m", "segment": 0, "number": number, "keyframe": encode_keyframe(sent)}


def robot(server: GuardedServer, name: str, **claims: Any) -> client_sdk.Robot:
    token = KEY.issue(name, now=time.time(), token_id=name, settings=server.settings.auth, **claims)
    return client_sdk.connect(server.url, token=token, codec="bin", random=random.Random(name))


async def value(updates: client_sdk.Updates, key: str, fits: Callable[[Any], bool]) -> Any:
    """Return the first value of *key* that *fits*."""
    while True:
        updated_key, payload = await updates.next()
        if updated_key == key and fits(payload):
            return payload


@pytest.fixture
def server(tmp_path: Path) -> Iterator[GuardedServer]:
    (tmp_path / "store").mkdir()
    data = {"store": f"dir:{tmp_path / 'store'}"}
    with GuardedServer(tmp_path, workers=2, data=data, session={"max_commands_per_s": 0.0}) as server:
        yield server


async def test_robots_of_all_workers_see_the_map_of_their_tenant_and_no_other(server: GuardedServer) -> None:
    async with (
        robot(server, "sender") as sender,
        robot(server, "a") as a,
        robot(server, "b") as b,
        robot(server, "c") as c,
        robot(server, "d") as d,
        robot(server, "stranger", tenant="other") as stranger,
    ):
        readers = [robot.subscribe("live/m") for robot in (a, b, c, d)]
        foreign = stranger.subscribe("live/m")

        for number in range(3):
            answer = await sender.call("live-keyframe", keyframe(number), deadline_s=20.0)
            assert answer.reply["number"] == number + 1

        for updates in readers:
            pose = await value(updates, "pose/sender", lambda pose: pose["timestamp_s"] == 2.0)
            np.testing.assert_allclose(pose["T_map_camera"], np.eye(4).ravel())
        assert [entry["name"] for entry in (await a.call("live-list", {})).reply["maps"]] == ["m"]
        assert (await stranger.call("live-list", {})).reply["maps"] == []
        assert (await stranger.call("live-show", {"map": "m"})).reply["keyframes"] == 0
        assert await foreign.next() == (
            "map",
            {"kind": "map", "keyframes": 0, "version": 0, "owner": "", "state": "moving"},
        )
        with pytest.raises(asyncio.TimeoutError):
            await asyncio.wait_for(foreign.next(), 0.5)


async def test_a_token_for_another_map_neither_reads_nor_writes(server: GuardedServer) -> None:
    async with robot(server, "r", scopes=("maps:live/other",)) as a_robot:
        with pytest.raises(Forbidden, match="maps:live/m"):
            await a_robot.subscribe("live/m").next()
        with pytest.raises(Forbidden, match="maps:live/m"):
            await a_robot.call("live-keyframe", keyframe(0))
        assert (await a_robot.subscribe("live/other").next())[0] == "map"


async def test_a_token_to_watch_a_map_allows_to_subscribe_to_it_and_nothing_else(
    server: GuardedServer, tmp_path: Path
) -> None:
    store = tmp_path / "store"
    async with robot(server, "v", scopes=("maps:watch/m",)) as viewer, robot(server, "r") as driver:
        updates = viewer.subscribe("live/m")
        assert (await updates.next())[0] == "map"
        for service in sorted(
            {*LIVE_SERVICES, *(service.name for service in builtin_services(server.settings))}
        ):
            if service == "live-list":
                assert (await viewer.call(service, {})).reply == {"maps": []}
                continue
            with pytest.raises(Forbidden):
                await viewer.call(service, keyframe(0) | {"robot": "r"})
        with pytest.raises(Forbidden):
            await viewer.subscribe("live/other").next()
        assert not list(store.glob("live/default/*/lease")), "no owner was started"
        await driver.call("live-keyframe", keyframe(0), deadline_s=20.0)
        await value(updates, "pose/r", lambda pose: pose["timestamp_s"] == 0.0)
    assert [
        route.operation for route in ROUTES if route.scope and scopes_allow(("maps:watch/m",), route.scope)
    ] == []
    assert not any(scopes_allow(("maps:watch",), right) for right in ("topics:read", "topics:write"))


async def ask_raw(
    socket: ClientConnection, message: messages.Message, until: type[messages.Message] = messages.Pong
) -> list[messages.FromServer]:
    """Send one message and a ping; return the answers up to the ping's, and on to the first of *until*."""
    codec, ping = make_codec("json"), messages.Ping(sent_s=time.monotonic())
    for sent in (message, ping):
        await socket.send(codec.encode(sent).decode())
    answers: list[messages.FromServer] = []
    is_answered = is_pong_heard = False
    while not (is_answered and is_pong_heard):
        answer = codec.decode_from_server((await asyncio.wait_for(socket.recv(), 20.0)).encode())
        is_answered |= type(answer) is until
        if isinstance(answer, messages.Pong) and answer.sent_s == ping.sent_s:
            is_pong_heard = True
        else:
            answers.append(answer)
    return answers


async def sends_hello(socket: ClientConnection, server: GuardedServer) -> None:
    with pytest.raises(ConnectionClosed):
        await ask_raw(socket, messages.Hello(capabilities=(UPDATES,)))
    assert (socket.close_code, socket.close_reason) == (CLOSE_PROTOCOL, "hello came twice")


async def sends_commands(socket: ClientConnection, server: GuardedServer) -> None:
    services = {*LIVE_SERVICES, *(service.name for service in builtin_services(server.settings)), "no-such"}
    for identity, service in enumerate(sorted(services - {"live-list"})):
        payload = keyframe(0) | {"robot": "r", "from": "m@abcdef"}
        command = messages.Command(id=identity, service=service, payload=payload)
        [failure] = await ask_raw(socket, command, messages.Failure)
        assert (failure.id, failure.code) == (identity, "forbidden"), service
    [listed] = await ask_raw(socket, messages.Command(id=99, service="live-list"), messages.Result)
    assert listed.reply == {"maps": []}


async def sends_ping(socket: ClientConnection, server: GuardedServer) -> None:
    [pong] = await ask_raw(socket, messages.Ping(sent_s=7.0))
    assert (type(pong), pong.sent_s) == (messages.Pong, 7.0)


async def sends_cancel(socket: ClientConnection, server: GuardedServer) -> None:
    assert await ask_raw(socket, messages.Cancel(id=0)) == []


async def sends_renewals(socket: ClientConnection, server: GuardedServer) -> None:
    stranger = server.token("stranger", scopes=("maps:live/m",))
    [failure] = await ask_raw(socket, messages.Renew(token=stranger), messages.Failure)
    assert failure.code == "unauthorized"
    token = server.token("v", scopes=("maps:watch/m",))
    answer: messages.FromServer = failure
    while not isinstance(answer, messages.Renewed):  # at most one is judged in `RENEWAL_PAUSE_S`
        [answer] = await ask_raw(socket, messages.Renew(token=token))
        assert isinstance(answer, messages.Renewed) or answer.code == "busy"
    command = messages.Command(id=100, service="live-show", payload={"map": "m"})
    [failure] = await ask_raw(socket, command, messages.Failure)
    assert failure.code == "forbidden", "a fresh token of the same right gives no more"


async def subscribes(socket: ClientConnection, server: GuardedServer) -> None:
    no_maps = ("jobs/m", "live/", "live/m/pose", "m")
    codes = {"live/other": "forbidden"} | dict.fromkeys(no_maps, "bad-request")
    for identity, (topic, code) in enumerate(codes.items(), 200):
        [failure] = await ask_raw(socket, messages.Subscribe(id=identity, topic=topic), messages.Failure)
        assert (failure.id, failure.code) == (identity, code), topic
    [update] = await ask_raw(socket, messages.Subscribe(id=300, topic="live/m"), messages.Update)
    assert (update.id, update.topic, update.key) == (300, "live/m", "map")
    while update.payload["state"] != "idle":  # nobody who may start an owner needs one
        assert update.payload["owner"] == ""
        update = make_codec("json").decode_from_server((await asyncio.wait_for(socket.recv(), 20.0)).encode())


async def unsubscribes(socket: ClientConnection, server: GuardedServer) -> None:
    await ask_raw(socket, messages.Subscribe(id=301, topic="live/m"), messages.Update)
    for identity in (300, 301, 302):
        assert await ask_raw(socket, messages.Unsubscribe(id=identity)) == []


def is_refused(message: messages.FromServer) -> Callable[[ClientConnection, GuardedServer], Awaitable[None]]:
    async def send(socket: ClientConnection, server: GuardedServer) -> None:
        [failure] = await ask_raw(socket, message, messages.Failure)
        assert failure.code == "bad-message"

    return send


LIMITS = messages.Limits(max_message_bytes=1 << 20, max_in_flight=9)
SENT_BY_WATCHER: dict[type, Callable[[ClientConnection, GuardedServer], Awaitable[None]]] = {
    messages.Command: sends_commands,
    messages.Ping: sends_ping,
    messages.Cancel: sends_cancel,
    messages.Renew: sends_renewals,
    messages.Subscribe: subscribes,
    messages.Unsubscribe: unsubscribes,
    **{
        type(message): is_refused(message)
        for message in (
            messages.Welcome(server="s", session="s", robot="r", protocol=1, limits=LIMITS, clock_s=0.0),
            messages.Result(id=1, reply={}),
            messages.Failure(code="busy", message="m"),
            messages.Move(reason="drain", within_ms=1.0),
            messages.Progress(id=1, done=0.5),
            messages.Pong(sent_s=0.0, received_s=0.0, answered_s=0.0),
            messages.Renewed(token_s=1e9),
            messages.Update(id=300, topic="live/m", seq=1, key="map", payload={"kind": "map"}),
        )
    },
    messages.Hello: sends_hello,
}
"""What a robot that may only watch sends of each type, and what becomes of it; the last one ends the
connection."""


async def test_a_token_to_watch_a_map_gets_no_message_of_any_type_past_its_right(
    server: GuardedServer, tmp_path: Path
) -> None:
    assert set(SENT_BY_WATCHER) == set(get_args(messages.Message)), "each type of message has its case"

    lease = tmp_path / "store/live/default/m/lease"
    async with robot(server, "r") as driver:
        await driver.call("live-keyframe", keyframe(0), deadline_s=20.0)
    server.restart()  # the map has no owner now, and whoever may start one gets one
    before, token = lease.read_bytes(), server.token("v", scopes=("maps:watch/m",))
    async with connect(
        server.url,
        subprotocols=[SUBPROTOCOLS["json"]],
        compression=None,
        ping_interval=None,
        additional_headers={"Authorization": f"Bearer {token}"},
    ) as socket:
        [welcome] = await ask_raw(socket, messages.Hello(capabilities=(UPDATES,)), messages.Welcome)
        assert welcome.robot == "v"
        for kind, send in SENT_BY_WATCHER.items():
            await send(socket, server)
            assert lease.read_bytes() == before, f"{kind.__name__} starts an owner"
    assert [path.parent.name for path in (tmp_path / "store/live").glob("*/*/lease")] == ["m"]

    async with robot(server, "r") as driver:
        await value(driver.subscribe("live/m"), "map", lambda payload: payload["owner"] != "")
    assert lease.read_bytes() != before, "an owner that starts is seen"
