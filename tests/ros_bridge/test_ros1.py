"""A real robot of ROS 1: roscore, a bag that rosbag plays, the bridge, and a node that hears its topics."""

from __future__ import annotations

import asyncio
import json
import shutil
import signal
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from client_sdk.bags.message_types import load_types
from rse_pf.config import PlatformSettings
from rse_pf.local.control.platform import LocalPlatform
from tests.kit.recorded_bags import write_recording
from tests.kit.ros_programs import Line, Program, RosPrograms, own_run, poses, tell_delay, worst_mm

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]

_PYTHON = "/usr/bin/python3"
_DIST = Path("/usr/lib/python3/dist-packages")
_FRAMES = 60
_TOPICS = {"colour": "/camera/image_raw", "depth": "/camera/aligned_depth", "info": "/camera/camera_info"}
_NEEDED = ("rospy", "geometry_msgs", "nav_msgs", "sensor_msgs", "tf2_msgs", "diagnostic_msgs")


class Ros(RosPrograms):
    """A master on a free port, and programs that know it."""

    def __init__(self, folder: Path) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self._port = free.getsockname()[1]
        master = {"ROS_MASTER_URI": f"http://127.0.0.1:{self._port}", "ROS_IP": "127.0.0.1"}
        super().__init__(_PYTHON, _TOPICS, {**master, "ROS_HOME": str(folder)})

    def master(self) -> Program:
        # roscore would start this program in a group of its own, and leave it behind when it is killed.
        return self.start("rosmaster", "--core", "-p", str(self._port))

    def play(self, bag: Path, rate: float) -> Program:
        return self.start("rosbag", "play", "-q", "-d", "2", "-r", str(rate), str(bag))


@pytest.fixture
def ros(tmp_path: Path) -> Iterator[Ros]:
    missing = [each for each in _NEEDED if not (_DIST / each).is_dir()]
    missing += [each for each in ("rosmaster", "rosbag") if shutil.which(each) is None]
    if missing:
        pytest.skip(f"no ROS 1: {', '.join(missing)} (apt install ros-core python3-nav-msgs ...)")
    world = Ros(tmp_path / "ros")
    yield world
    world.end()


@pytest.fixture(scope="module")
def bag(recordings: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bag") / "kitchen.bag"
    write_recording(recordings / "7scenes_redkitchen", path, "ros1", is_raw=True, frames=_FRAMES)
    return path


def test_our_definitions_are_those_of_ros(ros: Ros) -> None:
    """The sum of a definition is what nodes of ROS 1 compare; Debian's packages are the reference."""
    types = load_types(is_ros1=True)
    wanted = [kind for kind in types.types if (_DIST / kind.partition("/")[0]).is_dir()]
    script = (
        "import importlib,json,sys;print(json.dumps({k:getattr(importlib.import_module("
        "k.split('/')[0]+'.msg'),k.split('/')[2])._md5sum for k in json.loads(sys.argv[1])}))"
    )
    words = [_PYTHON, "-c", script, json.dumps(wanted)]
    theirs = json.loads(subprocess.run(words, check=True, capture_output=True, text=True).stdout)
    assert {kind: types.generate_msgdef(kind, ros_version=1)[1] for kind in wanted} == theirs
    assert len(wanted) >= 20


async def test_poses_equal_those_of_the_sdk_and_survive_a_killed_server_and_a_killed_master(
    ros: Ros, bag: Path, tmp_path: Path
) -> None:
    token_file = tmp_path / "token"
    async with LocalPlatform(PlatformSettings(), port=0, servers=2, state=tmp_path / "platform") as platform:
        token_file.write_text(platform.issue_token("ros-1"), encoding="ascii")
        expected = await own_run(bag, platform)

        master = await asyncio.to_thread(ros.master)
        listener = await asyncio.to_thread(ros.listener, _TOPICS["colour"])
        bridge = await asyncio.to_thread(ros.bridge, platform.url, token_file)

        first = await _played(ros, bag, listener, _FRAMES)
        assert worst_mm(first, expected) <= 1.0
        assert {line["frame"] for line in first} == {"map"}
        assert {(line["frame"], line["child"]) for line in listener.heard("tf")} >= {("map", "odom")}
        assert listener.heard("path")
        assert listener.heard("cloud")
        tell_delay(listener)
        await asyncio.to_thread(bridge.end)
        assert bridge.lines[-1] == f"{_FRAMES} frames, 0 lost\n"

        bridge = await asyncio.to_thread(ros.bridge, platform.url, token_file)
        player = ros.play(bag, 0.5)
        await asyncio.to_thread(listener.until, poses(_FRAMES + 10))
        platform.kill(await _server_of_the_robot(platform))
        await asyncio.to_thread(listener.until, poses(_FRAMES + 20))
        master.end(signal.SIGKILL)
        await asyncio.to_thread(listener.until, poses(2 * _FRAMES))
        await asyncio.to_thread(player.end)
        second = listener.heard("pose")[_FRAMES:]
        assert worst_mm(second, expected) <= 1.0

        await asyncio.to_thread(ros.master)
        await asyncio.to_thread(bridge.until, lambda lines: any("registered again" in each for each in lines))
        late = await asyncio.to_thread(ros.listener, "")
        player = ros.play(bag, 0.5)
        await asyncio.to_thread(late.until, poses(1))
        await asyncio.to_thread(player.end)
        assert await asyncio.to_thread(bridge.end) == 0


async def _played(ros: Ros, bag: Path, listener: Program, count: int) -> list[Line]:
    player = ros.play(bag, 0.5)
    await asyncio.to_thread(listener.until, poses(count))
    await asyncio.to_thread(player.end)
    return listener.heard("pose")


async def _server_of_the_robot(platform: LocalPlatform) -> str:
    """Return the server that the one connected robot is on."""
    pages = {each.name: await platform.backend_servers.status(each) for each in platform.servers}
    (name,) = (name for name, page in pages.items() if page is not None and page["robots"])
    return name
