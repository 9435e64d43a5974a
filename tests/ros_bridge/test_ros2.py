"""A real robot of ROS 2: a node that plays a bag, the bridge, and a node that hears its topics."""

from __future__ import annotations

import asyncio
import json
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from benchmarks.maps.bags import write_recording
from rse_pf.config import PlatformSettings
from rse_pf.local.control.platform import LocalPlatform
from tests.ros_bridge.programs import Program, RosPrograms, own_run, poses, tell_delay, worst_mm

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]

_ROOT = Path(__file__).parents[2]
_ROS2 = _ROOT / "build" / "ros2"
_PROFILE = _ROOT / "ros_bridge/packages/rse_pf_bridge/config/fastdds.xml"
_CYCLONE = (
    '<CycloneDDS><Domain><General><Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces>'
    "<AllowMulticast>false</AllowMulticast></General><Internal>"
    '<SocketReceiveBufferSize min="4MB"/></Internal><Discovery><ParticipantIndex>auto</ParticipantIndex>'
    '<MaxAutoParticipantIndex>20</MaxAutoParticipantIndex><Peers><Peer address="127.0.0.1"/></Peers>'
    "</Discovery></Domain></CycloneDDS>"
)
"""Cyclone DDS on this machine alone, as ROS_AUTOMATIC_DISCOVERY_RANGE makes Fast DDS."""
_FRAMES = 60
_DOMAIN = 86
_COLOUR = "/camera/image_raw"
_TOPICS = {"colour": _COLOUR, "depth": "/camera/aligned_depth", "info": "/camera/camera_info"}


class Ros2(RosPrograms):
    """Programs of one domain of ROS 2 on this machine."""

    shell = "ros2"
    listener_file = "ros2_listener.py"

    def __init__(self, folder: Path) -> None:
        env = {
            "ROS_DOMAIN_ID": str(_DOMAIN), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "FASTDDS_DEFAULT_PROFILES_FILE": str(_PROFILE), "CYCLONEDDS_URI": _CYCLONE,
            "ROS_HOME": str(folder), "PYTHONUNBUFFERED": "1",
        }  # fmt: skip
        super().__init__(str(_ROS2 / "bin" / "python"), _TOPICS, env)

    def play(self, bag: Path, rate: float = 1.0, robots: int = 1) -> Program:
        """Play when each robot's bridge takes each topic, and its listener the colours."""
        wanted = [f"{topic}={robots * (2 if topic == _COLOUR else 1)}" for topic in _TOPICS.values()]
        words = ["--rate", str(rate), "--wait", *wanted]
        return self.start(self.python, str(_ROOT / "examples/robots/ros2_play_bag.py"), str(bag), *words)


def _all_is_played(lines: list[str]) -> bool:
    return bool(lines) and lines[-1].endswith("messages played\n")


@pytest.fixture
def ros2(tmp_path: Path) -> Iterator[Ros2]:
    if not (_ROS2 / "installed").exists():
        pytest.skip("no ROS 2 in build/ros2: make ros")
    world = Ros2(tmp_path / "ros")
    yield world
    world.end()


