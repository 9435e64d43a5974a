"""A simulated robot drives to goals through the real bridge, ROS 2 and a platform, on a simulated clock."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from rse_pf.config import PlatformSettings
from rse_pf.local.control.platform import LocalPlatform
from tests.kit.example_page import REPOSITORY
from tests.kit.ros2 import Ros2

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]

EXAMPLES = REPOSITORY / "examples" / "robots"
GOAL_TIMEOUT_S = 1500.0  # a drive takes about a minute, and longer on a busy machine


async def test_a_robot_reaches_goals_by_the_floor_plan_and_the_poses_of_the_bridge(
    ros2: Ros2, tmp_path: Path
) -> None:
    state, token_file = tmp_path / "platform", tmp_path / "token"
    async with LocalPlatform(PlatformSettings(), port=0, servers=1, state=state) as platform:
        token_file.write_text(platform.issue_token("robot-1"), encoding="ascii")
        ros2.start(
            ros2.python, "-m", "ros_bridge", "ros2", "--url", platform.url, "--token-file", str(token_file),
            "--odometry=/odom", "--planar=true", "--floor-plan-every-s=2", "--ros-args", "-p",
            "use_sim_time:=true",
        )  # fmt: skip
        ros2.start(ros2.python, str(EXAMPLES / "ros2_drive_to_goals.py"))
        robot = ros2.start(
            ros2.python, str(EXAMPLES / "ros2_simulated_robot.py"),
            "--building", "rooms", "--tour", "20", "--goals", "1",
        )  # fmt: skip
        await asyncio.to_thread(
            robot.until, lambda lines: any("of 1 goals" in line for line in lines), GOAL_TIMEOUT_S
        )

    (goal,) = (line for line in robot.lines if line.startswith("goal 0") and " at " not in line)
    assert goal.startswith("goal 0 reached: ")
    assert goal.endswith("0 collisions, 0 wrong poses\n")
