"""Rendered drives of a robot with wheels and a tilted camera, and what its wheels report."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from client_sdk.frontend import Frame, TrackedFrame
from client_sdk.mapper import Mapper
from client_sdk.simulator import make_world
from client_sdk.simulator.renderer import Renderer, add_depth_noise, add_image_noise
from client_sdk.wheel_odometry import OdometryReading
from rse_pf.geometry import Array, Camera, exp_se3, inverse

__all__ = [
    "CAMERA",
    "T_BASE_CAMERA",
    "WheeledDrive",
    "base_errors_m",
    "covered",
    "make_drive",
    "track_with_wheels",
    "wheels_error_m",
]

CAMERA = Camera(fx=262.5, fy=262.5, cx=159.5, cy=119.5, width=320, height=240)
T_BASE_CAMERA: Array = np.eye(4)
"""Mount of the camera: 0.15 m ahead of the base, 0.9 m above it, tilted down by 15 degrees."""
T_BASE_CAMERA[:3, :3] = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
T_BASE_CAMERA[:3, 3] = 0.15, 0.0, 0.9
T_BASE_CAMERA = T_BASE_CAMERA @ exp_se3(np.array([0.0, 0.0, 0.0, -math.radians(15.0), 0.0, 0.0]))
_FRAME_HZ = 10.0
_READING_HZ = 50.0
_SPEED_M_S = 0.5
_MEAN_RADIUS_M = 1.2
_TRACK_M = 0.4  # distance of the two wheels


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WheeledDrive:
    """Frames of a drive, the true poses of the base, and the readings of the wheels.

    Attributes:
        frames: The frames, at 10 Hz.
        T_world_base: ``(n, 4, 4)`` of each frame, relative to the first.
        readings: At 50 Hz.
    """

    frames: list[Frame]
    T_world_base: Array
    readings: list[OdometryReading]

    def since_last(self, row: int) -> list[OdometryReading]:
        """Return the readings between frame *row* - 1 and *row*."""
        begin_s = self.frames[row - 1].timestamp_s if row else -math.inf
        end_s = self.frames[row].timestamp_s
        return [reading for reading in self.readings if begin_s < reading.timestamp_s <= end_s]


def make_drive(
    count: int,
    *,
    seed: int = 1,
    scale: float = 1.0,
    late_s: float = 0.0,
    left: float = 1.0,
    frozen_after_s: float = math.inf,
    slip: float = 0.05,
    bias: float = 0.01,
    has_images: bool = True,
) -> WheeledDrive:
    """Return a drive of *count* frames on a closed path that swings to both sides.

    Args:
        count: Number of frames.
        seed: Seed of the noise.
        scale: Factor of all lengths of the wheels.
        late_s: How late the readings are stamped, in seconds.
        left: Share of the way of the left wheel that is measured; 0 for a blocked one.
        frozen_after_s: Time after which the readings repeat.
        slip: Standard deviation of the way of a wheel in one step, as a share.
        bias: Constant error of the way of each wheel, as a share.
        has_images: Whether the frames are drawn; without, there is none.
    """
    rng = np.random.default_rng(seed)
    stamps_s = np.arange(int(count / _FRAME_HZ * _READING_HZ) + 1) / _READING_HZ
    truth = np.array([_base_at(stamp_s) for stamp_s in stamps_s])
    rows = (np.arange(count) * _READING_HZ / _FRAME_HZ).astype(int)
    renderer = Renderer(make_world(seed, 2), CAMERA)
    frames = []
    for row in rows if has_images else ():
        colour, depth_m, cosine = renderer.draw(truth[row] @ T_BASE_CAMERA)
        frames.append(
            Frame(
                timestamp_s=float(stamps_s[row]),
                rgb=add_image_noise(colour, rng),
                depth_m=add_depth_noise(depth_m, cosine, rng),
                camera=CAMERA,
            )
        )
    # Both wheels of a differential drive measure their ways with noise.
    pose, readings = np.eye(4), []
    biases = bias * rng.standard_normal(2)
    for n, stamp_s in enumerate(stamps_s):
        if n and stamp_s <= frozen_after_s:
            step = inverse(truth[n - 1]) @ truth[n]
            way_m, yaw = step[0, 3], math.atan2(step[1, 0], step[0, 0])
            ways = np.array([way_m - yaw * _TRACK_M / 2, way_m + yaw * _TRACK_M / 2])
            ways *= scale * (1.0 + biases + slip * rng.standard_normal(2)) * (left, 1.0)
            forward_m, turn = ways.mean(), (ways[1] - ways[0]) / _TRACK_M
            pose = pose @ exp_se3(np.array([forward_m, 0.0, 0.0, 0.0, 0.0, turn]))
        readings.append(OdometryReading(timestamp_s=float(stamp_s) + late_s, T_odom_base=pose))
    return WheeledDrive(frames=frames, T_world_base=inverse(truth[0]) @ truth[rows], readings=readings)


def track_with_wheels(
    mapper: Mapper, drive: WheeledDrive, rows: Iterable[int] | None = None, *, has_wheels: bool = True
) -> list[TrackedFrame]:
    """Return what a mapper makes of the frames of a drive and the readings of its wheels."""

    async def track() -> list[TrackedFrame]:
        chosen = range(len(drive.frames)) if rows is None else rows
        return [
            await mapper.track(drive.frames[row], odometry=drive.since_last(row) if has_wheels else ())
            for row in chosen
        ]

    return asyncio.run(track())


def base_errors_m(tracked: Iterable[TrackedFrame], drive: WheeledDrive) -> Array:
    """Return the ``(n,)`` distance of each frame's base from its true place, metres; NaN without a pose."""
    poses = [math.nan * np.eye(4) if each.T_world_base is None else each.T_world_base for each in tracked]
    apart_m = np.array(poses)[:, :3, 3] - drive.T_world_base[: len(poses), :3, 3]
    return np.asarray(np.linalg.norm(apart_m, axis=1))


