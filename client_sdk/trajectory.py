"""Hold the trajectory of a camera, interpolate it, and write and read it in TUM format."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from client_sdk.source_facts import stamps_in_seconds
from rse_pf.errors import UsageError
from rse_pf.geometry import Array, body_poses, exp_se3, from_quaternion, inverse, log_se3, to_quaternion
from rse_pf.storage.files import read_regular_file

__all__ = ["Trajectory", "read_odometry", "read_trajectory", "write_trajectory"]

_BODY_SUFFIX = "-body"
"""Suffix of the file name of a body's trajectory: ``trajectory-body.txt``, written next to the camera's
``trajectory.txt``."""
_MAX_FILE_BYTES = 256 << 20  # a larger trajectory file is refused; this one has about 3 million poses
_MIN_STEP_S = 1e-9  # time between two poses with equal stamps in an interpolation, to avoid a division by 0


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Poses of a camera over time.

    Attributes:
        timestamps_s: ``(n,)`` seconds, in any order.
        T_world_camera: ``(n, 4, 4)``, translations in metres or up to scale.

    Raises:
        UsageError: The shapes do not fit.
    """

    timestamps_s: Array
    T_world_camera: Array

    def __post_init__(self) -> None:
        if self.T_world_camera.shape != (len(self.timestamps_s), 4, 4):
            raise UsageError(
                f"{len(self.timestamps_s)} time stamps and poses of shape {self.T_world_camera.shape} "
                "do not fit",
                hint="give one (4, 4) pose for each time stamp",
            )

    def __len__(self) -> int:
        return len(self.timestamps_s)

    @property
    def positions(self) -> Array:
        """Positions ``(n, 3)`` of the camera in the world, in the unit of the poses."""
        return self.T_world_camera[:, :3, 3]

    @property
    def length_m(self) -> float:
        """Length of the path, in metres or in the unit of a trajectory up to scale.

        It is the sum of the distances between consecutive poses.
        Poses count in the order of the arrays, whatever their time stamps are.
        """
        return float(np.linalg.norm(np.diff(self.positions, axis=0), axis=1).sum())

    def at(self, stamps_s: npt.ArrayLike) -> Array:
        """Return ``(n, 4, 4)`` poses at other times, interpolated with a constant twist between two poses.

        The poses of the trajectory are sorted by their time stamps for this.
        Before the first time stamp this is the first pose, after the last time stamp the last pose.  The
        trajectory must have two or more poses.
        """
        order = np.argsort(self.timestamps_s, kind="stable")
        stamps, known = np.atleast_1d(np.asarray(stamps_s, dtype=float)), self.timestamps_s[order]
        poses = self.T_world_camera[order]
        after = np.clip(np.searchsorted(known, stamps), 1, len(known) - 1)
        step_s = np.maximum(known[after] - known[after - 1], _MIN_STEP_S)
        fractions = np.clip((stamps - known[after - 1]) / step_s, 0.0, 1.0)
        start, end = poses[after - 1], poses[after]
        interpolated: Array = start @ exp_se3(fractions[:, None] * log_se3(inverse(start) @ end))
        return interpolated


def write_trajectory(
    path: Path, trajectory: Trajectory, *, is_metric: bool = True, T_body_camera: Array | None = None
) -> None:
    """Write a trajectory in TUM format: ``timestamp tx ty tz qx qy qz qw``.

    Args:
        path: File to write.
        trajectory: Poses of a camera.
        is_metric: Whether the unit is the metre or arbitrary, which the file says in a comment.
        T_body_camera: ``(4, 4)`` pose of the camera in the body frame of its rig.  With it, and in metres, a
            second file gets the poses of the body: ``trajectory-body.txt`` for ``trajectory.txt``.

    Raises:
        OSError: A file cannot be written.
    """
    unit = "metres" if is_metric else "up to scale: the unit is arbitrary"
    _write_poses(path, trajectory.timestamps_s, trajectory.T_world_camera, f"T_world_camera, {unit}")
    if T_body_camera is not None and is_metric:
        bodies = body_poses(trajectory.T_world_camera, T_body_camera)
        body_path = path.with_name(f"{path.stem}{_BODY_SUFFIX}{path.suffix}")
        _write_poses(body_path, trajectory.timestamps_s, bodies, f"T_world_body, {unit}")


def _write_poses(path: Path, timestamps_s: Array, poses: Array, comment: str) -> None:
    lines = [f"# timestamp tx ty tz qx qy qz qw  ({comment})"]
    for timestamp_s, pose in zip(timestamps_s, poses, strict=True):
        numbers = [*pose[:3, 3], *to_quaternion(pose[:3, :3])]
        lines.append(f"{timestamp_s:.6f} " + " ".join(f"{number:.9f}" for number in numbers))
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


def read_trajectory(path: Path) -> Trajectory:
    """Return the trajectory of a file in TUM format; empty lines and lines that begin with ``#`` are skipped.

    Commas count as spaces, and quaternions may have any length above 0.  The poses are in the order of the
    lines; a file without poses gives an empty trajectory.

    Raises:
        UsageError: The file cannot be read, or a line does not hold eight finite numbers with a quaternion
            that is not zero.
    """
    try:
        text = read_regular_file(path, _MAX_FILE_BYTES).decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"cannot read {path}: {error}", hint="name a trajectory in TUM format") from error
    timestamps_s: list[float] = []
    poses: list[Array] = []
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.replace(",", " ").split()
        if not words or words[0].startswith("#"):
            continue
        try:
            values = np.array([float(word) for word in words])
        except ValueError:
            values = np.empty(0)
        if len(values) != 8 or not np.isfinite(values).all() or not np.linalg.norm(values[4:]) > 0:
            raise UsageError(
                f"{path}, line {number} is not a pose", hint="write timestamp tx ty tz qx qy qz qw"
            )
        pose = np.eye(4)
        pose[:3, :3] = from_quaternion(values[4:])
        pose[:3, 3] = values[1:4]
        timestamps_s.append(float(values[0]))
        poses.append(pose)
    return Trajectory(np.array(timestamps_s), np.array(poses).reshape(-1, 4, 4))


def read_odometry(file: Path) -> Trajectory:
    """Read a path in TUM format, and convert its time stamps to seconds if they have another unit.

    Raises:
        UsageError: The file is broken, or holds fewer than two poses.
    """
    path = read_trajectory(file)
    if len(path) < 2:
        raise UsageError(f"{file} holds {len(path)} poses", hint="give a path of 2 poses or more")
    return Trajectory(stamps_in_seconds(path.timestamps_s, str(file))[0], path.T_world_camera)
