"""Make exact trajectories through the simulated world, and yield the rendered frames of robots on them.

All robots follow one closed loop through the furnished rooms, each from another start, so that their maps
overlap.  The same arguments give the same frames.  No image library is needed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import islice

import numpy as np

from client_sdk.datasets.dataset import Dataset
from client_sdk.frontend import Frame
from client_sdk.simulator.renderer import Renderer, add_depth_noise, add_image_noise
from client_sdk.simulator.world import ROOM_M, ROOMS, World, make_world
from client_sdk.stereo.view import StereoView
from client_sdk.trajectory import Trajectory
from rse_pf.errors import UsageError
from rse_pf.geometry import Array, Camera

__all__ = [
    "RATE_HZ",
    "SIMULATED_CAMERA",
    "STEP_M",
    "frames_to_overlap",
    "loop_trajectory",
    "render_along",
    "render_frames",
    "render_pairs",
    "rendered_drive",
    "true_trajectory",
]

RATE_HZ = 5.0  # frames per second of a rendered drive, as in the paper's experiments (Sect. 6.2)
STEP_M = 0.068  # distance along the loop between two successive frames: a robot that drives at 0.34 m/s
SIMULATED_CAMERA = Camera(fx=525.0, fy=525.0, cx=319.5, cy=239.5, width=640, height=480)
"""Intrinsics of the rendered images: the nominal ones of a Kinect."""
_OVERLAP_M = 0.6  # distance that a robot drives past the start of the next robot, so that their maps overlap
_LUMA_WEIGHTS = (0.299, 0.587, 0.114)  # weights of red, green and blue in a grey image (ITU-R BT.601)
_EYE_HEIGHT_M = 1.25  # mean height of the camera above the floor
_LOOK_AHEAD_M = 1.0  # the camera looks in the horizontal direction of the point of the loop this far ahead
_SWAY_PERIOD_M = 1.7
"""Distance along the loop after which the height repeats; pitch and roll have longer periods."""
_PATH_STEP_M = 0.01  # distance between the points that describe the loop
_SMOOTHING_POINTS = 45
"""To round the corners of the loop, each point (1 cm apart) is replaced by the mean of itself and this many
points on either side; this is done twice."""

# Corners (x, y) of the loop in one room, metres.  x is measured from the beginning of the room, its wall with
# the smaller x; y is that of the world.  On the way there a robot drives to larger x, on the way back to
# smaller x.
_Corners = tuple[tuple[float, float], ...]
_WAY_THERE_WITHOUT_TABLE: _Corners = ((1.4, 1.75), (2.5, 1.65), (3.6, 1.75))
_WAY_THERE_WITH_TABLE: _Corners = ((1.3, 1.35), (2.5, 1.0), (3.7, 1.35))
_WAY_BACK_WITHOUT_TABLE: _Corners = ((3.6, 2.8), (2.5, 2.9), (1.4, 2.8))
_WAY_BACK_WITH_TABLE: _Corners = ((3.7, 3.2), (2.5, 3.45), (1.3, 3.2))
_AROUND_LAST_ROOM: _Corners = (
    (1.3, 1.35), (2.5, 1.0), (3.6, 1.4), (3.95, 2.3), (3.6, 3.2), (2.5, 3.45), (1.3, 3.2),
)  # fmt: skip
_AROUND_FIRST_ROOM: _Corners = (
    (3.7, 3.2), (2.5, 3.45), (1.4, 3.2), (1.05, 2.3), (1.4, 1.4), (2.5, 1.0), (3.7, 1.35),
)  # fmt: skip
_DOOR_ON_WAY_THERE = (0.0, 2.05)
_DOOR_ON_WAY_BACK = (0.0, 2.55)


def rendered_drive(robot: int, robots: int, frames: int, seed: int, rooms: int = ROOMS) -> Dataset:
    """Return the frames of `render_frames` and their exact poses as a recording.

    Arguments and errors are those of `render_frames`, but errors are raised at once.  A frame is rendered
    when it is first read, after all frames before it, and stays in memory.
    """
    truth = true_trajectory(robot, robots, frames, seed, rooms)
    rendering = render_frames(robot, robots, frames, seed, rooms)
    rendered: list[Frame] = []

    def read(row: int) -> Frame:
        rendered.extend(islice(rendering, max(0, row + 1 - len(rendered))))
        return rendered[row]

    return Dataset(
        name=f"world-{seed}",
        camera=SIMULATED_CAMERA,
        timestamps_s=tuple(truth.timestamps_s.tolist()),
        truth=truth,
        truth_kind="ground truth",
        rows=tuple(range(frames)),
        read=read,
        notes=(f"rendered, {RATE_HZ:g} Hz: exact poses, a Kinect's noise",),
    )


def render_frames(robot: int, robots: int, frames: int, seed: int, rooms: int = ROOMS) -> Iterator[Frame]:
    """Yield the RGB-D frames of one robot of a fleet; frame i has pose i of `true_trajectory`.

    Args:
        robot: Number of the robot, from 0.
        robots: Number of robots, whose starts are spread evenly over the loop.
        frames: Number of frames.
        seed: Seed of the world's textures, of the camera's swaying and of the sensor noise.
        rooms: Number of rooms in a row, 2 or more.

    Raises:
        UsageError: The robot is not one of *robots*, there are no frames, or fewer than 2 rooms; raised when
            the first frame is requested.
    """
    truth = true_trajectory(robot, robots, frames, seed, rooms)
    yield from render_along(truth, make_world(seed, rooms), (seed, robots, robot))


def render_along(truth: Trajectory, world: World, noise: Sequence[int]) -> Iterator[Frame]:
    """Yield the RGB-D frames of a simulated Kinect on a trajectory.

    Args:
        truth: Pose and time stamp of each frame.
        world: The world to draw.
        noise: Numbers that, followed by the index of the frame in *truth*, seed the noise of image and depth.
    """
    renderer = Renderer(world, SIMULATED_CAMERA)
    for row in range(len(truth)):
        rng = np.random.default_rng([*noise, row])
        colour, depth_m, cosine = renderer.draw(truth.T_world_camera[row])
        yield Frame(
            timestamp_s=float(truth.timestamps_s[row]),
            rgb=add_image_noise(colour, rng),
            depth_m=add_depth_noise(depth_m, cosine, rng),
            camera=SIMULATED_CAMERA,
        )


def render_pairs(truth: Trajectory, world: World, noise: Sequence[int], baseline_m: float) -> Iterator[Frame]:
    """Yield the frames of a rectified stereo camera whose left camera is on a trajectory.

    Their depth images are all 0.

    Args:
        truth: Pose of the left camera and time stamp of each frame.
        world: The world to draw.
        noise: Numbers that, followed by the index of the frame in *truth*, seed the noise of both images.
        baseline_m: Distance from the left camera to the right one, along x of the left camera.
    """
    renderer, T_left_right = Renderer(world, SIMULATED_CAMERA), np.eye(4)
    T_left_right[0, 3] = baseline_m
    for row in range(len(truth)):
        rng, T_world_left = np.random.default_rng([*noise, row]), truth.T_world_camera[row]
        left = add_image_noise(renderer.draw(T_world_left)[0], rng)
        right = add_image_noise(renderer.draw(T_world_left @ T_left_right)[0], rng)
        right_gray = np.rint(right @ np.array(_LUMA_WEIGHTS)).astype(np.uint8)
        yield Frame(
            timestamp_s=float(truth.timestamps_s[row]),
            rgb=left,
            depth_m=np.zeros(left.shape[:2], dtype=np.float32),
            camera=SIMULATED_CAMERA,
            stereo=StereoView(right_gray, baseline_m),
        )


def true_trajectory(robot: int, robots: int, frames: int, seed: int, rooms: int = ROOMS) -> Trajectory:
    """Return the exact poses ``T_world_camera`` of the frames of `render_frames` with the same arguments.

    The z axis of the world points up.  From frame to frame a robot moves by 6.8 cm and rotates by at most
    4 degrees; in three rooms the loop is about 28 m long.

    Raises:
        UsageError: The robot is not one of *robots*, there are no frames, or fewer than 2 rooms.
    """
    if not 0 <= robot < robots or frames < 1:
        raise UsageError(
            f"robot {robot} of {robots} with {frames} frames cannot be rendered",
            hint="count robots from 0, and ask for one frame or more",
        )
    return loop_trajectory(_make_loop(rooms)[1] * robot / robots, frames, seed, rooms)


def loop_trajectory(
    begin_m: float, frames: int, seed: int, rooms: int = ROOMS, *, step_m: float = STEP_M
) -> Trajectory:
    """Return exact poses ``T_world_camera`` on the loop, with time stamps 0.2 s apart from 0 on.

    The time stamps do not depend on *step_m*.  For rooms 0 to n - 1, the closed loop begins in the door
    between rooms 0 and 1.  It leads through rooms 1 to n - 2, around room n - 1, back through rooms n - 2 to
    1, around room 0, and to its beginning.

    Args:
        begin_m: Distance along the loop at which the first pose lies; it may be longer than the loop.
        frames: Number of poses.
        seed: Seed of the phase of the camera's swaying.
        rooms: Number of rooms in a row.
        step_m: Distance along the loop between two successive poses.

    Raises:
        UsageError: There are fewer than 2 rooms.
    """
    path, length_m = _make_loop(rooms)
    phase_rad = float(np.random.default_rng([seed, 7]).uniform(0.0, 2.0 * np.pi))
    poses = np.array([_pose_at(path, length_m, begin_m + step_m * row, phase_rad) for row in range(frames)])
    return Trajectory(np.arange(frames) / RATE_HZ, poses)


def frames_to_overlap(robots: int, rooms: int = ROOMS) -> int:
    """Return how many frames a robot needs to reach the start of the next robot and drive 0.6 m past it.

    The starts are spread evenly over the loop.  For a single robot, the next start is its own, after the
    whole loop.
    """
    return math.ceil((_make_loop(rooms)[1] / robots + _OVERLAP_M) / STEP_M)


def _make_loop(rooms: int) -> tuple[Array, float]:
    """Return the closed, rounded loop as ``(n, 2)`` points (x, y) about 1 cm apart, and its length (m)."""
    path = _resample(np.array(_loop_corners(rooms)))[0]
    for _ in range(2):
        path = _resample(_smooth(path))[0]
    return _resample(path)


def _loop_corners(rooms: int) -> list[tuple[float, float]]:
    """Return the corners (x, y) of the loop through a number of rooms, in the world, metres."""
    if rooms < 2:
        raise UsageError(f"a loop needs 2 rooms or more, not {rooms}", hint="ask for two rooms or more")
    parts: list[tuple[int, _Corners]] = []
    for room in range(1, rooms - 1):
        way = _WAY_THERE_WITH_TABLE if room % 2 == 0 else _WAY_THERE_WITHOUT_TABLE
        parts.append((room, (_DOOR_ON_WAY_THERE, *way)))
    parts.append((rooms - 1, (_DOOR_ON_WAY_THERE, *_AROUND_LAST_ROOM, _DOOR_ON_WAY_BACK)))
    for room in reversed(range(1, rooms - 1)):
        way = _WAY_BACK_WITH_TABLE if room % 2 == 0 else _WAY_BACK_WITHOUT_TABLE
        parts.append((room, (*way, _DOOR_ON_WAY_BACK)))
    parts.append((0, _AROUND_FIRST_ROOM))
    return [(round(room * ROOM_M + x, 2), y) for room, corners in parts for x, y in corners]


def _resample(points: Array) -> tuple[Array, float]:
    """Return points about 1 cm apart on the closed path through *points* ``(n, 2)``, and its length (m)."""
    closed = np.vstack((points, points[:1]))
    along = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))))
    distances = np.linspace(0.0, along[-1], round(along[-1] / _PATH_STEP_M), endpoint=False)
    resampled = np.column_stack([np.interp(distances, along, closed[:, axis]) for axis in range(2)])
    return resampled, float(along[-1])


def _smooth(path: Array) -> Array:
    """Return the moving average of a closed path ``(n, 2)`` over each point and 45 points on either side."""
    half = _SMOOTHING_POINTS
    window = np.ones(2 * half + 1) / (2 * half + 1)
    extended = np.vstack((path[-half:], path, path[:half]))
    return np.column_stack([np.convolve(extended[:, axis], window, mode="valid") for axis in range(2)])


def _pose_at(path: Array, length_m: float, distance_m: float, phase_rad: float) -> Array:
    """Return ``T_world_camera`` ``(4, 4)`` at a distance along the loop.

    The camera looks towards the point of the loop that is 1 m ahead and 7 degrees down, and sways a little in
    height, pitch and roll.  Its x axis points to the right, y down, and z forward.
    """
    position = _point_at(path, length_m, distance_m)
    ahead = _point_at(path, length_m, distance_m + _LOOK_AHEAD_M)
    yaw = np.arctan2(*(ahead - position)[::-1])
    sway = 2.0 * np.pi * distance_m / _SWAY_PERIOD_M + phase_rad
    pitch = np.radians(-7.0 + 1.2 * np.sin(0.6 * sway))
    roll = np.radians(0.8 * np.sin(0.8 * sway))
    height_m = _EYE_HEIGHT_M + 0.02 * np.sin(sway)
    forward = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
    level_right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    level_down = np.cross(forward, level_right)
    right = np.cos(roll) * level_right + np.sin(roll) * level_down
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2] = right, np.cross(forward, right), forward
    pose[:3, 3] = [*position, height_m]
    return pose


def _point_at(path: Array, length_m: float, distance_m: float) -> Array:
    """Return the point (x, y) at a distance along a closed path, interpolated between its points."""
    index = (distance_m % length_m) / length_m * len(path)
    low = int(index) % len(path)
    fraction = index - int(index)
    point: Array = (1.0 - fraction) * path[low] + fraction * path[(low + 1) % len(path)]
    return point
