"""Maps with an exact ground truth: points that all keyframes see, and a rendered world with its plan."""

from __future__ import annotations

import functools

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array, Camera, exp_se3, inverse, transform
from rse_pf.maps.format import Keyframe, MapVersion
from rse_pf.slam.occupancy import OccupancyGrid

__all__ = ["CAMERA", "OTHER_CAMERA", "plan_of_world", "points_map", "shares_right", "world_map"]

CAMERA = Camera(fx=500.0, fy=510.0, cx=320.0, cy=238.0, width=640, height=480)
OTHER_CAMERA = Camera(fx=400.0, fy=400.0, cx=300.0, cy=200.0, width=600, height=400)
WORLD = {"seed": 3, "robot": 0, "robots": 1, "frames": 150}


def points_map(
    *,
    keyframes: int = 5,
    points: int = 60,
    robot: str = "robot-1",
    cameras: tuple[Camera, ...] = (CAMERA,),
    wrong: int = 0,
    up: list[float] | None = None,
) -> tuple[MapVersion, Array]:
    """Return a map whose keyframes all see the same points, and the true points ``(n, 3)`` in the world.

    The features of each keyframe are in another order.  The pixels of the first *wrong* features of each
    keyframe are 50 px off.
    """
    rng = np.random.default_rng([7, keyframes, points])
    world = rng.uniform([-1.0, -0.7, 2.0], [1.0, 0.7, 4.0], (points, 3))
    descriptors = rng.integers(0, 256, (points, 32), dtype=np.uint8)
    made = []
    for number in range(keyframes):
        camera = cameras[number % len(cameras)]
        T = exp_se3(rng.normal(0.0, 0.04, 6))
        T[0, 3] += 0.1 * number
        order = rng.permutation(points)
        seen = transform(inverse(T), world[order])
        pixels = camera.project(seen)
        pixels[:wrong] += 50.0
        made.append(
            Keyframe(
                id=10 * number,
                robot=robot,
                timestamp_s=float(number),
                T_world_camera=T,
                camera=camera,
                pixels=pixels.astype(np.float32),
                descriptors=descriptors[order],
                points_camera=seen.astype(np.float32),
            )
        )
    colours = np.tile(np.array([200, 100, 50], dtype=np.uint8), (points, 1))
    provenance = {} if up is None else {"up": up}
    cloud = world.astype(np.float32)
    return MapVersion(keyframes=tuple(made), points=cloud, colours=colours, provenance=provenance), world


@functools.cache
def world_map() -> MapVersion:
    """Return a map of the rendered world with true poses; its z axis points up, without the field ``up``."""
    from client_sdk.frontend import FrontEndOptions, extract
    from client_sdk.point_map import PointMap
    from client_sdk.simulator.drive import render_along, true_trajectory
    from client_sdk.simulator.world import make_world
    from client_sdk.trajectory import Trajectory

    truth = true_trajectory(WORLD["robot"], WORLD["robots"], WORLD["frames"], WORLD["seed"])
    rows = np.arange(0, len(truth), 6)
    path = Trajectory(truth.timestamps_s[rows], truth.T_world_camera[rows])
    cloud, made = PointMap(), []
    for number, frame in enumerate(render_along(path, make_world(WORLD["seed"]), (WORLD["seed"], 1))):
        features = extract(frame, FrontEndOptions())
        T = path.T_world_camera[number]
        cloud.add(frame, T)
        made.append(
            Keyframe(
                id=number,
                robot="robot-1",
                timestamp_s=frame.timestamp_s,
                T_world_camera=T,
                camera=frame.camera,
                pixels=features.pixels.astype(np.float32),
                descriptors=features.descriptors,
                points_camera=features.points_camera.astype(np.float32),
            )
        )
    points, colours = cloud.points(min_readings=2)
    return MapVersion(keyframes=tuple(made), points=points, colours=colours)


def plan_of_world(x: Array, y: Array, low_m: float, high_m: float) -> npt.NDArray[np.bool_]:
    """Return at which positions the rendered world is occupied between two heights."""
    from client_sdk.simulator.world import DEPTH_M, DOOR_Y_M, ROOM_M, ROOMS, make_world

    faces = make_world(WORLD["seed"]).faces
    under = {(face.low, face.high): face.offset for face in faces if face.axis == 2 and face.sign < 0}
    solid: npt.NDArray[np.bool_] = (x < 0) | (x > ROOMS * ROOM_M) | (y < 0) | (y > DEPTH_M)
    for face in faces:  # tops of boxes
        bottom = under.get((face.low, face.high))
        if (
            face.axis == 2
            and face.sign > 0
            and face.offset > low_m
            and bottom is not None
            and bottom < high_m
        ):
            solid |= (x >= face.low[0]) & (x <= face.high[0]) & (y >= face.low[1]) & (y <= face.high[1])
    for door in range(1, ROOMS):
        solid |= (np.abs(x - door * ROOM_M) <= 0.06) & ~((y > DOOR_Y_M[0]) & (y < DOOR_Y_M[1]))
    return solid


def shares_right(grid: OccupancyGrid, low_m: float, high_m: float) -> tuple[float, float, float]:
    """Return the shares of correct cells among all known cells, the free cells, and the occupied cells.

    A free cell is correct if its centre is free in the world, an occupied cell if any part of it is occupied.
    """
    from rse_pf.slam.occupancy import FREE, OCCUPIED

    fine, (height, width) = 5, grid.cells.shape
    step = grid.resolution_m / fine
    xs = grid.origin_m[0] + (np.arange(width * fine) + 0.5) * step
    ys = grid.origin_m[1] + (np.arange(height * fine) + 0.5) * step
    solid = plan_of_world(*np.meshgrid(xs, ys), low_m, high_m).reshape(height, fine, width, fine)
    free, occupied = grid.cells == FREE, grid.cells == OCCUPIED
    right_free = free & ~solid[:, fine // 2, :, fine // 2]
    right_occupied = occupied & solid.any(axis=(1, 3))
    right = right_free.sum() + right_occupied.sum()
    return (
        float(right / (free.sum() + occupied.sum())),
        float(right_free.sum() / free.sum()),
        float(right_occupied.sum() / occupied.sum()),
    )
