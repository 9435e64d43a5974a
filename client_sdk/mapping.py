"""Point-cloud maps and trajectories of one robot, in memory and in files (PLY, TUM).

The time to add a frame does not depend on the size of the map, and the memory of a map is bounded.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest, UsageError
from rse_pf.files import read_regular_file
from rse_pf.geometry import (
    Array,
    body_poses,
    exp_se3,
    from_quaternion,
    inverse,
    log_se3,
    to_quaternion,
    transform,
)
from rse_pf.native import PART_ABIS, address_of, aligned, core_function
from rse_pf.slam.ply import decode_ply, encode_ply

if TYPE_CHECKING:
    from client_sdk.frontend import Frame

__all__ = [
    "MapOptions",
    "PointMap",
    "Trajectory",
    "read_ply",
    "read_trajectory",
    "write_ply",
    "write_trajectory",
]

BODY_SUFFIX = "-body"
"""Behind the name of a trajectory of a camera: that of the body of its rig."""
_MAX_TRAJECTORY_BYTES = 256 << 20
_EMPTY = -1
# Voxels on either side of the origin: three signed indices of 21 bits fill one int64 key.
_REACH = 1 << 20
_NO_READINGS = np.empty((0, 3)), np.empty((0, 3), dtype=np.float32), np.empty(0, dtype=np.int32)


@dataclass(frozen=True, slots=True, kw_only=True)
class MapOptions:
    """The density of a map, and which depth readings are used.

    Attributes:
        voxel_m: Length of a voxel's edge; each voxel holds one point.
        min_depth_m: Nearer readings are not used.
        max_depth_m: Farther readings are not used.
        every_px: Take every n-th row and column of a frame.
        edge_percent: Skip a reading whose neighbours differ by more of its depth: it lies between two
            surfaces.
        max_points: No voxels are added beyond this; a point takes about 60 to 120 bytes.
    """

    voxel_m: float = 0.015
    min_depth_m: float = 0.3
    max_depth_m: float = 3.5
    every_px: int = 2
    edge_percent: float = 5.0
    max_points: int = 4_000_000

    def __post_init__(self) -> None:
        if not 0.001 <= self.voxel_m <= 1.0:
            raise UsageError(f"voxel_m = {self.voxel_m:g} is not within 0.001..1", hint="use 0.01 to 0.02")
        if self.every_px < 1 or self.max_points < 1:
            raise UsageError(
                f"every_px = {self.every_px} and max_points = {self.max_points} must be 1 or more",
                hint="leave them out to get the defaults",
            )


_P, _I, _D, _F = ctypes.c_void_p, ctypes.c_int64, ctypes.c_double, ctypes.c_float


class _Request(ctypes.Structure):
    """``rse_pf_cloud_request`` of ``rse_pf_cloud.h``."""

    _fields_ = (
        ("abi", ctypes.c_uint32), ("flags", ctypes.c_uint32), ("rows", _I), ("points", _P), ("colours", _P),
        ("readings", _P), ("voxel_m", _D), ("reach", _I), ("slots", _I), ("slot_keys", _P),
        ("slot_rows", _P), ("size", _I), ("room", _I), ("keys", _P), ("means", _P), ("counts", _P),
        ("used", _I), ("probes", _I),
    )  # fmt: skip


class _Frame(ctypes.Structure):
    """``rse_pf_cloud_frame`` of ``rse_pf_cloud.h``."""

    _fields_ = (
        ("width", _I), ("height", _I), ("every_px", _I), ("depth_m", _P), ("rgb", _P), ("fx", _D), ("fy", _D),
        ("cx", _D), ("cy", _D), ("min_depth_m", _F), ("max_depth_m", _F), ("edge_share", _F), ("zero", _F),
        ("T_world_camera", _D * 16),
    )  # fmt: skip


@cache
def _function(name: str) -> Any:
    arguments = (_P, _P) if name == "add_frame" else (_P,)
    return core_function("cloud", f"rse_pf_cloud_{name}", arguments, ctypes.c_int32)


class PointMap:
    """A voxel grid that holds the mean position and colour of what was seen in each voxel.

    Voxels live in an open-addressing hash table over flat arrays, both of which grow by
    doubling: a frame costs time in its own points alone, amortised.  ``probes`` counts the slots read so far.
    The native core adds the readings.

    Source:
        RSE-PF paper, Sect. 6.1: "it will join current frame into the point cloud".
    """

    def __init__(self, options: MapOptions | None = None) -> None:
        self.options = options or MapOptions()
        self.probes = 0
        self._size = 0
        self._slot_keys: npt.NDArray[np.int64] = np.full(4096, _EMPTY, dtype=np.int64)
        self._slot_rows: npt.NDArray[np.int32] = np.zeros(4096, dtype=np.int32)
        self._keys: npt.NDArray[np.int64] = np.empty(2048, dtype=np.int64)
        self._means: npt.NDArray[np.float32] = np.empty((2048, 6), dtype=np.float32)
        self._counts: npt.NDArray[np.int32] = np.empty(2048, dtype=np.int32)

    def __len__(self) -> int:
        return self._size

    def add(self, frame: Frame, T_world_camera: Array) -> int:
        """Add *frame*, seen from *T_world_camera*, to the map; return the number of points used."""
        options = self.options
        depth_m, rgb = aligned(frame.depth_m, np.float32), aligned(frame.rgb, np.uint8)
        height, width = depth_m.shape
        camera, step = frame.camera, options.every_px
        seen = _Frame(
            width, height, step, address_of(depth_m), address_of(rgb), camera.fx, camera.fy, camera.cx,
            camera.cy, options.min_depth_m, options.max_depth_m, options.edge_percent / 100.0, 0.0,
            (_D * 16)(*T_world_camera.ravel().tolist()),
        )  # fmt: skip
        self._grow(depth_m[::step, ::step].size)
        return self._call("add_frame", _NO_READINGS, ctypes.byref(seen))

    def take(self, other: PointMap, T_world_other: Array) -> None:
        """Add all voxels of another map, seen in its frame, each with its readings."""
        means = other._means[: other._size]
        points = transform(T_world_other, means[:, :3].astype(np.float64))
        self._add(points, means[:, 3:], other._counts[: other._size])

    def add_points(self, points_world: Array, colours: npt.NDArray[np.uint8]) -> int:
        """Add ``(n, 3)`` points in metres and ``(n, 3)`` uint8 colours; return how many were used."""
        return self._add(points_world, colours, np.ones(len(points_world), dtype=np.int32))

    def _add(self, points_world: Array, colours: npt.NDArray[Any], readings: npt.NDArray[np.int32]) -> int:
        """Add points that stand for so many readings each; return how many readings were used."""
        arrays = aligned(points_world, np.float64), aligned(colours, np.float32), aligned(readings, np.int32)
        self._grow(len(points_world))
        return self._call("add", arrays)

    def _call(self, name: str, readings: Sequence[npt.NDArray[Any]], *more: Any) -> int:
        """Call a function of the native core with *readings*; return how many of them were used."""
        request = _Request(
            PART_ABIS["cloud"], 0, len(readings[0]), *map(address_of, readings), self.options.voxel_m, _REACH,
            len(self._slot_keys), address_of(self._slot_keys), address_of(self._slot_rows), self._size,
            min(len(self._counts), self.options.max_points), address_of(self._keys), address_of(self._means),
            address_of(self._counts), 0, 0,
        )  # fmt: skip
        _function(name)(ctypes.byref(request), *more)
        self._size = request.size
        self.probes += request.probes
        used: int = request.used
        return used

    def points(self, min_readings: int = 1) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.uint8]]:
        """Return ``(n, 3)`` float32 points in metres and their ``(n, 3)`` uint8 colours.

        Voxels with fewer than *min_readings* readings are left out.
        """
        seen = self._counts[: self._size] >= min_readings
        means = self._means[: self._size][seen]
        return means[:, :3].copy(), np.clip(np.round(means[:, 3:]), 0, 255).astype(np.uint8)

    def _grow(self, more: int) -> None:
        wanted = min(self._size + more, self.options.max_points)
        if wanted > len(self._counts):
            capacity = min(max(2 * len(self._counts), wanted), self.options.max_points)
            self._keys, self._means, self._counts = (
                _grown(array, capacity) for array in (self._keys, self._means, self._counts)
            )
        if 2 * wanted > len(self._slot_keys):
            slots = 1 << (2 * wanted - 1).bit_length()
            self._slot_keys = np.full(slots, _EMPTY, dtype=np.int64)
            self._slot_rows = np.zeros(slots, dtype=np.int32)
            self._call("index", _NO_READINGS)


def _grown(array: npt.NDArray[Any], capacity: int) -> npt.NDArray[Any]:
    """Return a copy with room for *capacity* rows, of which those beyond mean nothing."""
    larger = np.empty((capacity, *array.shape[1:]), dtype=array.dtype)
    larger[: len(array)] = array
    return larger


def write_ply(
    path: Path, points: npt.ArrayLike, colours: npt.NDArray[np.uint8], *, is_metric: bool = True
) -> None:
    """Write ``(n, 3)`` points in metres and ``(n, 3)`` uint8 colours as a binary PLY file.

    *is_metric* says whether the unit is metres, or arbitrary: the file says the same in a comment.
    """
    path.write_bytes(encode_ply(points, colours, is_metric=is_metric))


def read_ply(path: Path) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.uint8]]:
    """Return the points and colours of a binary PLY file.

    Raises:
        UsageError: The file is missing, is not of that form, or is cut short.
    """
    try:
        return decode_ply(path.read_bytes())
    except OSError as error:
        raise UsageError(f"cannot read {path}: {error.strerror}", hint="name a .ply file") from error
    except BadRequest as error:
        raise UsageError(f"{path} is not a cloud: {error.message}", hint="name a binary .ply file") from error


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Poses ``T_world_camera`` ``(n, 4, 4)`` at ``timestamps_s`` ``(n,)``."""

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
        """The ``(n, 3)`` camera positions in the world, metres."""
        return self.T_world_camera[:, :3, 3]

    @property
    def length_m(self) -> float:
        """The length of the path, metres."""
        return float(np.linalg.norm(np.diff(self.positions, axis=0), axis=1).sum())

    def at(self, stamps_s: npt.ArrayLike) -> Array:
        """Return the ``(n, 4, 4)`` poses at *stamps_s*, on the twist between the two around each.

        Before the first pose and after the last one it is that pose; there must be two or more.
        """
        order = np.argsort(self.timestamps_s, kind="stable")
        stamps, known = np.atleast_1d(np.asarray(stamps_s, dtype=float)), self.timestamps_s[order]
        poses = self.T_world_camera[order]
        after = np.clip(np.searchsorted(known, stamps), 1, len(known) - 1)
        apart_s = np.maximum(known[after] - known[after - 1], 1e-9)
        shares = np.clip((stamps - known[after - 1]) / apart_s, 0.0, 1.0)
        start, end = poses[after - 1], poses[after]
        between: Array = start @ exp_se3(shares[:, None] * log_se3(inverse(start) @ end))
        return between


