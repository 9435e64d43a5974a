"""What the page makes of the control plane's words, of live maps and of recordings."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rse_pf.auth.roster import check_scopes, scopes_allow
from rse_pf.config import PlatformSettings
from rse_pf.errors import RsePfError
from rse_pf.extensions.fleet_page import clouds
from rse_pf.extensions.fleet_page.feeds.live_feed import SCOPES, histories
from rse_pf.extensions.fleet_page.feeds.platform_feed import (
    LocalFeed,
    fleet_document,
)
from rse_pf.extensions.fleet_page.hub import Hub
from rse_pf.geometry import Camera
from rse_pf.maps.format import Keyframe, MapVersion, encode_map
from rse_pf.maps.registry import MapRegistry
from rse_pf.processes.limited import LimitedProcesses
from rse_pf.storage.object_store import DirectoryStore


def test_every_text_of_the_fleet_is_escaped() -> None:
    state = {
        "platform": "p\x1b", "url": "ws://h", "sample": None,
        "servers": [{"name": "<b>\u202e", "state": "healthy", "cpu_percent": 5}],
        "policy": {"elastic": True, "last_action": {"reason": "a\nb"}},
    }  # fmt: skip

    reported = fleet_document(state, PlatformSettings(), time_s=1.0)

    assert reported["platform"] == r"p\x1b"
    assert reported["servers"][0]["name"] == r"<b>\u202e"
    assert reported["last_action"] == r"a\nb"
    assert json.loads(json.dumps(reported)) == reported


def test_the_path_of_a_robot_has_a_part_for_each_segment_and_no_line_break_in_its_name() -> None:
    points = np.array([[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]])
    paths = [
        {"robot": "a\n", "points": points},
        {"robot": "b", "points": points[:1]},
        {"robot": "a\n", "points": points[:1]},
    ]

    reported = histories(paths)

    assert reported[r"a\n"] == {
        "kind": "history",
        "robot": r"a\n",
        "parts": [points.tolist(), points[:1].tolist()],
    }
    assert reported["b"]["parts"] == [points[:1].tolist()]


def test_answer_times_are_known_after_two_readings_that_nobody_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock, counts, hub = iter((10.0, 11.0, 16.0)), iter((100, 500, 2500)), Hub()
    feed = LocalFeed(hub, tmp_path, clock=lambda: next(clock))

    async def ask(target: str) -> tuple[list[str], list[bytes | None]]:
        row = 'rse_pf_duration_seconds_bucket{service="pnp",le="0.01"}'
        return ["server-1"], [f"{row} {next(counts)}\n".encode()]

    monkeypatch.setattr(feed, "_ask_servers", ask)
    reported = []
    for _ in range(3):
        asyncio.run(feed._read_metrics())
        reported.append((feed._percentiles["count"], feed._percentiles["covered_s"]))

    assert hub.pages == 0
    assert reported == [(0, 0.0), (400, 1.0), (2400, 6.0)]


def test_a_map_is_packed_within_a_fraction_of_a_millimetre_and_its_first_points_are_a_sample(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(clouds, "BLOCK_POINTS", 400)
    camera = Camera(fx=500.0, fy=500.0, cx=320.0, cy=240.0, width=640, height=480)
    keyframe = Keyframe(
        id=0, robot="a\x1b", timestamp_s=0.0, T_world_camera=np.eye(4), camera=camera,
        pixels=np.zeros((1, 2), np.float32), descriptors=np.zeros((1, 32), np.uint8),
        points_camera=np.ones((1, 3), np.float32),
    )  # fmt: skip
    points = np.random.default_rng(1).uniform(-5, 5, (1000, 3)).astype(np.float32)
    points[:, 0] = np.linspace(-5, 5, 1000)
    colours = np.repeat(np.arange(1000) // 4, 3).reshape(-1, 3).astype(np.uint8)

    data = clouds.packer("")(encode_map(MapVersion(keyframes=(keyframe,), points=points, colours=colours)))

    length = int.from_bytes(data[:4], "little")
    reported = json.loads(data[4 : 4 + length])
    blocks, at = [], 4 + length
    for count in (400, 400, 200):
        numbers = np.frombuffer(data, "<u2", 3 * count, at).reshape(-1, 3)
        shades = np.frombuffer(data, "u1", 3 * count, at + 6 * count).reshape(-1, 3)
        blocks.append((np.array(reported["low"]) + numbers * np.array(reported["step"]), shades))
        at += 9 * count
    back, shades = (np.concatenate(each) for each in zip(*blocks, strict=True))
    order = np.argsort(back[:, 0])
    assert (reported["points"], reported["block"], at) == (1000, 400, len(data))
    assert np.abs(back[order] - points).max() < 2e-4
    assert np.abs(shades[order].astype(int) - colours).max() <= 1
    assert np.abs(np.quantile(blocks[0][0][:, 0], [0.25, 0.5, 0.75]) - [-2.5, 0.0, 2.5]).max() < 0.6
    assert reported["robots"] == {r"a\x1b": [[0.0, 0.0, 0.0]]}


async def test_the_cloud_that_a_page_shows_first_is_packed_once_and_before_it_is_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    registry = MapRegistry(DirectoryStore(tmp_path / "objects"))
    version = MapVersion(keyframes=(), points=np.ones((3, 3), np.float32), colours=np.ones((3, 3), np.uint8))
    record = registry.commit("hall", encode_map(version), parent=None, author="r", created_s=1.0)
    packed: list[int] = []

    def call(self: Any, data: bytes, timeout_s: float) -> bytes:
        packed.append(len(data))
        return clouds.packer("")(data)

    monkeypatch.setattr(LimitedProcesses, "call", call)
    pages = clouds.MapPages(tmp_path)

    assert json.loads((await pages.maps())[1])[0]["map"] == "hall"
    while not packed:
        await asyncio.sleep(0)
    head = (await pages.cloud({"map": "hall", "version": ""}))[1]
    head, same = head, (await pages.cloud({"map": "hall", "version": record.id}))[1]

    assert head == same
    assert len(packed) == 1


async def test_versions_of_all_tenants_are_listed_and_read_under_the_name_of_their_tenant(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = DirectoryStore(tmp_path / "objects")
    version = MapVersion(keyframes=(), points=np.ones((3, 3), np.float32), colours=np.ones((3, 3), np.uint8))
    for tenant, name in (("default", "hall"), ("acme", "hall"), ("acme", "yard")):
        MapRegistry(store, tenant).commit(name, encode_map(version), parent=None, author="r", created_s=1.0)
    monkeypatch.setattr(LimitedProcesses, "call", lambda self, data, timeout_s: clouds.packer("")(data))
    pages = clouds.MapPages(tmp_path)

    assert [each["map"] for each in json.loads((await pages.maps())[1])] == ["hall", "acme/hall", "acme/yard"]
    assert (await pages.cloud({"map": "acme/yard"}))[1]
    for label in ("yard", "other/hall", "acme/../hall"):
        with pytest.raises(RsePfError):
            await pages.cloud({"map": label})


def test_the_page_may_read_every_live_map_and_do_nothing_else() -> None:
    scopes = check_scopes(SCOPES)

    assert scopes_allow(scopes, "maps:live", "warehouse")
    assert not scopes_allow(scopes, "maps:write", "warehouse")
    assert not scopes_allow(scopes, "services:pnp")