@pytest.fixture(scope="module")
def bag(recordings: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bag") / "kitchen"
    write_recording(recordings / "7scenes_redkitchen", path, "mcap", is_raw=True, frames=_FRAMES)
    return path


def test_poses_equal_those_of_the_sdk_and_survive_a_killed_server(
    ros2: Ros2, bag: Path, tmp_path: Path
) -> None:
    asyncio.run(_drive(ros2, bag, tmp_path))


async def _drive(ros2: Ros2, bag: Path, folder: Path) -> None:
    token_file = folder / "token"
    settings, state = PlatformSettings(), folder / "platform"
    async with LocalPlatform(settings, port=0, servers=2, state=state, data=True) as platform:
        token_file.write_text(platform.issue_token("ros-2"), encoding="ascii")
        expected = await own_run(bag, platform)
        assert len(expected) == _FRAMES

        bridge = await asyncio.to_thread(
            ros2.bridge, platform.url, token_file, out=str(folder / "saved"), publish_as="kitchen",
            localise_in="kitchen",
        )  # fmt: skip
        listener = await asyncio.to_thread(ros2.listener, "", _COLOUR)
        player = ros2.play(bag)
        await asyncio.to_thread(listener.until, poses(_FRAMES // 2))
        pages = {each.name: await platform.backend_servers.status(each) for each in platform.servers}
        (busy,) = (name for name, page in pages.items() if page is not None and page["robots"])
        platform.kill(busy)
        await asyncio.to_thread(listener.until, poses(_FRAMES))
        await asyncio.to_thread(player.until, _all_is_played)

        heard = listener.heard("pose")
        assert worst_mm(heard, expected) <= 1.0
        assert {line["frame"] for line in heard} == {"map"}
        assert {(line["frame"], line["child"]) for line in listener.heard("tf")} >= {("map", "odom")}
        assert listener.heard("path")
        assert listener.heard("cloud")
        tell_delay(listener)
        services = [f"/rse_pf_bridge/{name}" for name in ("save", "publish", "localise", "relocalise")]
        asked = await asyncio.to_thread(ros2.listener, "", _COLOUR, *services)
        assert asked.heard("save")[0]["ok"]
        assert asked.heard("publish")[0]["ok"], asked.heard("publish")
        place = json.loads(asked.heard("localise")[0]["message"])
        assert place["verdict"] == "ok", place
        last = max(heard, key=lambda line: line["stamp"])["position"]
        assert math.dist(np.reshape(place["T_map_camera"], (4, 4))[:3, 3], last) < 0.05
        assert "set the parameter map" in asked.heard("relocalise")[0]["message"]
        assert (folder / "saved" / "trajectory.txt").exists()
        assert await asyncio.to_thread(bridge.end) == 0
        assert bridge.lines[-1] == f"{_FRAMES} frames, 0 lost\n"


def test_two_robots_share_a_live_map_and_get_corrections_as_transforms(
    ros2: Ros2, bag: Path, tmp_path: Path
) -> None:
    asyncio.run(_share(ros2, bag, tmp_path))


async def _share(ros2: Ros2, bag: Path, folder: Path) -> None:
    names = ("robot1", "robot2")
    async with LocalPlatform(PlatformSettings(), port=0, servers=2, state=folder / "platform") as platform:
        listeners = []
        for name in names:
            token_file = folder / name
            token_file.write_text(platform.issue_token(name), encoding="ascii")
            await asyncio.to_thread(ros2.bridge, platform.url, token_file, namespace=name, map="hall")
            listeners.append(await asyncio.to_thread(ros2.listener, f"/{name}", _COLOUR))
        player = ros2.play(bag, 0.5, robots=len(names))
        for listener in listeners:
            await asyncio.to_thread(listener.until, poses(_FRAMES))
        asked = await asyncio.to_thread(
            ros2.listener,
            "/robot1",
            _COLOUR,
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
            {line["stamp"]: line["position"] for line in listener.heard("pose") if line["frame"] == "map"}
            for listener in listeners
        )
        last = max(first.keys() & second.keys())
        assert math.dist(first[last], second[last]) < 0.05


def test_the_shell_of_dds_takes_images_of_a_node_of_ros2(ros2: Ros2, bag: Path, tmp_path: Path) -> None:
    """Cyclone DDS hears Fast DDS, and is heard by it."""
    pytest.importorskip("cyclonedds", reason="cyclonedds is not installed: make ros")
    asyncio.run(_drive_over_dds(ros2, bag, tmp_path))


async def _drive_over_dds(ros2: Ros2, bag: Path, folder: Path) -> None:
    token_file = folder / "token"
    async with LocalPlatform(PlatformSettings(), port=0, servers=1, state=folder / "platform") as platform:
        token_file.write_text(platform.issue_token("dds-2"), encoding="ascii")
        expected = await own_run(bag, platform)
        bridge = await asyncio.to_thread(
            ros2.bridge, platform.url, token_file, "dds", dds_domain=str(_DOMAIN)
        )
        listener = await asyncio.to_thread(ros2.listener, "", _COLOUR)
        player = ros2.play(bag, 0.25)
        await asyncio.to_thread(listener.until, poses(_FRAMES))
        await asyncio.to_thread(player.end)
        assert worst_mm(listener.heard("pose"), expected) <= 1.0
        assert await asyncio.to_thread(bridge.end) == 0
