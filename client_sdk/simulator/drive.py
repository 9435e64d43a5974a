"""Rendered frames with exact poses, for robots without a recording.

Robots follow one loop through three furnished rooms, or as many as are asked for; each starts at a different
point of it, so their maps overlap.  The same arguments give the same frames.  No image library is needed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from client_sdk.frontend import Frame
from client_sdk.simulator.camera import Painter, add_depth_noise, add_image_noise
from client_sdk.simulator.world import ROOM_M, ROOMS, World, make_world
from client_sdk.stereo.view import StereoView
from client_sdk.trajectory import Trajectory
from rse_pf.errors import UsageError
from rse_pf.geometry import Array, Camera

__all__ = [
    "RATE_HZ", "SIMULATED_CAMERA", "STEP_M", "frames_to_overlap", "loop_trajectory", "render_along",
    "render_frames", "render_pairs", "true_trajectory",
]  # fmt: skip

RATE_HZ = 5.0
"""The paper's frame rate (Sect. 6.2)."""
STEP_M = 0.068
"""Distance between frames: a robot that drives at 0.34 m/s."""
_OVERLAP_M = 0.6
"""Path that a robot drives beyond the start of the next one, so that their maps can be merged."""
SIMULATED_CAMERA = Camera(fx=525.0, fy=525.0, cx=319.5, cy=239.5, width=640, height=480)

# Corners of the loop through all doors, from the left wall of a room: on the way there and back, past its
# table if it has one, and around the middle of the last and the first room.
_THERE_M = ((1.4, 1.75), (2.5, 1.65), (3.6, 1.75)), ((1.3, 1.35), (2.5, 1.0), (3.7, 1.35))
_BACK_M = ((3.6, 2.8), (2.5, 2.9), (1.4, 2.8)), ((3.7, 3.2), (2.5, 3.45), (1.3, 3.2))
_LAST_M = ((1.3, 1.35), (2.5, 1.0), (3.6, 1.4), (3.95, 2.3), (3.6, 3.2), (2.5, 3.45), (1.3, 3.2))
_FIRST_M = ((3.7, 3.2), (2.5, 3.45), (1.4, 3.2), (1.05, 2.3), (1.4, 1.4), (2.5, 1.0), (3.7, 1.35))
_IN_M, _OUT_M = (0.0, 2.05), (0.0, 2.55)


def render_frames(robot: int, robots: int, frames: int, seed: int, rooms: int = ROOMS) -> Iterator[Frame]:
    """Yield the frames of robot 0, 1, ... of *robots*; frame *i* is seen from ``true_trajectory[i]``.

    Raises:
        UsageError: The robot is not one of *robots*, or there are no frames.
    """
    truth = true_trajectory(robot, robots, frames, seed, rooms)
    yield from render_along(truth, make_world(seed, rooms), (seed, robots, robot))


def render_along(truth: Trajectory, world: World, noise: Sequence[int]) -> Iterator[Frame]:
    """Yield the frames of a camera on *truth* in *world*; the numbers *noise* seed that of its sensor."""
    painter = Painter(world, SIMULATED_CAMERA)
    for row in range(len(truth)):
        rng = np.random.default_rng([*noise, row])
        colour, depth_m, cosine = painter.draw(truth.T_world_camera[row])
        yield Frame(
            timestamp_s=float(truth.timestamps_s[row]),
            rgb=add_image_noise(colour, rng),
            depth_m=add_depth_noise(depth_m, cosine, rng),
            camera=SIMULATED_CAMERA,
        )


def render_pairs(truth: Trajectory, world: World, noise: Sequence[int], baseline_m: float) -> Iterator[Frame]:
    """Yield the frames of a rectified stereo camera whose left one is on *truth*, as `render_along`."""
    painter, right = Painter(world, SIMULATED_CAMERA), np.eye(4)
    right[0, 3] = baseline_m
    for row in range(len(truth)):
        rng, pose = np.random.default_rng([*noise, row]), truth.T_world_camera[row]
        left, beside = (add_image_noise(painter.draw(T)[0], rng) for T in (pose, pose @ right))
        # Weights of brightness after ITU-R BT.601.
        gray = np.rint(beside @ np.array([0.299, 0.587, 0.114])).astype(np.uint8)
        yield Frame(
            timestamp_s=float(truth.timestamps_s[row]),
            rgb=left,
            depth_m=np.zeros(left.shape[:2], dtype=np.float32),
            camera=SIMULATED_CAMERA,
            stereo=StereoView(gray, baseline_m),
        )


