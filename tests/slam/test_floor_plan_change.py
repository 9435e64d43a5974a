"""A floor plan that was sent as its difference from another one is the same plan."""

from __future__ import annotations

import zlib

import numpy as np
import pytest

from rse_pf.errors import BadMessage
from rse_pf.slam.floor_plan_change import decode_change, encode_change
from rse_pf.slam.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

SIZE_M = 0.05


def plan(rows: int, columns: int, corner: tuple[int, int], seed: int = 0) -> OccupancyGrid:
    """Return a plan of random cells, whose corner is at a cell of the world."""
    rng = np.random.default_rng(seed)
    return OccupancyGrid(
        cells=rng.choice(np.array([OCCUPIED, UNKNOWN, FREE], np.uint8), (rows, columns)),
        origin_m=(corner[0] * SIZE_M, corner[1] * SIZE_M),
        resolution_m=SIZE_M,
        floor_m=0.0,
        T_grid_world=np.eye(4),
        up_source="the map",
    )


BASE = plan(20, 30, (-7, 4))


@pytest.mark.parametrize(
    "after",
    [
        plan(20, 30, (-7, 4), 1),
        plan(60, 80, (-20, -15), 1),
        plan(5, 6, (3, 9), 1),
        plan(20, 30, (-20, 10), 1),
        plan(4, 4, (500, -500), 1),
        plan(4, 4, (-500, 500), 1),
    ],
    ids=["same square", "larger", "smaller", "shifted", "apart", "apart on the other side"],
)
@pytest.mark.parametrize("base", [BASE, None], ids=["change", "whole"])
def test_a_plan_arrives_as_it_is(base: OccupancyGrid | None, after: OccupancyGrid) -> None:
    data = encode_change(base, after)
    np.testing.assert_array_equal(decode_change(base, data, after.cells.shape, after.origin_m), after.cells)


def test_a_small_change_takes_few_bytes() -> None:
    before, after = plan(400, 400, (0, 0)), plan(400, 410, (-10, 0))
    after.cells[:] = UNKNOWN
    after.cells[:, 10:] = before.cells
    after.cells[7, 100:120] = OCCUPIED
    assert len(encode_change(before, after)) < 500 < len(encode_change(None, after)) / 50


@pytest.mark.parametrize(
    ("data", "shape"),
    [
        (b"no zlib", (20, 30)),
        (zlib.compress(b"x" * 599), (20, 30)),
        (zlib.compress(b"x" * 10_000_000), (20, 30)),
        (zlib.compress(b""), (0, 0)),
        (zlib.compress(b"x"), (-1, -1)),
        (zlib.compress(b"x"), (1 << 13, 1 << 13)),
    ],
)
def test_damaged_plans_are_refused(data: bytes, shape: tuple[int, int]) -> None:
    with pytest.raises(BadMessage):
        decode_change(BASE, data, shape, (0.0, 0.0))
