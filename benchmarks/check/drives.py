"""Drives in which faults are planted: rendered rooms with exact poses, and recordings; both with odometry."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from client_sdk.datasets import open_dataset
from client_sdk.frontend import Frame
from client_sdk.imu.samples import ImuModel
from client_sdk.simulator import loop_trajectory, make_world, render_along, render_pairs
from client_sdk.trajectory import Trajectory
from rse_pf.geometry import Array, exp_se3, inverse
from tests.kit.inertial_drive import InertialDrive, Motion

__all__ = ["CheckedDrive", "recorded_drive", "rendered_drive"]

RATE_HZ = 10.0  # frames per second of a rendered drive
_ODOMETRY_HZ = 20.0  # poses per second of the odometry of a rendered drive
_STEP_M = 0.034  # distance, metres, that a camera on wheels moves between two frames
# Relative standard deviation of the metric scale of an odometry, one value per drive.
_SCALE_DEVIATION = 0.003
_STEP_NOISE_M = 0.0005  # standard deviation, metres per axis, of the translation of each step of an odometry
_STEP_NOISE_RAD = 0.0004  # standard deviation, radians per axis, of the rotation of each step of an odometry
_BASELINE_M = 0.11  # distance, metres, between the two cameras of a stereo pair


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CheckedDrive:
    """A drive without a fault: frames, the true poses at their time stamps, and odometry at its own rate."""

    name: str
    frames: Sequence[Frame]
    truth: Trajectory
    odometry: Trajectory | None


def rendered_drive(seed: int, frames: int = 150, *, stereo: bool = False) -> CheckedDrive:
    """Return a rendered drive through the rooms of *seed*: on wheels if it is even, hand-held if it is odd.

    Frames have depth images, or if *stereo* the images of a second camera.
    """
    every = round(_ODOMETRY_HZ / RATE_HZ)
    make = partial(_wheels if seed % 2 == 0 else _hand, seed)
    dense = make(every * frames + 10)
    rows = slice(0, every * frames, every)
    truth = Trajectory(dense.timestamps_s[rows], dense.T_world_camera[rows])
    world, noise = make_world(seed), (seed, 41)
    made = render_pairs(truth, world, noise, _BASELINE_M) if stereo else render_along(truth, world, noise)
    return CheckedDrive(
        name=f"{'pairs' if stereo else 'world'}-{seed}",
        frames=list(made),
        truth=truth,
        odometry=odometry_of(dense, seed),
    )


def recorded_drive(folder: Path, first: int = 0, frames: int | None = None) -> CheckedDrive:
    """Return a recording, or a part of it; its true poses serve as odometry."""
    dataset = open_dataset(folder)
    chosen = [dataset.read(row) for row in dataset.rows[first : None if frames is None else first + frames]]
    assert dataset.truth is not None
    return CheckedDrive(name=dataset.name, frames=chosen, truth=dataset.truth, odometry=dataset.truth)


def odometry_of(truth: Trajectory, seed: int) -> Trajectory:
    """Return the path *truth* as odometry measures it: each step with noise, all steps with a wrong scale."""
    rng = np.random.default_rng([seed, 42])
    scale = 1.0 + _SCALE_DEVIATION * float(rng.standard_normal())
    poses = [np.eye(4)]
    true = truth.T_world_camera
    for before, after in itertools.pairwise(true):
        step = inverse(before) @ after
        step[:3, 3] *= scale
        noise = rng.standard_normal(6) * np.repeat((_STEP_NOISE_M, _STEP_NOISE_RAD), 3)
        poses.append(poses[-1] @ step @ exp_se3(noise))
    return Trajectory(truth.timestamps_s, np.array(poses))


def _wheels(seed: int, poses: int) -> Trajectory:
    """Return the path of a camera on wheels along the loop through the rooms, *poses* at `_ODOMETRY_HZ`."""
    rng = np.random.default_rng([seed, 43])
    path = loop_trajectory(
        float(rng.uniform(0.0, 28.0)), poses, seed, step_m=_STEP_M * RATE_HZ / _ODOMETRY_HZ
    )
    return Trajectory(np.arange(poses) / _ODOMETRY_HZ, path.T_world_camera)


def _hand(seed: int, poses: int) -> Trajectory:
    """Return the path of a hand-held camera that stays near the centre of the middle room of `make_world`.

    Translation and rotation are sums of slow sines (`InertialDrive`): about 0.5 m at most from the mean
    position, which is in the middle of the room, and about 0.5 rad from the first orientation.  *poses* is
    the number of poses, at the rate of the odometry.
    """
    model = ImuModel(
        T_imu_camera=np.eye(4), gyro_noise=1e-3, gyro_walk=1e-5, accel_noise=1e-2, accel_walk=1e-4,
        rate_hz=200.0,
    )  # fmt: skip
    drive = InertialDrive(model, Motion(reach_m=0.5, turn_rad=0.5, fastest_hz=0.25), seed)
    stamps_s = np.arange(poses) / _ODOMETRY_HZ
    T: Array = drive.T_world_camera(stamps_s).copy()
    T[:, :3, 3] += np.array([7.5, 2.3, 1.3]) - T[:, :3, 3].mean(axis=0)
    return Trajectory(stamps_s, T)
