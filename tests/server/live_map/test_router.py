"""Commands to live maps: scopes, sizes, formats and answers, and what waits."""

from __future__ import annotations

import asyncio
import struct
import time
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from typing import Any

import numpy as np
import pytest

from rse_pf.auth.tokens import Claims
from rse_pf.config import PlatformSettings
from rse_pf.errors import (
    Busy,
)
from rse_pf.geometry import Camera
from rse_pf.identity import RobotId
from rse_pf.server.live_map.router import LiveMapRouter
from rse_pf.server.scheduling.command_queue import QueuedCommand
from rse_pf.server.worker_context import Clocks, WorkerContext
from rse_pf.slam.keyframe import MAX_KEYFRAME_BYTES, SentKeyframe, encode_keyframe, make_features
from rse_pf.wire import Command, Failure, Result, Update
from tests.kit.fake_map_client import FakeLiveMapClient, FakeReader
from tests.kit.worker_parts import quiet_log

CAMERA = {"fx": 525.0, "fy": 525.0, "cx": 319.5, "cy": 239.5, "width": 640, "height": 480}
POSE = [1, 0, 0, 0.5, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]


SEEN = np.full((300, 2), 7.5), np.full(300, 2.0), np.arange(9600, dtype=np.uint8).reshape(300, 32)
KEYFRAME = encode_keyframe(
    SentKeyframe(
        timestamp_s=1.5,
        T_odom_camera=np.array(POSE, dtype=float).reshape(4, 4),
        camera=Camera(**CAMERA),
        features=make_features(*SEEN),
    )
)


def keyframe(number: int = 0, **changes: Any) -> dict[str, Any]:
    """Return the request of a keyframe."""
    return {"map": "m", "segment": 0, "number": number, "keyframe": KEYFRAME, **changes}


def claims(*scopes: str, tenant: str = "default") -> Claims:
    return Claims(
        robot=RobotId(tenant, "r"), token_id="t", issued_s=0.0, expires_s=1e9, key_id="k", scopes=scopes
    )


class Parts:
    """A router in the running event loop; its clock moves only when a test says so."""

    def __init__(self, context: WorkerContext) -> None:
        self.context = context
        self.answers: list[Result | Failure] = []
        self.router = LiveMapRouter(
            context,
            make_client=self._make_client,
            answer=lambda queued, message: self.answers.append(message),
        )

    def _make_client(self, on_update: Any) -> FakeLiveMapClient:
        self.client = FakeLiveMapClient(on_update)
        return self.client

    def submit(
        self,
        service: str,
        payload: Any,
        *,
        connection: FakeReader | None = None,
        allowed_s: float = 5.0,
        size_bytes: int = 40_000,
    ) -> None:
        owner = connection or FakeReader()
        now = self.context.clocks.monotonic()
        command = Command(id=len(self.answers), service=service, payload=payload, trace="t")
        self.router.submit(QueuedCommand(owner, owner.robot, command, size_bytes, now, now + allowed_s), now)

    async def ask(self, service: str, payload: Any, **more: Any) -> Result | Failure:
        before = len(self.answers)
        self.submit(service, payload, **more)
        while len(self.answers) == before:
            await asyncio.sleep(0)
        return self.answers[-1]


def waiting(parts: Parts) -> int:
    """Return the number of commands of the robot *r* without an answer."""
    probe = QueuedCommand(None, RobotId("default", "r"), Command(id=0, service="live-show"), 0, 0.0, 1.0)
    return parts.router.backlog(probe).waiting


@asynccontextmanager
async def a_router(now: list[float] | None = None) -> AsyncIterator[Parts]:
    """Run a router; its clock shows ``now[0]``, or the real time."""
    monotonic = time.monotonic if now is None else lambda: now[0]
    with quiet_log() as log:
        context = WorkerContext(
            settings=PlatformSettings(),
            server_id="s-1",
            log=log,
            loop=asyncio.get_running_loop(),
            clocks=Clocks(monotonic=monotonic, wall=time.time, cpu=time.process_time),
        )
        parts = Parts(context)
        yield parts
        await asyncio.wait_for(parts.router.wait_closed(), 20.0)
        assert parts.client.closed


