"""A robot asks for the floor plan of a live map, and receives what has changed since its last one."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from client_sdk.live import LiveMapper
from rse_pf.errors import BadMessage, NotFound
from rse_pf.slam.floor_plan_change import encode_change
from rse_pf.slam.occupancy import FREE, OCCUPIED, UNKNOWN, GridOptions, OccupancyGrid
from tests.kit.fake_live_map import FakeLiveRobot, failing, solve


def plan(cells: list[list[int]], origin_m: tuple[float, float] = (-0.5, 1.0)) -> OccupancyGrid:
    return OccupancyGrid(
        cells=np.array(cells, np.uint8), origin_m=origin_m, resolution_m=0.05, floor_m=0.1,
        T_grid_world=np.eye(4), up_source="the map",
    )  # fmt: skip


FIRST = plan([[OCCUPIED, FREE], [UNKNOWN, FREE]])
SECOND = plan([[OCCUPIED, FREE, FREE], [OCCUPIED, FREE, UNKNOWN]], (-0.5, 0.95))


def reply(id_: str, plan: OccupancyGrid, base: OccupancyGrid | None = None, base_id: str = "") -> Any:
    return {
        "plan": id_, "version": 3, "base": base_id, "cells": encode_change(base, plan),
        "rows": plan.cells.shape[0], "columns": plan.cells.shape[1], "origin_m": plan.origin_m,
        "floor_m": plan.floor_m, "T_grid_map": np.eye(4).ravel().tolist(),
    }  # fmt: skip


@pytest.fixture
def mapper(robot: FakeLiveRobot) -> LiveMapper:
    return LiveMapper(robot, "lab", ask=solve)


async def test_a_robot_names_the_plan_that_it_has_and_applies_the_change(
    robot: FakeLiveRobot, mapper: LiveMapper
) -> None:
    robot.plans = [reply("a", FIRST), {"plan": "a", "version": 4}, reply("b", SECOND, FIRST, "a")]

    first, same, second = [await mapper.floor_plan() for _ in range(3)]

    assert robot.known_plans == ["", "a", "a"]
    np.testing.assert_array_equal(first.cells, FIRST.cells)
    assert same is first
    np.testing.assert_array_equal(second.cells, SECOND.cells)
    assert (second.origin_m, second.floor_m, second.resolution_m) == (SECOND.origin_m, 0.1, 0.05)


async def test_other_options_ask_for_a_whole_plan(robot: FakeLiveRobot, mapper: LiveMapper) -> None:
    robot.plans = [reply("a", FIRST), reply("c", FIRST)]
    await mapper.floor_plan()
    coarse = await mapper.floor_plan(GridOptions(resolution_m=0.2))
    assert robot.known_plans == ["", ""]
    assert coarse.resolution_m == 0.2


@pytest.mark.parametrize(
    "wrong",
    [
        reply("b", SECOND, FIRST, "x"),
        {**reply("b", SECOND), "cells": b"damaged"},
        {**reply("b", SECOND), "rows": 1 << 20},
        {**reply("b", SECOND), "T_grid_map": None},
        {"plan": "b", "version": 4},
    ],
    ids=["unknown base", "damaged", "too large", "without a frame", "unknown plan"],
)
async def test_a_wrong_answer_is_an_error_and_the_next_one_is_taken(
    robot: FakeLiveRobot, mapper: LiveMapper, wrong: Any
) -> None:
    robot.plans = [reply("a", FIRST), wrong, reply("b", SECOND, FIRST, "a")]
    await mapper.floor_plan()
    with pytest.raises(BadMessage):
        await mapper.floor_plan()
    np.testing.assert_array_equal((await mapper.floor_plan()).cells, SECOND.cells)


async def test_a_map_without_a_floor_says_so(robot: FakeLiveRobot, mapper: LiveMapper) -> None:
    robot.before_answer = failing(NotFound("the map has no keyframe in metres"), "live-floor-plan", 1)
    with pytest.raises(NotFound, match="no keyframe"):
        await mapper.floor_plan()
