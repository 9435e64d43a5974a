"""Make the floor plan of a live map for robots that ask, from the points of the keyframes of all robots.

The points of a keyframe are the object that its robot has stored for the cloud of the map; until that is
there, and for keyframes that have none, they are the features.  A plan is made in a thread of its own, when a
robot asks and the map has changed: at once if keyframes have moved by half a cell or robots have joined,
otherwise when the last plan has the age that the robot permits.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import hashlib
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest, LimitExceeded, NotFound, StoreError, UsageError
from rse_pf.geometry import Array, transform
from rse_pf.live_map.events import matrix_bytes
from rse_pf.live_map.versions import PlacedKeyframes, PointSource
from rse_pf.server.live_map.map_server.environment import MapServerEnvironment, Urgency
from rse_pf.server.live_map.map_server.state import MapState
from rse_pf.slam.floor_plan_change import encode_change
from rse_pf.slam.keyframe import SentKeyframe, decode_keyframe
from rse_pf.slam.occupancy import GridOptions, OccupancyGrid, grid_of_points
from rse_pf.wire.live_map import LiveFloorPlan

__all__ = ["FloorPlanner"]

_POINTS = 300  # points of a keyframe in a plan; keyframes are 0.1 m apart, so that many see each cell
_SIGHTS = (
    50  # points of a keyframe to which lines of sight are drawn, half of them features, which are farther
)
_MAX_LINES = 10_000  # lines of sight of a plan, which take a third of its CPU time
_MAX_POINTS = 1_500_000  # points of a plan, which bounds its CPU time; of more, an even selection is used
_READING_S = 0.2  # longest time for which a plan waits for stored points; the next plan reads on
_AT_ONCE_S = float("-inf")  # time at which an object is due that was not looked for yet
_FIRST_WAIT_S = 1.0  # time after which a missing object is looked for again; it doubles each time
_MAX_WAIT_S = 600.0  # an object that is still missing after a wait of this length counts as never stored
_MAX_LOAD = 0.25  # largest share of a core that plans of a growing map take, without those after corrections
_MAX_OPTIONS = 4  # different options of robots whose newest plans are in memory
_MAX_RECENT = 8  # newest plans, of which a robot may know one, so that it gets the change only
_MAX_REPLY_BYTES = (
    180_000  # size of the encoded cells; a message may have 256 KiB, and JSON takes a third more
)
_MIN_UPWARD = 0.5  # cosine between the mean upward direction of the cameras and z, below which z is not up

_Points = npt.NDArray[np.float32]


@dataclass(slots=True, eq=False)
class _View:
    """What a plan uses of a keyframe: points and ends of lines of sight ``(n, 3)``, metres, camera frame.

    ``source`` is the stored object that is still missing, None if it was read or there is none; it is looked
    for again at ``due_s``, and then after ``wait_s``.
    """

    points: _Points
    sights: _Points
    source: PointSource | None
    due_s: float = _AT_ONCE_S
    wait_s: float = _FIRST_WAIT_S


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Plan:
    """A plan, the keyframes as they were then (by id, ``T_map_camera``), and what it took to make it."""

    id: str
    grid: OccupancyGrid
    version: int
    changes: int
    T_of: dict[int, Array] = field(repr=False)
    made_s: float
    took_s: float


class FloorPlanner:
    """Makes the floor plans of one live map; all public methods are called in the event loop."""

    def __init__(self, environment: MapServerEnvironment, state: MapState) -> None:
        """Make no plan yet."""
        self._environment, self._state = environment, state
        self._lock = asyncio.Lock()  # held while a plan is made
        self._newest: dict[GridOptions, _Plan] = {}
        self._recent: dict[str, OccupancyGrid] = {}
        self._views: dict[int, _View] = {}
        # Keyframes that were in the map at the last request, the number of those that had arrived by then,
        # and `MapState.changes` when one that had arrived before was found to have joined the map.
        self._placed: set[int] = set()
        self._arrived = self._joined_changes = 0

    async def answer(self, request: LiveFloorPlan) -> dict[str, Any]:
        """Return the reply of ``live-floor-plan``.

        Raises:
            BadRequest: A number of the request is out of its range.
            NotFound: The map shows no floor yet, or its z axis does not point up and the request names no up.
            LimitExceeded: The plan does not fit into a message.
        """
        try:
            options = GridOptions(
                resolution_m=request.resolution_m,
                robot_height_m=request.robot_height_m,
                step_m=request.step_m,
                floor_m=request.floor_m,
                up=request.up,
            )
        except UsageError as error:
            raise BadRequest(error.message, hint=error.hint) from error
        async with self._lock:
            plan = await self._newest_plan(options, request.max_age_s)
        reply = {"plan": plan.id, "version": plan.version}
        if request.known == plan.id:
            return reply
        grid, base = plan.grid, self._recent.get(request.known)
        if base is not None and base.resolution_m != grid.resolution_m:
            base = None
        cells = await self._environment.threads.plan(functools.partial(encode_change, base, grid))
        if len(cells) > _MAX_REPLY_BYTES:
            raise LimitExceeded(
                f"the floor plan has {len(cells)} bytes, above {_MAX_REPLY_BYTES}",
                hint=f"ask for larger cells than {grid.resolution_m:g} m",
            )
        return {
            **reply,
            "base": "" if base is None else request.known,
            "cells": cells,
            "rows": grid.cells.shape[0],
            "columns": grid.cells.shape[1],
            "origin_m": grid.origin_m,
            "floor_m": grid.floor_m,
            "T_grid_map": matrix_bytes(grid.T_grid_world),
            "points_left_out": grid.points_left_out,
        }

    async def _newest_plan(self, options: GridOptions, max_age_s: float) -> _Plan:
        """Return the last plan with *options* if it is still good, otherwise a new one."""
        clock, threads = self._environment.clock, self._environment.threads
        plan, now_s = self._newest.get(options), clock()
        is_complete = all(view.source is None or view.due_s > now_s for view in self._views.values())
        if plan is not None and plan.changes == self._state.changes and is_complete:
            return plan
        # This takes a millisecond, and must not wait until a map that is busy has no more entries to apply.
        placed, version, changes = await threads.compute(
            Urgency.APPLY,
            lambda: (self._state.live_map.placed_keyframes(), self._state.position, self._state.changes),
        )
        if any(i < self._arrived and i not in self._placed for i in placed.ids):
            self._joined_changes = changes
        self._placed, self._arrived = set(placed.ids), placed.arrived
        if plan is not None:
            if any(view.source is not None and view.due_s == _AT_ONCE_S for view in self._views.values()):
                max_age_s = 0.0  # the last plan had no time to read all that its robots have stored
            is_recent = now_s - plan.made_s < max(max_age_s, plan.took_s / _MAX_LOAD)
            has_joined = plan.changes < self._joined_changes
            if is_recent and not has_joined and not _is_moved(plan, placed, options):
                return plan
        make = functools.partial(self._make, placed, options, version, changes)
        try:
            made = await threads.plan(make)
        except UsageError as error:
            raise NotFound(error.message, hint=error.hint) from error
        self._newest.pop(options, None)  # the new plan becomes the last one in the order of the dict
        self._newest[options] = made
        self._recent[made.id] = made.grid
        _drop_oldest(self._newest, _MAX_OPTIONS)
        _drop_oldest(self._recent, _MAX_RECENT)
        return made

    def _make(self, placed: PlacedKeyframes, options: GridOptions, version: int, changes: int) -> _Plan:
        """Make a plan; called in the thread of plans.

        Raises:
            UsageError: The map shows no floor, or the direction up is not known.
        """
        clock = self._environment.clock
        begin_s = clock()
        views = self._views = self._read_views(placed, begin_s)
        if not views:
            raise UsageError("the map has no keyframe in metres", hint="drive a robot with depth in it")
        T_map_camera = placed.T_map_camera
        if options.up is None and -T_map_camera[:, 2, 1].mean() < _MIN_UPWARD:
            raise UsageError(
                "the z axis of this map does not point up, because its first robot had no base and no IMU",
                hint="name the direction up, or begin the map with a robot whose base_frame is known",
            )
        stride = -(-sum(len(view.points) for view in views.values()) // _MAX_POINTS) or 1
        points = [
            transform(T, view.points[::stride].astype(np.float64))
            for T, view in zip(T_map_camera, views.values(), strict=True)
        ]
        up = np.array(options.up or (0.0, 0.0, 1.0))
        grid = grid_of_points(
            np.concatenate(points).astype(np.float32),
            T_map_camera,
            [view.sights for view in views.values()],
            up / np.linalg.norm(up),
            options,
            up_source="the map" if options.up is None else "--up",
            max_lines=_MAX_LINES,
        )
        end_s = clock()
        return _Plan(
            id=_id_of(grid),
            grid=grid,
            version=version,
            changes=changes,
            T_of=dict(zip(placed.ids, T_map_camera, strict=True)),
            made_s=end_s,
            took_s=end_s - begin_s,
        )

    def _read_views(self, placed: PlacedKeyframes, now_s: float) -> dict[int, _View]:
        """Return the view of each keyframe, in their order; reads missing objects for 0.2 s at most."""
        clock = self._environment.clock
        views: dict[int, _View] = {}
        for i, robot, data in zip(placed.ids, placed.robots, placed.data, strict=True):
            view = self._views.get(i)
            if view is None:
                view = _view_of(decode_keyframe(data), robot)
            views[i] = view
            if view.source is None or view.due_s > now_s or clock() - now_s > _READING_S:
                continue
            points = None
            with contextlib.suppress(StoreError):  # the object is read for a later plan
                points = self._environment.objects.read_points(view.source)
            if points is not None:
                view.source = None
                view.points = _thinned(points, _POINTS)
                view.sights = np.concatenate((view.sights, _thinned(points, _SIGHTS // 2)))
            elif view.wait_s > _MAX_WAIT_S:
                view.source = None
            else:
                view.due_s, view.wait_s = now_s + view.wait_s, 2.0 * view.wait_s
        return views


def _drop_oldest(plans: dict[Any, Any], most: int) -> None:
    while len(plans) > most:
        del plans[next(iter(plans))]


def _view_of(sent: SentKeyframe, robot: str) -> _View:
    """Return the view of a keyframe whose stored points were not read yet."""
    points = sent.features.points_camera(sent.camera)
    source = None
    if robot and sent.points is not None:
        source = PointSource(robot=robot, reference=sent.points, camera=sent.camera, T_world_camera=np.eye(4))
    return _View(points=_thinned(points, _POINTS), sights=_thinned(points, _SIGHTS // 2), source=source)


def _thinned(points: Array, count: int) -> _Points:
    """Return an even selection of *count* points, or fewer."""
    return points[:: -(-len(points) // count) or 1].astype(np.float32)


def _is_moved(plan: _Plan, placed: PlacedKeyframes, options: GridOptions) -> bool:
    """Return whether a keyframe of the plan is gone, or moved by half a cell."""
    is_in_plan = np.array([i in plan.T_of for i in placed.ids], dtype=bool)
    if plan.T_of.keys() - placed.dropped - set(placed.ids):
        return True
    before = np.array([plan.T_of[i] for i in placed.ids if i in plan.T_of]).reshape(-1, 4, 4)
    moved_m = placed.T_map_camera[is_in_plan, :3, 3] - before[:, :3, 3]
    return bool(np.linalg.norm(moved_m, axis=1).max(initial=0.0) >= options.resolution_m / 2)


def _id_of(grid: OccupancyGrid) -> str:
    """Return 16 hexadecimal digits that equal plans share."""
    about = f"{grid.cells.shape} {grid.origin_m} {grid.resolution_m} {grid.floor_m}".encode()
    cells = np.ascontiguousarray(grid.cells).data
    return hashlib.sha256(about + matrix_bytes(grid.T_grid_world) + cells).hexdigest()[:16]
