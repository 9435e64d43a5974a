"""Tests of `ros_bridge.map_services` with a robot and a data service that answer by themselves."""

from __future__ import annotations

import asyncio
import json
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from client_sdk.live import LiveMapper
from ros_bridge import BridgeOptions, map_services
from ros_bridge.map_services import MapServices, as_json
from rse_pf.errors import NotFound, UsageError
from rse_pf.geometry import Camera

CAMERA = Camera(fx=500.0, fy=500.0, cx=160.0, cy=120.0, width=320, height=240)
FEATURES = SimpleNamespace(pixels=np.zeros((3, 2)), descriptors=np.arange(96, dtype=np.uint8).reshape(3, 32))


class Data:
    """A data service with one map, whose head a test moves."""

    def __init__(self) -> None:
        self.head = "v1"
        self.downloads: list[str] = []
        self.updated: list[tuple[str, bytes]] = []

    def maps(self) -> dict[str, str]:
        return {"hall": self.head}

    def download_map(self, name: str, version: str) -> bytes:
        self.downloads.append(version)
        return f"{name} {version}".encode()

    def upload(self, data: bytes) -> str:
        return f"digest of {data.decode()}"

    def update_map(self, name: str, data: bytes, *, note: str) -> str:
        self.updated.append((name, data))
        return "v2"


class CallRecorder:
    """A robot whose calls are kept."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, Any]] = []

    async def call(self, service: str, request: Any, **_: Any) -> Any:
        self.calls.append((service, request))
        return SimpleNamespace(reply={"verdict": "ok", "T_map_camera": np.eye(4)})


def services(
    mapper: Any, monkeypatch: pytest.MonkeyPatch, **options: str
) -> tuple[MapServices, CallRecorder, Data]:
    robot, data = CallRecorder(), Data()
    monkeypatch.setattr(map_services, "data_client", lambda _: data)
    return MapServices(robot, mapper, BridgeOptions.of(options)), robot, data  # type: ignore[arg-type]


def own_mapper() -> Any:
    return SimpleNamespace(features=FEATURES, encoded_map=lambda: b"own map")


def test_a_place_is_sought_in_the_head_which_is_fetched_once(monkeypatch: pytest.MonkeyPatch) -> None:
    maps, robot, data = services(own_mapper(), monkeypatch, localise_in="hall")

    for head in ("v1", "v1", "v2"):
        data.head = head
        reply = asyncio.run(maps.localise(CAMERA))

    assert json.loads(as_json(reply))["T_map_camera"] == np.eye(4).tolist()
    assert data.downloads == ["v1", "v2"]
    objects = [request["map"]["object"] for _, request in robot.calls]
    assert objects == ["digest of hall v1", "digest of hall v1", "digest of hall v2"]
    service, request = robot.calls[-1]
    assert (service, request["camera"]) == ("localise", CAMERA)
    assert request["descriptors"] == bytes(range(96))
    assert request["pixels"].shape == (3, 2)


@pytest.mark.parametrize(
    ("options", "features", "camera", "error"),
    [
        ({}, FEATURES, CAMERA, UsageError),
        ({"localise_in": "hall"}, None, CAMERA, UsageError),
        ({"localise_in": "hall"}, FEATURES, None, UsageError),
        ({"localise_in": "attic"}, FEATURES, CAMERA, NotFound),
    ],
    ids=["no map named", "no pose yet", "no image yet", "no such map"],
)
def test_what_cannot_be_asked_is_said(
    monkeypatch: pytest.MonkeyPatch,
    options: dict[str, str],
    features: Any,
    camera: Any,
    error: type[Exception],
) -> None:
    maps, robot, _ = services(SimpleNamespace(features=features), monkeypatch, **options)

    with pytest.raises(error) as raised:
        asyncio.run(maps.localise(camera))
    assert raised.value.hint  # type: ignore[attr-defined]
    assert robot.calls == []


def test_a_map_of_its_own_is_published_under_its_name_or_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    maps, robot, data = services(own_mapper(), monkeypatch, publish_as="hall")

    assert asyncio.run(maps.publish()) == {"map": "hall", "version": "v2"}
    assert data.updated == [("hall", b"own map")]
    assert robot.calls == []
    unnamed, _, untouched = services(own_mapper(), monkeypatch)
    with pytest.raises(UsageError, match="no name"):
        asyncio.run(unnamed.publish())
    assert untouched.updated == []


def test_a_live_map_is_published_and_asked_for_the_place_by_its_owner(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[str] = []

    class Live(LiveMapper):
        name, aligned, reason = "hall", False, "no keyframe matched"  # type: ignore[assignment]

        def __init__(self) -> None:
            pass

        def relocalise(self) -> None:
            asked.append("relocalise")

    maps, robot, data = services(Live(), monkeypatch)

    asyncio.run(maps.publish())
    told = asyncio.run(maps.relocalise())

    assert [(service, request.map) for service, request in robot.calls] == [("live-publish", "hall")]
    assert asked == ["relocalise"]
    assert told == {"map": "hall", "aligned": False, "reason": "no keyframe matched"}
    assert data.updated == []
