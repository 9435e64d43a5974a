"""The floor plan that a mapper makes while it drives, compared with the rendered world."""

from __future__ import annotations

import asyncio

import numpy as np
import pytest

from client_sdk.mapper import Mapper
from client_sdk.simulator.drive import render_along, true_trajectory
from client_sdk.simulator.world import make_world
from client_sdk.trajectory import Trajectory
from rse_pf.slam.occupancy import UNKNOWN, GridOptions
from tests.kit.exact_maps import WORLD, shares_right
from tests.kit.fake_live_map import solve

pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")


def test_the_floor_plan_of_a_drive_shows_the_rendered_world() -> None:
    truth = true_trajectory(WORLD["robot"], WORLD["robots"], WORLD["frames"], WORLD["seed"])
    rows = np.arange(0, len(truth), 2)
    path = Trajectory(truth.timestamps_s[rows], truth.T_world_camera[rows])
    mapper = Mapper(ask=solve, keyframes_of="robot-1", T_world_start=path.T_world_camera[0])

    async def drive() -> None:
        for frame in render_along(path, make_world(WORLD["seed"]), (WORLD["seed"], 1)):
            await mapper.track(frame)

    asyncio.run(drive())
    grid = mapper.floor_plan(GridOptions(up=(0.0, 0.0, 1.0)))

    right, _, right_occupied = shares_right(grid, 0.1, 1.5)
    assert (grid.cells != UNKNOWN).sum() > 8000
    assert right >= 0.95
    assert right_occupied >= 0.75  # noise of depth puts points of a wall into the cell before it
