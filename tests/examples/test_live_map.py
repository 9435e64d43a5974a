"""The examples of live maps: two robots, one after the other, in one map."""

from __future__ import annotations

import asyncio
import contextlib
import re
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from client_sdk import DataClient, LiveOptions, connect, open_dataset
from rse_pf.errors import NotFound
from rse_pf.maps.format import decode_map
from tests.examples.conftest import ExamplePlatform

pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")
from tests.kit.rendered_inputs import write_drives

pytestmark = [pytest.mark.system, pytest.mark.slow]
HAS_DATA = True


def test_two_robots_share_a_live_map(platform: ExamplePlatform) -> None:
    drives = [platform.folder / name for name in ("drive-1", "drive-2")]
    write_drives(drives, frames=16)
    for kind in ("rgb", "depth"):
        lines = [f"{row / 10:.1f} {kind}/{row}.png\n" for row in range(16)]
        (drives[0] / f"{kind}.txt").write_text("".join(lines))

    first = platform.run(platform.command("live_map_recording"))
    second = platform.run(platform.command("live_map_camera"))

    assert (first.returncode, first.stderr) == (0, "")
    assert re.search(r"^16 frames, [1-9]\d* keyframes, 0 waiting$", first.stdout, re.MULTILINE), first.stdout
    assert (second.returncode, second.stderr) == (0, "")
    assert second.stdout.count("\n") >= 16


async def drive(file: Path, recording: Path, name: str) -> int:
    """Drive through a recording by `Robot.live_map`, and return how many objects of points were stored."""
    live = LiveOptions(points_bytes_per_s=1e7, leave_s=40.0)
    async with connect(enrolment=file) as robot, robot.live_map(name, live=live) as mapper:
        for frame in open_dataset(recording):
            await mapper.track(frame)
    return int(mapper.report()["live"]["points"]["sent"])


def test_the_map_of_a_robot_of_the_sdk_has_a_cloud(platform: ExamplePlatform) -> None:
    recording, file = platform.folder / "coloured", platform.folder / "robot-1.enrolment"
    write_drives([recording], frames=8)
    for kind in ("rgb", "depth"):
        lines = [f"{row / 10:.1f} {kind}/{row}.png\n" for row in range(8)]
        (recording / f"{kind}.txt").write_text("".join(lines))

    stored = asyncio.run(drive(file, recording, "coloured"))

    assert stored > 0
    data, points, end = DataClient.enrolled(file), 0, time.monotonic() + 60.0
    while not points:
        assert time.monotonic() < end, "no version of the map has points"
        with contextlib.suppress(NotFound):
            points = len(decode_map(data.download_map("coloured")).points)
        time.sleep(0.1)  # polls: the map is published some seconds after its last robot left
    data.close()


async def keyframes_of(platform: ExamplePlatform, robot: str, name: str) -> int:
    """Return how many keyframes the map took from *robot*: the number of its next one."""
    file = platform.folder / f"{robot}.enrolment"
    async with connect(enrolment=file) as connected, connected.live_map(name) as mapper:
        end = time.monotonic() + 20.0
        while not mapper.map_server:
            assert time.monotonic() < end, mapper.trouble
            await asyncio.sleep(0.05)
        answer = await connected.call("live-show", {"map": name}, keep=True)
    return int(answer.reply["you"]["number"])


def test_three_robots_that_drive_at_once_lose_no_keyframe(platform: ExamplePlatform) -> None:
    robots = ("robot-1", "robot-2", "robot-4")
    drives = [platform.folder / f"together-{name}" for name in robots]
    write_drives(drives, frames=24)
    commands = []
    for name, drive in zip(robots, drives, strict=True):
        for kind in ("rgb", "depth"):
            lines = [f"{row / 10:.1f} {kind}/{row}.png\n" for row in range(24)]
            (drive / f"{kind}.txt").write_text("".join(lines))
        instead = {"robot-1.enrolment": f"{name}.enrolment", "drive-1": drive.name, "warehouse": "together"}
        commands.append(platform.command("live_map_recording", **instead))

    with ThreadPoolExecutor(3) as pool:
        ended = list(pool.map(platform.run, commands))

    assert [(each.returncode, each.stderr) for each in ended] == [(0, "")] * 3
    told = [
        re.search(r"^24 frames, (\d+) keyframes, 0 waiting$", each.stdout, re.MULTILINE) for each in ended
    ]
    made = {name: int(each[1]) for name, each in zip(robots, told, strict=True) if each}
    kept = {name: platform.wait(keyframes_of(platform, name, "together")) for name in robots}
    print(f"{sum(kept.values())} of {sum(made.values())} keyframes of three robots are in the map")
    assert kept == made
    assert sum(made.values()) >= 9
