"""The floor plan of a live map: of the points of all robots, sent as changes, new after corrections."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rse_pf.errors import BadRequest, NotFound
from rse_pf.geometry import Array
from rse_pf.identity import RobotId, object_name
from rse_pf.live_map.events import KeyframeAdded
from rse_pf.live_map.live_map import LiveMap
from rse_pf.server.live_map.map_server.environment import LIVE_MAP
from rse_pf.slam.floor_plan_change import decode_change
from rse_pf.slam.keyframe import encode_keyframe, make_features
from rse_pf.slam.keyframe_points import ObjectReference, encode_points
from rse_pf.slam.occupancy import FREE, OCCUPIED, OccupancyGrid
from rse_pf.storage.object_store import MemoryStore
from tests.kit.generated_drives import CAMERA, GeneratedDrive, GeneratedWorld, straight
from tests.kit.map_server_setup import MapServerSetup, RunningMapServer

ONE, OTHER, ROBOT = (RobotId("default", name) for name in ("one", "other", "third"))
UP = (0.0, -1.0, 0.0)  # the map has the axes of the first camera, whose y axis points down
CAMERA_M = 1.2  # height of the camera above the floor
SEEN_M = 3.5  # distance up to which a camera sees
WALL_M = 7.0  # distance of the wall from the start of the first robot, which looks at it


def depths_seen_m(pixels: Array, x_m: float) -> Array:
    """Return the depths of floor and wall at pixels of a camera at *x_m*."""
    below = np.maximum((pixels[:, 1] - CAMERA.cy) / CAMERA.fy, 1e-9)
    return np.minimum(CAMERA_M / below, WALL_M - x_m)


def seen(x_m: float) -> bytes:
    """Return the points of floor and wall that a camera at *x_m* sees."""
    v, u = np.mgrid[2:480:6, 2:640:6]
    pixels = np.column_stack((u.ravel(), v.ravel()))
    depths_m = depths_seen_m(pixels, x_m)
    is_near = depths_m < SEEN_M
    colours = np.zeros((int(is_near.sum()), 3), np.uint8)
    return encode_points(pixels[is_near], depths_m[is_near], colours, CAMERA)


class SeeingWorld(GeneratedWorld):
    """A generated world in which each keyframe refers to points, which are stored if *has_arrived*."""

    def store_into(self, store: MemoryStore, has_arrived: Callable[[str], bool] = lambda _: True) -> None:
        self._store, self._has_arrived, self.late = store, has_arrived, dict[str, bytes]()

    def keyframe(self, drive: GeneratedDrive, number: int, first: int = 0) -> KeyframeAdded:
        event = super().keyframe(drive, number, first)
        x_m = float(drive.T_world_camera[number][0, 3])
        points = seen(x_m)
        digest = hashlib.sha256(points).hexdigest()
        name = object_name(ONE if drive.robot == ONE.folder else OTHER, digest)
        if self._has_arrived(drive.robot):
            self._store.put(name, points)
        else:
            self.late[name] = points
        features = event.keyframe.features
        depths_m = depths_seen_m(features.pixels, x_m)
        rows = np.flatnonzero(depths_m < SEEN_M)
        sent = replace(
            event.keyframe,
            features=make_features(features.pixels[rows], depths_m[rows], features.descriptors[rows]),
            points=ObjectReference(digest, len(points)),
        )
        return KeyframeAdded(
            robot=event.robot, segment=event.segment, number=event.number, data=encode_keyframe(sent)
        )


class Hall:
    """A map server of a hall through which two robots have driven, and what a robot knows of its plan."""

    def __init__(self, has_arrived: Callable[[str], bool] = lambda _: True) -> None:
        self.store = MemoryStore()
        self.world = SeeingWorld(seed=1)
        self.world.store_into(self.store, has_arrived)
        self.live_map = LiveMap()
        self.drives = [
            self.world.drive(ONE.folder, straight(0.0, 3.0)),
            self.world.drive(OTHER.folder, straight(1.0, 5.0)),
        ]
        for event in self.world.play(self.drives):
            self.live_map.apply(event)
        self.setup = MapServerSetup(self.store, implementation=replace(LIVE_MAP, empty=lambda: self.live_map))
        self.server: RunningMapServer
        self.reply: dict[str, Any] = {}

    async def start(self) -> Hall:
        self.server = await self.setup.start("a")
        return self

    async def ask(self, **request: Any) -> dict[str, Any]:
        self.reply = await self.server.ask("live-floor-plan", {"up": UP, "max_age_s": 60.0, **request})
        return self.reply


def grid_of(reply: dict[str, Any], base: OccupancyGrid | None = None) -> OccupancyGrid:
    return OccupancyGrid(
        cells=decode_change(base, reply["cells"], (reply["rows"], reply["columns"]), reply["origin_m"]),
        origin_m=reply["origin_m"],
        resolution_m=0.05,
        floor_m=reply["floor_m"],
        T_grid_world=np.frombuffer(reply["T_grid_map"]).reshape(4, 4),
        up_source="--up",
    )


def depths_m(grid: OccupancyGrid, state: int) -> Array:
    """Return how far ahead of the start of the first robot the cells of a state are, in metres."""
    rows, columns = np.nonzero(grid.cells == state)
    corners = np.column_stack((columns, rows)) * grid.resolution_m + grid.origin_m
    centres = np.column_stack((corners + grid.resolution_m / 2, np.zeros(len(rows))))
    ahead: Array = (centres @ grid.T_grid_world[:3, :3])[:, 2]
    return ahead


async def test_the_plan_shows_what_all_robots_have_seen_until_one_of_them_is_forgotten() -> None:
    hall = await Hall().start()

    both = grid_of(await hall.ask())
    await hall.server.ask("live-forget", {"robot": "other"})
    alone = grid_of(await hall.ask())  # at once, although a plan may be 60 s old

    walls = depths_m(both, OCCUPIED)
    assert len(walls) > 40
    assert np.mean(np.abs(walls - WALL_M) < 0.1) > 0.9
    assert np.isclose(both.floor_m, -CAMERA_M, atol=0.05)
    assert np.mean(depths_m(both, FREE) < WALL_M) > 0.99
    assert depths_m(both, FREE).max() > 6.5
    assert depths_m(alone, FREE).max() < 6.5
    assert not (alone.cells == OCCUPIED).any()


async def test_a_robot_that_knows_a_plan_gets_the_change_only() -> None:
    hall = await Hall().start()
    whole = await hall.ask()
    known = grid_of(whole)

    assert (await hall.ask(known=whole["plan"])).keys() == {"plan", "version"}

    await hall.server.ask("live-forget", {"robot": "other"})
    change = await hall.ask(known=whole["plan"])
    again = await hall.ask(known="a plan of another map server")

    assert (change["base"], again["base"]) == (whole["plan"], "")
    assert change["plan"] == again["plan"] != whole["plan"]
    np.testing.assert_array_equal(grid_of(change, known).cells, grid_of(again).cells)


async def test_a_map_that_only_grows_has_a_new_plan_after_the_age_that_the_robot_permits() -> None:
    hall = await Hall().start()
    first = (await hall.ask())["plan"]
    further = hall.world.drive(OTHER.folder, straight(5.0, 5.9), segment=1)
    for number in range(3):
        event = hall.world.keyframe(further, number, first=len(hall.drives[1].T_world_camera))
        hall.live_map.apply(event)
        hall.live_map.apply(hall.world.links_of(len(hall.world.seen) - 1))
    hall.server.state.changes += 1

    assert (await hall.ask())["plan"] == first
    hall.setup.clock.jump(61.0)
    assert (await hall.ask())["plan"] != first


async def test_a_robot_that_joins_the_map_is_in_the_plan_at_once() -> None:
    hall = await Hall().start()  # cells are so large that no keyframe moves by half of one
    before = await hall.ask(resolution_m=0.5)
    apart = hall.world.drive(ROBOT.folder, straight(2.0, 4.0))
    for number in range(len(apart.T_world_camera)):
        hall.live_map.apply(hall.world.keyframe(apart, number))
    longer = hall.world.drive(OTHER.folder, straight(1.0, 5.2))
    hall.live_map.apply(hall.world.keyframe(longer, len(hall.drives[1].T_world_camera)))
    hall.server.state.changes += 1
    assert (await hall.ask(resolution_m=0.5))["version"] == before["version"]

    first = len(hall.world.seen) - len(apart.T_world_camera) - 1
    for keyframe in range(first, first + len(apart.T_world_camera)):
        hall.live_map.apply(hall.world.links_of(keyframe))
    assert hall.live_map.alignment_of(ROBOT.folder, 0).aligned
    hall.server.state.position += 1
    hall.server.state.changes += 1
    assert (await hall.ask(resolution_m=0.5))["version"] > before["version"]


async def test_points_that_arrive_late_are_in_the_next_plan() -> None:
    hall = await Hall(has_arrived=lambda robot: robot == ONE.folder).start()
    before = grid_of(await hall.ask())

    for name, points in hall.world.late.items():
        hall.store.put(name, points)
    hall.setup.clock.jump(61.0)
    after = grid_of(await hall.ask())

    assert np.mean(np.abs(depths_m(after, OCCUPIED) - WALL_M) < 0.1) > 0.9
    assert (after.cells == OCCUPIED).sum() > 1.5 * (before.cells == OCCUPIED).sum()


@pytest.mark.parametrize(
    ("request_", "error", "says"),
    [
        ({"up": None}, NotFound, "does not point up"),
        ({"resolution_m": 0.0}, BadRequest, "not within 0.01..10 m"),
        ({"up": (0.0, 0.0, 0.0)}, BadRequest, "no direction"),
        ({"floor_m": 50.0}, NotFound, "between the floor"),
    ],
)
async def test_a_plan_that_cannot_be_made_is_an_error_with_its_cause(
    request_: dict[str, Any], error: type[Exception], says: str
) -> None:
    hall = await Hall().start()
    with pytest.raises(error, match=says):
        await hall.ask(**request_)


async def test_an_empty_map_has_no_plan() -> None:
    server = await MapServerSetup(implementation=LIVE_MAP).start("a")
    with pytest.raises(NotFound, match="no keyframe"):
        await server.ask("live-floor-plan")