HEAD_BYTES = 108
FX_AT = HEAD_BYTES + 8 + 6
"""Where the keyframe holds the focal length fx: behind the head of block 1 and four numbers."""


def with_head(timestamp_s: float = 1.5, pose: Sequence[float] = POSE) -> bytes:
    """Return a keyframe whose head says what `encode_keyframe` may refuse to write."""
    return KEYFRAME[:4] + struct.pack("<13d", timestamp_s, *pose[:12]) + KEYFRAME[HEAD_BYTES:]


WRONG = [
    ({"map": "Kitchen"}, "bad-request"),
    ({"map": "../x"}, "bad-request"),
    ({"segment": -1}, "bad-request"),
    ({"number": 1.5}, "bad-request"),
    ({"keyframe": with_head(timestamp_s=float("nan"))}, "bad-request"),
    ({"keyframe": with_head(pose=[2 * value for value in POSE])}, "bad-request"),
    ({"keyframe": with_head(pose=[-1, *POSE[1:]])}, "bad-request"),
    ({"keyframe": with_head(pose=[float("inf"), *POSE[1:]])}, "bad-request"),
    ({"keyframe": with_head(pose=[*POSE[:3], 2e6, *POSE[4:]])}, "bad-request"),
    ({"keyframe": KEYFRAME[:FX_AT] + struct.pack("<d", -1.0) + KEYFRAME[FX_AT + 8 :]}, "invalid-camera"),
    ({"keyframe": 7}, "bad-request"),
    ({"keyframe": "no base64!"}, "bad-request"),
    ({"keyframe": KEYFRAME[:-1]}, "bad-request"),
    ({"keyframe": KEYFRAME + b"x"}, "bad-request"),
    ({"keyframe": b""}, "bad-request"),
    ({"keyframe": b"\x01" * 100}, "bad-request"),
    ({"keyframe": bytes(MAX_KEYFRAME_BYTES + 1)}, "too-large"),
    ({"keyframe": "AAAA" * (MAX_KEYFRAME_BYTES // 3 + 2)}, "too-large"),
]


@pytest.mark.parametrize(("changes", "code"), WRONG)
async def test_an_invalid_keyframe_is_refused_before_it_reaches_a_map_server(changes: Any, code: str) -> None:
    async with a_router() as parts:
        answer = await parts.ask("live-keyframe", keyframe(**changes))

        assert isinstance(answer, Failure)
        assert (answer.code, bool(answer.hint)) == (code, True), answer
        assert parts.client.asked == []


RIGHTS = [
    ("live-keyframe", ("maps:live/m",), True),
    ("live-keyframe", ("maps:live",), True),
    ("live-keyframe", ("maps:*",), True),
    ("live-keyframe", (), True),
    ("live-keyframe", ("maps:live/other",), False),
    ("live-keyframe", ("maps:write", "services:*"), False),
    ("live-show", ("maps:read",), False),
    ("live-forget", ("maps:live/m",), False),
    ("live-forget", ("maps:write/m",), True),
    ("live-stop", ("maps:live",), False),
    ("live-publish", ("maps:write",), True),
    ("live-start", ("maps:write/other",), False),
]


@pytest.mark.parametrize(("service", "scopes", "allowed"), RIGHTS)
async def test_the_scope_of_the_map_decides(service: str, scopes: tuple[str, ...], allowed: bool) -> None:
    async with a_router() as parts:
        connection = FakeReader()
        connection.claims = claims(*scopes)
        payload = {**keyframe(), "robot": "bob", "from": "m@ab12"}
        parts.client.answer = lambda operation, payload: {}

        answer = await parts.ask(service, payload, connection=connection)

        assert isinstance(answer, Result) is allowed
        assert len(parts.client.asked) == allowed
        assert allowed or (isinstance(answer, Failure) and answer.code == "forbidden")


@pytest.mark.parametrize(
    ("source", "scopes", "allowed"),
    [
        ("secret", ("maps:write/m",), False),
        ("secret@ab12cd", ("maps:write/m", "maps:live/secret"), False),
        ("secret", ("maps:write/m", "maps:read/secret"), True),
        ("secret@ab12cd", ("maps:write/m", "maps:read"), True),
        ("m@ab12cd", ("maps:write/m",), True),
        ("ab12cd", ("maps:write/m",), True),
        ("head", ("maps:write/m",), True),
        ("", ("maps:write/m",), True),
    ],
)
async def test_a_map_begins_with_another_one_for_who_may_read_that(
    source: str, scopes: tuple[str, ...], allowed: bool
) -> None:
    async with a_router() as parts:
        connection = FakeReader()
        connection.claims = claims(*scopes)
        parts.client.answer = lambda operation, payload: {}

        answer = await parts.ask("live-start", {"map": "m", "from": source}, connection=connection)

        assert isinstance(answer, Result) is allowed
        assert len(parts.client.asked) == allowed
        assert allowed or (isinstance(answer, Failure) and "maps:read/secret" in answer.message)


async def test_a_robot_lists_the_maps_of_its_tenant_that_it_may_enter() -> None:
    async with a_router() as parts:
        parts.client.maps = {"default": [{"name": "a"}, {"name": "b"}], "acme": [{"name": "secret"}]}
        connection = FakeReader()
        connection.claims = claims("maps:live/b")

        answer = await parts.ask("live-list", None, connection=connection)

        assert isinstance(answer, Result)
        assert answer.reply == {"maps": [{"name": "b"}]}


async def test_a_map_server_that_does_not_answer_is_given_up_at_the_deadline() -> None:
    async with a_router() as parts:
        parts.client.answer = lambda operation, payload: None

        answer = await parts.ask("live-show", {"map": "m"}, allowed_s=0.02)

        assert isinstance(answer, Failure)
        assert answer.code == "expired"
        assert (parts.router.held, waiting(parts)) == (1, 1)
        await asyncio.sleep(0)
        assert (parts.router.held, waiting(parts)) == (0, 0)


async def test_while_the_map_server_changes_a_robot_gets_the_time_to_ask_again() -> None:
    async with a_router() as parts:
        parts.client.answer = lambda *_: Busy("the owner changes", hint="wait", retry_after_ms=300.0)

        answer = await parts.ask("live-show", {"map": "m"})

        assert isinstance(answer, Failure)
        assert (answer.code, answer.retry_after_ms) == ("busy", 300.0)


async def test_a_defect_is_an_internal_failure_without_its_text() -> None:
    async with a_router() as parts:

        def broken(operation: str, payload: dict[str, Any]) -> dict[str, Any]:
            raise ZeroDivisionError("secret")

        parts.client.answer = broken

        answer = await parts.ask("live-show", {"map": "m"})

        assert isinstance(answer, Failure)
        assert answer.code == "internal"
        assert "secret" not in answer.message + answer.hint


async def test_more_bytes_than_one_worker_holds_are_busy() -> None:
    async with a_router() as parts:
        parts.client.answer = lambda operation, payload: None
        for tenant in "abcd":
            reader = FakeReader("r", tenant=tenant)
            parts.submit("live-show", {"map": "m"}, connection=reader, size_bytes=15 << 20)

        answer = await parts.ask("live-show", {"map": "m"}, size_bytes=15 << 20)

        assert isinstance(answer, Failure)
        assert answer.code == "busy"
        assert answer.retry_after_ms
        assert parts.router.held == 4


async def settled(reader: FakeReader, count: int) -> list[Update]:
    """Wait until *reader* has received *count* messages, and return them."""
    deadline = time.monotonic() + 10.0
    while len(reader.written) < count:
        assert time.monotonic() < deadline
        await asyncio.sleep(0.001)
    return reader.written


async def test_two_workers_tell_their_robots_the_same() -> None:
    async with a_router() as parts:
        other = Parts(parts.context)
        here, there = FakeReader("here", codec="bin"), FakeReader("there")
        parts.router.subscribe(here, 1, "live/m")
        other.router.subscribe(there, 2, "live/m")
        payload = {
            "kind": "alignment",
            "robot": "here",
            "aligned": True,
            "T_map_odom": np.eye(4).astype("<f8").tobytes(),
            "covariance": np.arange(21.0).tobytes(),
        }
        for worker in (parts, other):
            assert worker.client.watched == [("default", "m")]
            worker.client.on_update("default", "m", payload)
            worker.client.on_update("default", "m", {"kind": "map", "keyframes": 3})

        for reader in (here, there):
            updates = {update.key: update.payload for update in await settled(reader, 2)}
            assert updates.keys() == {"map", "alignment/here"}
            assert updates["map"] == {"kind": "map", "keyframes": 3}
            np.testing.assert_array_equal(updates["alignment/here"]["T_map_odom"], np.eye(4).ravel())
            np.testing.assert_array_equal(updates["alignment/here"]["covariance"], np.arange(21.0))
        assert parts.router.report().gauges["subscriptions"] == 1.0
        assert parts.router.report().gauges["updates"] == 2.0
        await other.router.wait_closed()


@pytest.mark.parametrize(
    ("topic", "scopes", "code"),
    [
        ("live/m", ("maps:live/other",), "forbidden"),
        ("live/m", ("maps:write",), "forbidden"),
        ("platform", (), "bad-request"),
        ("live/../m", (), "bad-request"),
    ],
)
async def test_a_subscription_that_is_not_allowed_is_refused_by_its_id(
    topic: str, scopes: tuple[str, ...], code: str
) -> None:
    async with a_router() as parts:
        reader = FakeReader()
        reader.claims = claims(*scopes)

        parts.router.subscribe(reader, 9, topic)

        [failure] = reader.written
        assert (failure.id, failure.code) == (9, code)
        assert parts.client.watched == []


async def test_a_right_that_a_fresh_token_does_not_give_ends_the_subscription() -> None:
    async with a_router() as parts:
        reader = FakeReader()
        reader.claims = claims("maps:live/m")
        parts.router.subscribe(reader, 9, "live/m")
        await settled(reader, 1)

        reader.claims = claims("maps:live/other")
        parts.client.on_update("default", "m", {"kind": "map", "keyframes": 1})

        failure: Any = (await settled(reader, 2))[1]
        assert (failure.id, failure.code) == (9, "forbidden")
        assert parts.client.unwatched == [("default", "m")]


async def test_a_token_to_watch_a_map_subscribes_to_it_and_starts_no_map_server() -> None:
    async with a_router() as parts:
        viewer, driver = FakeReader("viewer"), FakeReader("driver")
        viewer.claims = claims("maps:watch/m")
        driver.claims = claims("maps:live/m")
        parts.router.subscribe(viewer, 9, "live/m")
        assert parts.client.may_start == {("default", "m"): False}

        parts.router.subscribe(driver, 3, "live/m")
        assert parts.client.may_start == {("default", "m"): True}
        parts.router.leave(driver)
        assert parts.client.may_start == {("default", "m"): False}
        parts.client.on_update("default", "m", {"kind": "map", "keyframes": 1})

        [update] = [message for message in await settled(viewer, 1) if isinstance(message, Update)]
        assert update.payload["keyframes"] == 1
        parts.router.subscribe(viewer, 10, "live/other")
        failure: Any = viewer.written[-1]
        assert (failure.id, failure.code) == (10, "forbidden")
        parts.router.unsubscribe(viewer, 9)
        assert parts.client.unwatched == [("default", "m")]


async def test_a_driver_whose_fresh_token_only_allows_to_watch_goes_on_reading_and_starts_no_map_server() -> (
    None
):
    async with a_router() as parts:
        reader = FakeReader()
        reader.claims = claims("maps:live/m")
        parts.router.subscribe(reader, 9, "live/m")
        await settled(reader, 1)
        assert parts.client.may_start == {("default", "m"): True}

        reader.claims = claims("maps:watch/m")
        parts.client.on_update("default", "m", {"kind": "map", "keyframes": 1})

        assert isinstance((await settled(reader, 2))[1], Update)
        assert parts.client.may_start == {("default", "m"): False}


async def test_commands_that_wait_for_map_servers_are_bounded_for_each_tenant() -> None:
    async with a_router() as parts:
        parts.client.answer = lambda operation, payload: None
        hostile, good = FakeReader("r", tenant="acme"), FakeReader("r", tenant="rival")
        for _ in range(20):
            parts.submit("live-show", {"map": "m"}, connection=hostile, size_bytes=1 << 20)
        assert [answer.code for answer in parts.answers if isinstance(answer, Failure)] == ["busy"] * 4

        parts.submit("live-show", {"map": "m"}, connection=good, size_bytes=1 << 20)

        assert len(parts.answers) == 4
        assert parts.router.held == 17