def wheels_error_m(drive: WheeledDrive, begin: int, end: int) -> float:
    """Return the error of the motion by wheels alone between two frames, in metres."""
    stamps_s = [reading.timestamp_s for reading in drive.readings]
    wheels = [
        drive.readings[int(np.searchsorted(stamps_s, drive.frames[row].timestamp_s - 1e-6))].T_odom_base
        for row in (begin, end)
    ]
    truth = inverse(drive.T_world_base[begin]) @ drive.T_world_base[end]
    return float(np.linalg.norm((inverse(wheels[0]) @ wheels[1])[:3, 3] - truth[:3, 3]))


def covered(drive: WheeledDrive, begin: int, end: int) -> WheeledDrive:
    """Return a drive whose lens is covered from frame *begin* to before *end*."""
    frames = [
        replace(frame, rgb=np.zeros_like(frame.rgb), depth_m=np.zeros_like(frame.depth_m))
        if begin <= row < end
        else frame
        for row, frame in enumerate(drive.frames)
    ]
    return replace(drive, frames=frames)


def _base_at(stamp_s: float) -> Array:
    """Return the pose of the base in the world of the simulator: it drives along its x axis."""
    position, ahead = _position_at(stamp_s), _position_at(stamp_s + 1e-4)
    yaw = math.atan2(*(ahead - position)[::-1])
    T = np.eye(4)
    T[:2, :2] = [[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]]
    T[:2, 3] = position
    return T


def _position_at(stamp_s: float) -> Array:
    """Return the ``(2,)`` position on an ellipse around the middle of the first room, which swings."""
    angle = _SPEED_M_S * stamp_s / _MEAN_RADIUS_M - math.pi / 2
    swing = 1.0 + 0.12 * math.sin(1.3 * stamp_s)
    return np.array([2.5 + 1.1 * swing * math.cos(angle), 2.3 + 1.25 * swing * math.sin(angle)])
