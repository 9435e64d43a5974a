"""Encodings, depth, a stereo pair and an IMU over a real ROS 2, rendered; parameters and Ctrl-C."""

from __future__ import annotations

import asyncio
import signal
from pathlib import Path

import pytest

from client_sdk.bags import BagOptions
from client_sdk.rigs.rig_file import read_rig
from ros_bridge import BridgeOptions
from rse_pf.config import PlatformSettings
from rse_pf.local.control.platform import LocalPlatform
from tests.kit.rendered_bags import ENCODINGS, STEREO, write_encodings, write_stereo
from tests.kit.ros2 import Ros2, all_is_played
from tests.kit.ros_programs import own_run, poses, worst_mm

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]

_FRAMES, _PAIRS = 10, 24


@pytest.fixture(scope="module")
def stereo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("stereo")
    write_stereo(folder / "pair", folder / "rig.json", _PAIRS)
    return folder / "pair"


async def test_raw_and_compressed_images_of_each_kind_give_the_poses_of_the_sdk(
    ros2: Ros2, tmp_path: Path
) -> None:
    """Colours as rgb8, JPEG and PNG; depth as 16UC1, compressedDepth and 32FC1."""
    bag = tmp_path / "encodings"
    write_encodings(bag, _FRAMES)
    async with LocalPlatform(PlatformSettings(), port=0, servers=1, state=tmp_path / "platform") as platform:
        listeners, wanted = {}, {"/camera/camera_info": len(ENCODINGS)}
        for name, (colour, depth) in ENCODINGS.items():
            token_file = tmp_path / name
            token_file.write_text(platform.issue_token(name), encoding="ascii")
            await asyncio.to_thread(
                ros2.bridge, platform.url, token_file, namespace=name, colour=colour, depth=depth
            )
            listeners[name] = await asyncio.to_thread(ros2.listener, f"/{name}", f"/{name}/nothing")
            wanted |= {colour: 1, depth: 1}
        player = ros2.play_for(bag, wanted, rate=0.5)
        for name, (colour, depth) in ENCODINGS.items():
            await asyncio.to_thread(listeners[name].until, poses(_FRAMES))
            expected = await own_run(bag, platform, BagOptions(colour=colour, depth=depth))
            assert worst_mm(listeners[name].heard("pose"), expected) <= 1.0, name
        await asyncio.to_thread(player.until, all_is_played)


@pytest.mark.parametrize("has_imu", [False, True], ids=["camera_info", "rig-and-imu"])
async def test_a_stereo_pair_gives_the_poses_of_the_sdk(
    ros2: Ros2, stereo: Path, tmp_path: Path, has_imu: bool
) -> None:
    """By the ``CameraInfo`` of both cameras; or by a rig, with ``sensor_msgs/Imu`` of 200 Hz."""
    token_file, rig_file = tmp_path / "token", stereo.with_name("rig.json")
    extra = {"imu": "/imu", "rig": str(rig_file), "base_frame": ""} if has_imu else {}
    options = BagOptions(
        colour=STEREO["colour"], right=STEREO["right"], use_stereo=True, use_imu=has_imu,
        rig=read_rig(rig_file) if has_imu else None,
    )  # fmt: skip
    async with LocalPlatform(PlatformSettings(), port=0, servers=1, state=tmp_path / "platform") as platform:
        token_file.write_text(platform.issue_token("pair"), encoding="ascii")
        expected = await own_run(stereo, platform, options)
        bridge = await asyncio.to_thread(ros2.bridge, platform.url, token_file, **STEREO, **extra)
        listener = await asyncio.to_thread(ros2.listener, "", "/nothing")
        taken = [topic for topic in [*STEREO.values(), extra.get("imu", "")] if topic]
        player = ros2.play_for(stereo, dict.fromkeys(taken, 1), rate=0.5)
        await asyncio.to_thread(listener.until, poses(len(expected)))
        await asyncio.to_thread(player.until, all_is_played)

        assert len(expected) == _PAIRS
        assert worst_mm(listener.heard("pose"), expected) <= 1.0
        assert {(line["frame"], line["child"]) for line in listener.heard("odometry")} == {("odom", "eye")}
        moved = {(line["frame"], line["child"]) for line in listener.heard("tf")}
        assert (("eye", "imu_link") in moved) == has_imu
        assert await asyncio.to_thread(bridge.end, signal.SIGTERM) == 0


async def test_options_are_parameters_and_ctrl_c_ends_with_0(ros2: Ros2, tmp_path: Path) -> None:
    token_file, words = tmp_path / "token", (ros2.python, "-m", "ros_bridge", "ros2")
    async with LocalPlatform(PlatformSettings(), port=0, servers=1, state=tmp_path / "platform") as platform:
        token_file.write_text(platform.issue_token("asked"), encoding="ascii")
        bridge = ros2.start(
            *words, "--url", platform.url, "--colour", "/eye/image", "--ros-args", "-r", "__ns:=/robot1",
            "-p", f"token_file:={token_file}", "-p", "queue_frames:=9", "-p", "colour:=/not/this",
        )  # fmt: skip
        await asyncio.to_thread(bridge.until, lambda lines: any(x.startswith("bridging") for x in lines))
        asks = ros2.start(
            ros2.python, str(Path(__file__).with_name("ros2_parameters.py")), "/robot1/rse_pf_bridge"
        )
        await asyncio.to_thread(asks.until, lambda lines: any('"parameters"' in x for x in lines))
        (told,) = asks.heard("parameters")
        values = told["values"]
        expected = BridgeOptions(
            url=platform.url,
            token_file=str(token_file),
            namespace="robot1",
            colour="/eye/image",
            queue_frames=9,
        )
        names = set(BridgeOptions.__slots__)
        assert {name: values[name] for name in names} == {name: getattr(expected, name) for name in names}
        assert all(told["described"][name] for name in names)
        assert not told["set"]
        assert bridge.lines == ["bridging /eye/image to /robot1/rse_pf/pose\n"]
        assert await asyncio.to_thread(bridge.end, signal.SIGINT) == 0
        assert bridge.lines[1:] == ["0 frames, 0 lost\n"]
    for wrong, said in (
        (("--ros-args", "-p", "colur:=/a"), "unknown parameter 'colur'"),
        (("--ros-args", "-p", "colour"), "ROS 2 refuses its arguments"),
        (("--namespace", "1st robot"), "ROS 2 refuses its arguments"),
    ):
        refused = ros2.start(*words, *wrong)
        assert await asyncio.to_thread(refused.process.wait, 60) == 1
        await asyncio.to_thread(refused.end)
        # rcl may write a line of its own before.
        assert refused.lines[-2].startswith(f"UsageError: {said}"), refused.lines
        assert "Traceback" not in "".join(refused.lines)
