"""Ask a live map for its floor plan, which the map server makes of the points of all robots.

The robot names the plan that it has, and gets the change since then.  Plans have a rate limit of their own.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import numpy as np

from client_sdk.live.keyframe_sender import LiveRobot
from rse_pf.errors import BadMessage
from rse_pf.limits.token_bucket import TokenBucket
from rse_pf.slam.floor_plan_change import decode_change
from rse_pf.slam.occupancy import GridOptions, OccupancyGrid
from rse_pf.wire.live_map import FLOOR_PLAN, FloorPlanReply, LiveFloorPlan

__all__ = ["FloorPlans"]

_BYTES_PER_S = 18_000.0  # rate limit of plans with their requests: with all overhead less than 20 kB/s
_REQUEST_BYTES = 400  # bytes of a request and the head of its reply that the rate limit counts


class FloorPlans:
    """The floor plans of one live map, as one robot has received them."""

    def __init__(
        self, robot: LiveRobot, map_name: str, *, deadline_s: float, clock: Callable[[], float]
    ) -> None:
        """Store the arguments; *clock* is monotonic, in seconds."""
        self._robot, self._map_name, self._deadline_s = robot, map_name, deadline_s
        self._clock = clock
        self._lock = asyncio.Lock()
        self._rate_limit = TokenBucket(_BYTES_PER_S, burst=0.0)
        self._known: tuple[str, OccupancyGrid] | None = None
        self._known_options: GridOptions | None = None

    async def newest(self, options: GridOptions, max_age_s: float) -> OccupancyGrid:
        """Return the newest plan, the same object if it has not changed; see `LiveMapper.floor_plan`."""
        async with self._lock:
            await asyncio.sleep(self._rate_limit.spend(0.0, self._clock()))
            known = self._known if options == self._known_options else None
            request = LiveFloorPlan(
                map=self._map_name,
                known="" if known is None else known[0],
                max_age_s=max_age_s,
                resolution_m=options.resolution_m,
                robot_height_m=options.robot_height_m,
                step_m=options.step_m,
                floor_m=options.floor_m,
                up=options.up,
            )
            answer = await self._robot.call(
                FLOOR_PLAN, request, FloorPlanReply, deadline_s=self._deadline_s, keep=True
            )
            reply: FloorPlanReply = answer.reply
            self._rate_limit.spend(len(reply.cells) + _REQUEST_BYTES, self._clock())
            if known is None or reply.plan != known[0]:
                known = reply.plan, _grid_of(reply, known, options)
            self._known, self._known_options = known, options
            return known[1]


def _grid_of(
    reply: FloorPlanReply, known: tuple[str, OccupancyGrid] | None, options: GridOptions
) -> OccupancyGrid:
    if reply.T_grid_map is None or reply.T_grid_map.shape != (16,):
        raise BadMessage("a floor plan without T_grid_map", hint="use the same version of server and SDK")
    if reply.base and (known is None or reply.base != known[0]):
        raise BadMessage("a change of a floor plan that is not known", hint="ask for the plan again")
    base = known[1] if reply.base and known is not None else None
    return OccupancyGrid(
        cells=decode_change(base, reply.cells, (reply.rows, reply.columns), reply.origin_m),
        origin_m=reply.origin_m,
        resolution_m=options.resolution_m,
        floor_m=reply.floor_m,
        T_grid_world=np.array(reply.T_grid_map).reshape(4, 4),
        up_source="the map" if options.up is None else "--up",
        points_left_out=reply.points_left_out,
    )
