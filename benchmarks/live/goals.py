"""Drive a simulated robot to goals through ROS 2, the bridge and a platform, with faults.

    python -m benchmarks live.goals --building rooms --goals 10 --seed 0 --fault kill

The programs are those of examples/robots: ``ros2_simulated_robot.py`` renders what the camera sees, follows
/cmd_vel and judges the goals; ``ros2_drive_to_goals.py`` plans and steers by the floor plan and the poses of
the bridge.  After a tour through the building that makes the map, each goal is a random place and direction.

``--fault`` happens once for each goal, soon after it was sent: ``kill`` kills the server of the robot,
``network`` stops the balancer for 10 s of the simulated time, and ``carried`` puts the robot at another place
of the tour, without a turn of its wheels, where it stands for 3 s before the goal is sent.  With
``corrected`` a second robot, of the SDK, drives through the building from the first goal on, in a live map
of both.

A goal is reached if the robot says so within 150 s and stands within 15 cm and 10 degrees of it.  A pose is
wrong if the bridge calls it ``visual`` and it is more than 20 cm off, in a map that is laid over the building
by the path of the tour.  Needs build/ros2 (``make ros``).
"""

from __future__ import annotations

import asyncio
import os
import re
import signal
import tempfile
from pathlib import Path
from typing import Annotated, Any

from benchmarks.frame.registry import Bar, benchmark
from benchmarks.frame.report import say
from benchmarks.frame.statistics import spread
from benchmarks.maps.wheels import make_drive
from client_sdk import connect
from client_sdk.simulator.base import T_BASE_CAMERA
from client_sdk.simulator.building import BUILDINGS
from rse_pf.config import PlatformSettings
from rse_pf.errors import UsageError
from rse_pf.local.control.control_plane import ControlOptions
from rse_pf.local.control.platform import LocalPlatform
from tests.kit.ros2 import ROS2, Ros2
from tests.kit.ros_programs import Program

FAULTS = ("none", "kill", "network", "carried", "corrected")
EXAMPLES = Path(__file__).parents[2] / "examples" / "robots"
FAULT_AFTER_S = 3.0  # simulated time from a goal to its fault: the robot drives by then
SECOND_DRIVE_M = 60.0  # length of the drive of the robot that corrects the map
OUTAGE_S = 10.0  # simulated time of an outage of the network
TIMEOUT_S = 3600.0  # longest real time of a tour, and of a goal, on a busy machine

GOAL_LINE = re.compile(
    r"goal (\d+) (reached|MISSED|GIVEN UP): ([\d.]+) cm and ([\d.]+) degrees away after (\d+) s, "
    r"(\d+) collisions, (\d+) wrong poses"
)
"""Number, result, errors of place (cm) and direction (degrees), time (s) and counts of a goal."""


@benchmark(
    Bar("reached_share", at_least=0.96),
    Bar("collisions", equals=0),
    Bar("wrong_poses", equals=0),
)
def measure(
    building: Annotated[str, "building", BUILDINGS] = "rooms",
    goals: Annotated[int, "number of goals"] = 10,
    tour: Annotated[float, "length of the first tour in metres"] = 60.0,
    seed: Annotated[int, "chooses tour, goals and noise"] = 0,
    fault: Annotated[str, "what goes wrong at each goal", FAULTS] = "none",
    domain: Annotated[int, "ROS_DOMAIN_ID, another one for each run at the same time"] = 87,
) -> dict[str, Any]:
    """Drive to goals; return how many were reached."""
    if not (ROS2 / "installed").is_file():
        raise UsageError("build/ros2 is missing", hint="make ros builds it")
    with tempfile.TemporaryDirectory() as folder:
        return asyncio.run(_drive(Path(folder), building, goals, tour, seed, fault, domain))