def true_trajectory(robot: int, robots: int, frames: int, seed: int, rooms: int = ROOMS) -> Trajectory:
    """Return the exact ``T_world_camera`` of `render_frames`; the world's z axis points up.

    Robots are spread evenly over the loop, which in three rooms is about 28 m long; a robot takes 6.8 cm and
    at most 4 degrees from one frame to the next, so 80 frames are a path of 5.4 m.

    Raises:
        UsageError: The robot is not one of *robots*, or there are no frames, or less than two rooms.
    """
    if not 0 <= robot < robots or frames < 1:
        raise UsageError(
            f"robot {robot} of {robots} with {frames} frames cannot be rendered",
            hint="count robots from 0, and ask for one frame or more",
        )
    return loop_trajectory(_loop(rooms)[1] * robot / robots, frames, seed, rooms)


def loop_trajectory(
    begin_m: float, frames: int, seed: int, rooms: int = ROOMS, *, step_m: float = STEP_M
) -> Trajectory:
    """Return *frames* exact poses ``T_world_camera`` on the loop, from *begin_m* on.

    The loop begins at the door of room 1, and leads through each of the rooms before the last one in 5 m.
    """
    path, length_m = _loop(rooms)
    phase = float(np.random.default_rng([seed, 7]).uniform(0.0, 2.0 * np.pi))
    poses = np.array([_pose_at(path, length_m, begin_m + step_m * row, phase) for row in range(frames)])
    return Trajectory(np.arange(frames) / RATE_HZ, poses)


def frames_to_overlap(robots: int, rooms: int = ROOMS) -> int:
    """Return the frames with which each robot reaches the start of the next one, and drives past it.

    One robot alone reaches its own start.
    """
    return math.ceil((_loop(rooms)[1] / robots + _OVERLAP_M) / STEP_M)


def _corners(rooms: int) -> list[tuple[float, float]]:
    """Return the corners of the loop through a number of rooms."""
    if rooms < 2:
        raise UsageError(f"a loop needs two rooms, not {rooms}", hint="ask for two rooms or more")
    between, last = range(1, rooms - 1), rooms - 1
    there = [(room, (_IN_M, *_THERE_M[room % 2 == 0])) for room in between]
    back = [(room, (*_BACK_M[room % 2 == 0], _OUT_M)) for room in reversed(between)]
    parts = [*there, (last, (_IN_M, *_LAST_M, _OUT_M)), *back, (0, _FIRST_M)]
    return [(round(room * ROOM_M + x, 2), y) for room, corners in parts for x, y in corners]


def _loop(rooms: int) -> tuple[Array, float]:
    """Return the closed path as ``(n, 2)`` points one centimetre apart, and its length."""
    corners = np.array(_corners(rooms))
    path = _resample(corners, 0.01)[0]
    for _ in range(2):
        path = _resample(_smooth(path, 45), 0.01)[0]
    return _resample(path, 0.01)


def _resample(corners: Array, step_m: float) -> tuple[Array, float]:
    closed = np.vstack((corners, corners[:1]))
    along = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))))
    positions = np.linspace(0.0, along[-1], round(along[-1] / step_m), endpoint=False)
    points = np.column_stack([np.interp(positions, along, closed[:, axis]) for axis in range(2)])
    return points, float(along[-1])


def _smooth(path: Array, half: int) -> Array:
    """Return the running mean over *half* points to either side of a closed path."""
    window = np.ones(2 * half + 1) / (2 * half + 1)
    around = np.vstack((path[-half:], path, path[:half]))
    return np.column_stack([np.convolve(around[:, axis], window, mode="valid") for axis in range(2)])


def _pose_at(path: Array, length_m: float, travelled_m: float, phase: float) -> Array:
    """Return the pose at a distance along the loop: looking ahead, slightly down, swaying a little."""
    position, ahead = (_point(path, length_m, travelled_m + more) for more in (0.0, 1.0))
    yaw = np.arctan2(*(ahead - position)[::-1])
    wave = 2.0 * np.pi * travelled_m / 1.7 + phase
    pitch = np.radians(-7.0 + 1.2 * np.sin(0.6 * wave))
    roll = np.radians(0.8 * np.sin(0.8 * wave))
    height_m = 1.25 + 0.02 * np.sin(wave)
    forward = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
    level_right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    level_down = np.cross(forward, level_right)
    right = np.cos(roll) * level_right + np.sin(roll) * level_down
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2] = right, np.cross(forward, right), forward
    pose[:3, 3] = [*position, height_m]
    return pose


def _point(path: Array, length_m: float, travelled_m: float) -> Array:
    place = (travelled_m % length_m) / length_m * len(path)
    low = int(place) % len(path)
    share = place - int(place)
    point: Array = (1.0 - share) * path[low] + share * path[(low + 1) % len(path)]
    return point
