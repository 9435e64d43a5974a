"""A live map through a real server with two workers and a real owner process: rights, tenants, updates."""

from __future__ import annotations

import asyncio
import random
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from guarded_server import KEY, GuardedServer

import client_sdk
from rse_pf.auth.roster import scopes_allow
from rse_pf.backend.live_map.router import LIVE_SERVICES
from rse_pf.data_server.routes import ROUTES
from rse_pf.errors import Forbidden
from rse_pf.geometry import Camera
from rse_pf.services.builtin import builtin_services
from rse_pf.slam.keyframe import Keyframe, encode_keyframe, make_features
from tests.slam.v1_features import features_v1

pytestmark = [pytest.mark.slow, pytest.mark.system]

CAMERA = {"fx": 525.0, "fy": 525.0, "cx": 319.5, "cy": 239.5, "width": 640, "height": 480}


def keyframe(number: int) -> dict[str, Any]:
    """Return a keyframe as robots of protocol version 1 send it, each second one in today's form."""
    noise = np.random.default_rng(number)
    seen = (
        noise.uniform(10, 400, (300, 2)), np.full(300, 2.0), noise.integers(0, 255, (300, 32), dtype=np.uint8)
    )  # fmt: skip
    begin = {"map": "m", "segment": 0, "number": number}
    if number % 2:
        made = Keyframe(
            timestamp_s=float(number), T_odom_camera=np.eye(4), camera=Camera(**CAMERA),
            features=make_features(*seen),
        )  # fmt: skip
        return {**begin, "keyframe": encode_keyframe(made)}
    return {
        **begin, "timestamp_s": float(number), "T_odom_camera": np.eye(4).ravel().tolist(), "camera": CAMERA,
        "features": features_v1(*seen),
    }  # fmt: skip


def robot(server: GuardedServer, name: str, **claims: Any) -> client_sdk.Robot:
    token = KEY.issue(name, now=time.time(), token_id=name, settings=server.settings.auth, **claims)
    return client_sdk.connect(server.url, token=token, codec="bin", random=random.Random(name))


async def value(updates: client_sdk.Updates, key: str, fits: Callable[[Any], bool]) -> Any:
    """Return the first value of *key* that *fits*."""
    while True:
        found, payload = await updates.next()
        if found == key and fits(payload):
            return payload


def run(folder: Path, test: Callable[[GuardedServer], Awaitable[None]]) -> None:
    (folder / "store").mkdir()
    with GuardedServer(folder, workers=2, data={"store": f"dir:{folder / 'store'}"}) as server:
        asyncio.run(asyncio.wait_for(test(server), 60.0))  # type: ignore[arg-type]


def test_robots_of_all_workers_see_the_map_of_their_tenant_and_no_other(tmp_path: Path) -> None:
    async def test(server: GuardedServer) -> None:
        async with (
            robot(server, "sender") as sender,
            robot(server, "a") as a, robot(server, "b") as b, robot(server, "c") as c,
            robot(server, "d") as d, robot(server, "stranger", tenant="other") as stranger,
        ):  # fmt: skip
            readers = [each.subscribe("live/m") for each in (a, b, c, d)]
            foreign = stranger.subscribe("live/m")

            for number in range(3):
                answer = await sender.call("live-keyframe", keyframe(number), deadline_s=20.0)
                assert answer.reply["number"] == number + 1

            for updates in readers:
                pose = await value(updates, "pose/sender", lambda pose: pose["timestamp_s"] == 2.0)
                np.testing.assert_allclose(pose["T_map_camera"], np.eye(4).ravel())
            assert [each["name"] for each in (await a.call("live-list", {})).reply["maps"]] == ["m"]
            assert (await stranger.call("live-list", {})).reply["maps"] == []
            assert (await stranger.call("live-show", {"map": "m"})).reply["keyframes"] == 0
            assert await foreign.next() == (
                "map", {"kind": "map", "keyframes": 0, "version": 0, "owner": "", "state": "moving"},
            )  # fmt: skip
            with pytest.raises(asyncio.TimeoutError):
                await asyncio.wait_for(foreign.next(), 0.5)

    run(tmp_path, test)


def test_a_token_for_another_map_neither_reads_nor_writes(tmp_path: Path) -> None:
    async def test(server: GuardedServer) -> None:
        async with robot(server, "r", scopes=("maps:live/other",)) as a_robot:
            with pytest.raises(Forbidden, match="maps:live/m"):
                await a_robot.subscribe("live/m").next()
            with pytest.raises(Forbidden, match="maps:live/m"):
                await a_robot.call("live-keyframe", keyframe(0))
            assert (await a_robot.subscribe("live/other").next())[0] == "map"

    run(tmp_path, test)


def test_a_token_to_watch_a_map_allows_to_subscribe_to_it_and_nothing_else(tmp_path: Path) -> None:
    async def test(server: GuardedServer) -> None:
        store = tmp_path / "store"
        async with robot(server, "v", scopes=("maps:watch/m",)) as viewer, robot(server, "r") as driver:
            updates = viewer.subscribe("live/m")
            assert (await updates.next())[0] == "map"
            for service in sorted(
                {*LIVE_SERVICES, *(each.name for each in builtin_services(server.settings))}
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
            route.operation
            for route in ROUTES
            if route.scope and scopes_allow(("maps:watch/m",), route.scope)
        ] == []
        assert not any(scopes_allow(("maps:watch",), right) for right in ("topics:read", "topics:write"))

    run(tmp_path, test)