async def _drive(
    folder: Path, building: str, goals: int, tour: float, seed: int, fault: str, domain: int
) -> dict[str, Any]:
    ros2 = Ros2(folder, domain)
    control = ControlOptions(elastic=True)
    try:
        async with LocalPlatform(
            PlatformSettings(), port=0, servers=2, state=folder / "platform", control=control
        ) as platform:
            token_file = folder / "token"
            token_file.write_text(platform.issue_token("robot-1"), encoding="ascii")
            ros2.start(
                ros2.python, "-m", "ros_bridge", "ros2", "--url", platform.url,
                "--token-file", str(token_file), "--odometry=/odom", "--planar=true",
                "--floor-plan-every-s=2", "--cloud-every-s=60",
                *(["--map=hall"] if fault == "corrected" else []), "--ros-args", "-p", "use_sim_time:=true",
            )  # fmt: skip
            driver = ros2.start(ros2.python, str(EXAMPLES / "ros2_drive_to_goals.py"))
            carried = ["--carried", *map(str, range(goals))] if fault == "carried" else []
            simulator = ros2.start(
                ros2.python, str(EXAMPLES / "ros2_simulated_robot.py"), "--building", building,
                "--tour", str(tour), "--goals", str(goals), "--seed", str(seed), "--times", *carried,
            )  # fmt: skip
            second = None
            for number in range(goals):
                await _wait(simulator, f"goal {number} at ")
                if fault == "corrected" and second is None:
                    second = asyncio.create_task(_drive_second_robot(platform, building, seed))
                if fault in ("kill", "network"):
                    await _break(platform, simulator, fault)
                await _wait(simulator, f"goal {number} [rMG]")
                goal = _goals(simulator.lines)[-1]
                say(goal.string.strip())
                if goal[2] != "reached":
                    say("".join(driver.lines[-5:]))
            if second is not None:
                say(await second)
    finally:
        ros2.end()
    return _figures(simulator.lines)


async def _drive_second_robot(platform: LocalPlatform, building: str, seed: int) -> str:
    """Drive a robot of the SDK through the building, in the live map; return what became of it."""
    number = BUILDINGS.index(building) + len(BUILDINGS) * (seed + 1)
    second = await asyncio.to_thread(make_drive, number, SECOND_DRIVE_M)
    poses = 0
    async with (
        connect(platform.url, token=platform.issue_token("robot-2")) as robot,
        robot.live_map("hall", depth=True, T_base_camera=T_BASE_CAMERA) as live,
    ):
        for frame, readings in zip(second.frames, second.readings(), strict=True):
            poses += (await live.track(frame, odometry=readings)).T_map_camera is not None
    return f"robot-2: {poses} of {len(second.frames)} frames with a pose in the map"


async def _wait(simulator: Program, pattern: str) -> None:
    await asyncio.to_thread(
        simulator.until, lambda lines: any(re.match(pattern, line) for line in lines), TIMEOUT_S
    )


async def _break(platform: LocalPlatform, simulator: Program, fault: str) -> None:
    """Inject *fault* into the platform while the robot drives."""
    fault_s = _time_s(simulator.lines) + FAULT_AFTER_S
    await _wait_for_time(simulator, fault_s)
    if fault == "kill":
        pages = {each.name: await platform.backend_servers.status(each) for each in platform.servers}
        for name, page in pages.items():
            if page is not None and page["robots"]:
                platform.kill(name)
        return
    mark = platform.load_balancer.process.mark
    assert mark is not None
    os.kill(mark.pid, signal.SIGSTOP)
    try:
        await _wait_for_time(simulator, fault_s + OUTAGE_S)
    finally:
        os.kill(mark.pid, signal.SIGCONT)


async def _wait_for_time(simulator: Program, time_s: float) -> None:
    """Wait for a simulated time, or for the end of a goal."""
    goals = len(_goals(simulator.lines))
    await asyncio.to_thread(
        simulator.until,
        lambda lines: _time_s(lines) >= time_s or len(_goals(lines)) > goals,
        TIMEOUT_S,
    )


def _time_s(lines: list[str]) -> float:
    """Return the newest simulated time that a simulator printed; 0 before the first."""
    times = (re.match(r"time (\d+) s", line) for line in reversed(lines))
    return next((float(each[1]) for each in times if each), 0.0)


def _goals(lines: list[str]) -> list[re.Match[str]]:
    return [match for match in map(GOAL_LINE.match, lines) if match]


def _figures(lines: list[str]) -> dict[str, Any]:
    goals = _goals(lines)
    return {
        "goals": len(goals),
        "reached": sum(each[2] == "reached" for each in goals),
        "reached_share": sum(each[2] == "reached" for each in goals) / max(len(goals), 1),
        "given_up": sum(each[2] == "GIVEN UP" for each in goals),
        "collisions": sum(int(each[6]) for each in goals),
        "wrong_poses": sum(int(each[7]) for each in goals),
        "error_cm": spread(float(each[3]) for each in goals),
        "error_deg": spread(float(each[4]) for each in goals),
        "seconds": spread(float(each[5]) for each in goals),
    }
