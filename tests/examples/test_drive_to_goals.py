"""The planner and the controller of the example, and a drive to one goal in a rendered building."""

from __future__ import annotations

import asyncio
import math
import runpy
from typing import Any

import numpy as np
import pytest

from client_sdk.simulator.building import make_building
from rse_pf.slam.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from tests.kit.example_page import REPOSITORY

pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")

START, GOAL = np.array([1.0, 2.0]), np.array([5.0, 2.0])


@pytest.fixture(scope="module")
def example() -> dict[str, Any]:
    return runpy.run_path(str(REPOSITORY / "examples" / "robots" / "drive_to_goals.py"), run_name="example")


def room(door_m: tuple[float, float] | None) -> OccupancyGrid:
    """Return a room of 6 x 4 m that a wall at x = 3 m divides, perhaps with a door between two y."""
    cells = np.full((80, 120), FREE, dtype=np.uint8)
    cells[[0, -1]] = cells[:, [0, -1]] = OCCUPIED
    cells[:, 60] = OCCUPIED
    if door_m is not None:
        cells[round(door_m[0] / 0.05) : round(door_m[1] / 0.05), 60] = FREE
    return OccupancyGrid(
        cells=cells,
        origin_m=(0.0, 0.0),
        resolution_m=0.05,
        floor_m=0.0,
        T_grid_world=np.eye(4),
        up_source="--up",
    )


def test_a_path_leads_through_a_door_that_is_wide_enough(example: dict[str, Any]) -> None:
    path = example["plan"](room((2.8, 3.6)), START, GOAL)

    np.testing.assert_allclose(path[[0, -1]], [START, GOAL], atol=0.05)
    in_door = path[np.abs(path[:, 0] - 3.0) < 0.1]
    assert ((in_door[:, 1] > 2.8 + 0.25) & (in_door[:, 1] < 3.6 - 0.25)).all()


@pytest.mark.parametrize("door_m", [None, (2.8, 3.2)])
def test_there_is_no_path_through_a_wall_or_a_narrow_door(
    example: dict[str, Any], door_m: tuple[float, float] | None
) -> None:
    # Beyond the plan everything is unknown: the room must be closed for the robot.
    assert example["plan"](room(door_m), START, GOAL) is None


def test_a_path_leads_to_a_goal_that_was_not_seen_yet(example: dict[str, Any]) -> None:
    grid = room((2.8, 3.6))
    grid.cells[:, -1] = UNKNOWN

    path = example["plan"](grid, START, np.array([9.0, 2.0]))

    np.testing.assert_allclose(path[-1], [9.0, 2.0], atol=0.05)


def test_a_robot_that_is_lost_looks_around_and_at_its_goal_it_turns(example: dict[str, Any]) -> None:
    navigator = example["Navigator"](np.array([5.0, 2.0, 1.0]))
    navigator.replan(room((2.8, 3.6)), *START)

    assert navigator.command(1.0, 2.0, 0.5, "lost")[0] == 0.0
    assert navigator.command(1.0, 2.0, 0.5, "lost")[1] > 0.0
    assert (
        navigator.command(1.0, 2.0, 0.5, "visual")[0] > navigator.command(1.0, 2.0, 0.5, "odometry")[0] > 0.0
    )
    assert navigator.command(5.0, 2.0, 0.5, "visual")[0] == 0.0
    assert navigator.command(5.0, 2.0, 1.0, "visual") is None


def test_a_simulated_robot_drives_to_a_goal(example: dict[str, Any]) -> None:
    robot = example["SimulatedRobot"](make_building("hall", 0), 1.5, 7.5, 0.0, 0)
    mapper = example["Mapper"](
        ask=example["solve"], T_base_camera=example["T_BASE_CAMERA"], keyframes_of="robot-1"
    )
    goal = np.array([2.0, 0.5, math.pi / 4])

    assert asyncio.run(example["drive_to"](robot, mapper, goal))

    x_m, y_m, yaw_rad = robot.place()
    assert robot.base.collisions == 0
    assert math.hypot(x_m - 2.0, y_m - 0.5) < 0.15
    assert yaw_rad == pytest.approx(math.pi / 4, abs=math.radians(10.0))