def write_trajectory(
    path: Path, trajectory: Trajectory, *, is_metric: bool = True, T_body_camera: Array | None = None
) -> None:
    """Write a trajectory in TUM format: ``timestamp tx ty tz qx qy qz qw``.

    *is_metric* says whether the unit is metres, or arbitrary: the file says the same in a comment.  In metres
    and with the pose *T_body_camera* ``(4, 4)`` of the camera on a rig, a file beside it has the poses of the
    body: ``trajectory-body.txt`` for ``trajectory.txt``.
    """
    unit = "metres" if is_metric else "up to scale: the unit is arbitrary"
    _write_poses(path, trajectory.timestamps_s, trajectory.T_world_camera, f"T_world_camera, {unit}")
    if T_body_camera is not None and is_metric:
        bodies = body_poses(trajectory.T_world_camera, T_body_camera)
        beside = path.with_name(f"{path.stem}{BODY_SUFFIX}{path.suffix}")
        _write_poses(beside, trajectory.timestamps_s, bodies, f"T_world_body, {unit}")


def _write_poses(path: Path, timestamps_s: Array, poses: Array, about: str) -> None:
    lines = [f"# timestamp tx ty tz qx qy qz qw  ({about})"]
    for timestamp_s, pose in zip(timestamps_s, poses, strict=True):
        numbers = [*pose[:3, 3], *to_quaternion(pose[:3, :3])]
        lines.append(f"{timestamp_s:.6f} " + " ".join(f"{number:.9f}" for number in numbers))
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


def read_trajectory(path: Path) -> Trajectory:
    """Return the trajectory of a file in TUM format; lines of ``#`` are comments.

    Raises:
        UsageError: The file is missing, or a line does not hold eight finite numbers.
    """
    try:
        text = read_regular_file(path, _MAX_TRAJECTORY_BYTES).decode("utf-8-sig")
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
