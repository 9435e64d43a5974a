"""A real robot of ROS 2: a node that plays a bag, the bridge, and a node that hears its topics."""

from __future__ import annotations

import asyncio
import json
import math
from pathlib import Path

import numpy as np
import pytest

from client_sdk.trajectory import read_trajectory
from rse_pf.config import PlatformSettings
from rse_pf.local.control.platform import LocalPlatform
from tests.kit.recorded_bags import write_recording
from tests.kit.ros2 import COLOUR, Ros2, all_is_played
from tests.kit.ros_programs import own_run, poses, tell_delay, worst_mm

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]

_FRAMES = 60


@pytest.fixture(scope="module")
def bag(recordings: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bag") / "kitchen"
    write_recording(recordings / "7scenes_redkitchen", path, "mcap", is_raw=True, frames=_FRAMES)
    return path


async def test_poses_equal_those_of_the_sdk_and_survive_a_killed_server(
    ros2: Ros2, bag: Path, tmp_path: Path
) -> None:
    folder, token_file = tmp_path, tmp_path / "token"
    settings, state = PlatformSettings(), folder / "platform"
    async with LocalPlatform(settings, port=0, servers=2, state=state, data=True) as platform:
        token_file.write_text(platform.issue_token("ros-2"), encoding="ascii")
        expected = await own_run(bag, platform, out=folder / "own")
        assert len(expected) == _FRAMES

        bridge = await asyncio.to_thread(
            ros2.bridge, platform.url, token_file, out=str(folder / "saved"), publish_as="kitchen",
            localise_in="kitchen",
        )  # fmt: skip
        listener = await asyncio.to_thread(ros2.listener, "", COLOUR)
        player = ros2.play(bag)
        await asyncio.to_thread(listener.until, poses(_FRAMES // 2))
        pages = {each.name: await platform.backend_servers.status(each) for each in platform.servers}
        (busy,) = (name for name, page in pages.items() if page is not None and page["robots"])
        platform.kill(busy)
        await asyncio.to_thread(listener.until, poses(_FRAMES))
        await asyncio.to_thread(player.until, all_is_played)

        heard = listener.heard("pose")
        assert worst_mm(heard, expected) <= 1.0
        assert {line["frame"] for line in heard} == {"map"}
        assert {(line["frame"], line["child"]) for line in listener.heard("tf")} >= {("map", "odom")}
        assert listener.heard("path")
        assert listener.heard("cloud")
        tell_delay(listener)
        services = [f"/rse_pf_bridge/{name}" for name in ("save", "publish", "localise", "relocalise")]
        asked = await asyncio.to_thread(ros2.listener, "", COLOUR, *services)
        assert asked.heard("save")[0]["ok"]
        assert asked.heard("publish")[0]["ok"], asked.heard("publish")
        place = json.loads(asked.heard("localise")[0]["message"])
        assert place["verdict"] == "ok", place
        last = max(heard, key=lambda line: line["stamp"])["position"]
        assert math.dist(np.reshape(place["T_map_camera"], (4, 4))[:3, 3], last) < 0.05
        assert "set the parameter map" in asked.heard("relocalise")[0]["message"]
        own, saved = (
            json.loads((folder / name / "report.json").read_text(encoding="utf-8"))
            for name in ("own", "saved")
        )
        assert saved["map_points"] == pytest.approx(own["map_points"], rel=0.01)
        assert len(read_trajectory(folder / "saved" / "trajectory.txt")) == _FRAMES
        assert await asyncio.to_thread(bridge.end) == 0
        assert bridge.lines[-1] == f"{_FRAMES} frames, 0 lost\n"


async def test_two_robots_share_a_live_map_lose_nothing_by_a_killed_server_and_get_corrections_as_transforms(
    ros2: Ros2, bag: Path, tmp_path: Path
) -> None:
    names = ("robot1", "robot2")
    async with LocalPlatform(PlatformSettings(), port=0, servers=2, state=tmp_path / "platform") as platform:
        listeners = []
        for name in names:
            token_file = tmp_path / name
            token_file.write_text(platform.issue_token(name), encoding="ascii")
            await asyncio.to_thread(ros2.bridge, platform.url, token_file, namespace=name, map="hall")
            listeners.append(await asyncio.to_thread(ros2.listener, f"/{name}", COLOUR))
        player = ros2.play(bag, 0.5, robots=len(names))
        await asyncio.to_thread(listeners[0].until, poses(_FRAMES // 2, "odometry"))
        pages = {each.name: await platform.backend_servers.status(each) for each in platform.servers}
        platform.kill(max(pages, key=lambda name: (pages[name] or {}).get("robots", 0)))
        for listener in listeners:
            await asyncio.to_thread(listener.until, poses(_FRAMES, "odometry"))
            assert len({line["stamp"] for line in listener.heard("odometry")}) == _FRAMES
            assert {line["frame"] for line in listener.heard("pose")} == {"map"}
        asked = await asyncio.to_thread(
            ros2.listener,
            "/robot1",
            COLOUR,
            *(f"/robot1/rse_pf_bridge/{name}" for name in ("relocalise", "publish")),
        )
        assert json.loads(asked.heard("relocalise")[0]["message"])["aligned"]
        assert asked.heard("publish")[0]["ok"], asked.heard("publish")
        await asyncio.to_thread(player.end)
        for name, listener in zip(names, listeners, strict=True):
            assert ("map", f"{name}/odom") in {
                (line["frame"], line["child"]) for line in listener.heard("tf")
            }
        first, second = (
            {line["stamp"]: line["position"] for line in listener.heard("pose")} for listener in listeners
        )
        last = max(first.keys() & second.keys())
        assert math.dist(first[last], second[last]) < 0.05
