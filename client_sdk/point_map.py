"""Collect the points of a robot in a voxel grid of bounded memory, and write and read them as PLY files.

The time to add a frame does not depend on the size of the map.
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
from rse_pf.geometry import Array, transform
from rse_pf.native import PART_ABIS, address_of, aligned, core_function
from rse_pf.slam.ply import decode_ply, encode_ply

if TYPE_CHECKING:
    from client_sdk.frontend import Frame

__all__ = ["MapOptions", "PointMap", "read_ply", "write_ply"]

_EMPTY = -1  # key of a slot of the hash table that holds no voxel
_MAX_VOXEL_INDEX = 1 << 20
"""Voxels on either side of the origin along each axis; points beyond are left out.  An index has 21 bits, and
three indices make one int64 key."""
_FIRST_VOXELS = 2048  # voxels for which a new map has memory; the memory doubles when they are full
_FIRST_SLOTS = 4096  # slots of a new hash table, at least twice as many as voxels
_MIN_VOXEL_M = 0.001  # a smaller edge of a voxel is refused: no depth sensor is more exact
_MAX_VOXEL_M = 1.0  # a larger edge of a voxel is refused: it is probably stated in millimetres
_NO_POINTS = np.empty((0, 3)), np.empty((0, 3), dtype=np.float32), np.empty(0, dtype=np.int32)
"""Points, colours and weights for a call of the native core that adds no points."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MapOptions:
    """Density of a point map, and the choice of the depth readings that are added to it.

    Points of stereo pairs and landmarks of a camera without depth are chosen elsewhere: only *voxel_m* and
    *max_points* apply to them.

    Attributes:
        voxel_m: Edge of a voxel, 0.001 to 1 m (in the unit of a map up to scale); each voxel holds one point.
        min_depth_m: Smallest depth that is added, in metres.
        max_depth_m: Largest depth that is added, in metres.
        every_px: Distance in pixels between the rows, and between the columns, of which readings are added.
        edge_percent: Largest difference between the depths of a pixel and of each of its four neighbours, in
            percent of the depth of the pixel that is to the right or below of the other.  A reading beyond it
            lies on a depth edge, between two surfaces, and is left out.
        max_points: Largest number of voxels; readings that need another one are left out.  A point takes
            about 60 to 120 bytes.

    Raises:
        UsageError: *voxel_m*, *every_px* or *max_points* is outside its range.
    """

    voxel_m: float = 0.015
    min_depth_m: float = 0.3
    max_depth_m: float = 3.5
    every_px: int = 2
    edge_percent: float = 5.0
    max_points: int = 4_000_000

    def __post_init__(self) -> None:
        if not _MIN_VOXEL_M <= self.voxel_m <= _MAX_VOXEL_M:
            raise UsageError(f"voxel_m = {self.voxel_m:g} is not within 0.001..1 m", hint="use 0.01 to 0.02")
        if self.every_px < 1 or self.max_points < 1:
            raise UsageError(
                f"every_px = {self.every_px} and max_points = {self.max_points} must be 1 or more",
                hint="leave them out to get the defaults",
            )


_POINTER = ctypes.c_void_p
_INT64 = ctypes.c_int64
_DOUBLE = ctypes.c_double
_FLOAT = ctypes.c_float


class _Request(ctypes.Structure):
    """Fields of ``rse_pf_cloud_request`` in ``rse_pf_cloud.h``, in the same order."""

    _fields_ = (
        ("abi", ctypes.c_uint32),
        ("flags", ctypes.c_uint32),
        ("rows", _INT64),
        ("points", _POINTER),
        ("colours", _POINTER),
        ("weights", _POINTER),
        ("voxel_m", _DOUBLE),
        ("reach", _INT64),
        ("slots", _INT64),
        ("slot_keys", _POINTER),
        ("slot_rows", _POINTER),
        ("voxels", _INT64),
        ("max_voxels", _INT64),
        ("keys", _POINTER),
        ("means", _POINTER),
        ("counts", _POINTER),
        ("used", _INT64),
        ("probes", _INT64),
    )


class _Frame(ctypes.Structure):
    """Fields of ``rse_pf_cloud_frame`` in ``rse_pf_cloud.h``, in the same order."""

    _fields_ = (
        ("width", _INT64),
        ("height", _INT64),
        ("every_px", _INT64),
        ("depth_m", _POINTER),
        ("rgb", _POINTER),
        ("fx", _DOUBLE),
        ("fy", _DOUBLE),
        ("cx", _DOUBLE),
        ("cy", _DOUBLE),
        ("min_depth_m", _FLOAT),
        ("max_depth_m", _FLOAT),
        ("edge_share", _FLOAT),
        ("zero", _FLOAT),
        ("T_world_camera", _DOUBLE * 16),
    )


@cache
def _native_function(name: str) -> Any:
    arguments = (_POINTER, _POINTER) if name == "add_frame" else (_POINTER,)
    return core_function("cloud", f"rse_pf_cloud_{name}", arguments, ctypes.c_int32)


class PointMap:
    """Voxel grid that holds the mean position and the mean colour of the readings in each voxel.

    Voxels are found with an open-addressing hash table over flat arrays.  Table and arrays double when they
    are too small, so that a frame costs amortised time in proportion to its own points.  The native core adds
    the readings.

    Attributes:
        options: Density of the map, and choice of readings.
        probes: Number of slots of the hash table that were read so far, a measure of the work.

    Source:
        RSE-PF paper, Sect. 6.1: "it will join current frame into the point cloud".
    """

    def __init__(self, options: MapOptions | None = None) -> None:
        self.options = options or MapOptions()
        self.probes = 0
        self._voxels = 0
        self._slot_keys: npt.NDArray[np.int64] = np.full(_FIRST_SLOTS, _EMPTY, dtype=np.int64)
        self._slot_rows: npt.NDArray[np.int32] = np.zeros(_FIRST_SLOTS, dtype=np.int32)
        self._keys: npt.NDArray[np.int64] = np.empty(_FIRST_VOXELS, dtype=np.int64)
        self._means: npt.NDArray[np.float32] = np.empty((_FIRST_VOXELS, 6), dtype=np.float32)
        self._counts: npt.NDArray[np.int32] = np.empty(_FIRST_VOXELS, dtype=np.int32)

    def __len__(self) -> int:
        return self._voxels

    def add(self, frame: Frame, T_world_camera: Array) -> int:
        """Add the depth readings of a frame at a ``(4, 4)`` pose; return how many readings were added.

        Readings that `MapOptions` excludes are left out, and those beyond the end of the grid.
        """
        options, camera = self.options, frame.camera
        depth_m, rgb = aligned(frame.depth_m, np.float32), aligned(frame.rgb, np.uint8)
        height, width = depth_m.shape
        native_frame = _Frame(
            width=width,
            height=height,
            every_px=options.every_px,
            depth_m=address_of(depth_m),
            rgb=address_of(rgb),
            fx=camera.fx,
            fy=camera.fy,
            cx=camera.cx,
            cy=camera.cy,
            min_depth_m=options.min_depth_m,
            max_depth_m=options.max_depth_m,
            edge_share=options.edge_percent / 100.0,
            T_world_camera=(_DOUBLE * 16)(*T_world_camera.ravel().tolist()),
        )
        self._reserve(depth_m[:: options.every_px, :: options.every_px].size)
        return self._call("add_frame", _NO_POINTS, ctypes.byref(native_frame))

    def add_map(self, other: PointMap, T_world_other: Array) -> None:
        """Add the mean points of another map, moved by a ``(4, 4)`` pose, each weighted by its readings."""
        means = other._means[: other._voxels]
        points = transform(T_world_other, means[:, :3].astype(np.float64))
        self._add(points, means[:, 3:], other._counts[: other._voxels])

    def add_points(self, points_world: Array, colours: npt.NDArray[np.uint8]) -> int:
        """Add ``(n, 3)`` points in metres with ``(n, 3)`` uint8 colours; return how many were added.

        Points beyond the end of the grid, and those that need a voxel beyond `MapOptions.max_points`, are
        left out.
        """
        return self._add(points_world, colours, np.ones(len(points_world), dtype=np.int32))

    def points(self, min_readings: int = 1) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.uint8]]:
        """Return ``(n, 3)`` float32 points in metres and their ``(n, 3)`` uint8 colours.

        Voxels with fewer than *min_readings* readings are left out.
        """
        is_read = self._counts[: self._voxels] >= min_readings
        means = self._means[: self._voxels][is_read]
        return means[:, :3].copy(), np.clip(np.round(means[:, 3:]), 0, 255).astype(np.uint8)

    def _add(self, points_world: Array, colours: npt.NDArray[Any], weights: npt.NDArray[np.int32]) -> int:
        """Add points with ``(n,)`` *weights*, the numbers of readings of which each point is the mean.

        Return how many readings were used: points beyond the grid or the limit of voxels are left out.
        """
        arrays = aligned(points_world, np.float64), aligned(colours, np.float32), aligned(weights, np.int32)
        self._reserve(len(points_world))
        return self._call("add", arrays)

    def _call(self, name: str, arrays: Sequence[npt.NDArray[Any]], *more: Any) -> int:
        """Call ``rse_pf_cloud_NAME`` with points, colours and weights; return how many readings were used."""
        points, colours, weights = arrays
        request = _Request(
            abi=PART_ABIS["cloud"],
            rows=len(points),
            points=address_of(points),
            colours=address_of(colours),
            weights=address_of(weights),
            voxel_m=self.options.voxel_m,
            reach=_MAX_VOXEL_INDEX,
            slots=len(self._slot_keys),
            slot_keys=address_of(self._slot_keys),
            slot_rows=address_of(self._slot_rows),
            voxels=self._voxels,
            max_voxels=min(len(self._counts), self.options.max_points),
            keys=address_of(self._keys),
            means=address_of(self._means),
            counts=address_of(self._counts),
        )
        _native_function(name)(ctypes.byref(request), *more)
        self._voxels = request.voxels
        self.probes += request.probes
        used: int = request.used
        return used

    def _reserve(self, more_points: int) -> None:
        """Enlarge the arrays so that each of *more_points* points may need a voxel, up to *max_points*."""
        wanted = min(self._voxels + more_points, self.options.max_points)
        if wanted > len(self._counts):
            capacity = min(max(2 * len(self._counts), wanted), self.options.max_points)
            self._keys, self._means, self._counts = (
                _enlarged(array, capacity) for array in (self._keys, self._means, self._counts)
            )
        if 2 * wanted > len(self._slot_keys):
            slots = 1 << (2 * wanted - 1).bit_length()
            self._slot_keys = np.full(slots, _EMPTY, dtype=np.int64)
            self._slot_rows = np.zeros(slots, dtype=np.int32)
            self._call("index", _NO_POINTS)


def _enlarged(array: npt.NDArray[Any], capacity: int) -> npt.NDArray[Any]:
    """Return a copy of an array with *capacity* rows; the added rows are not initialised."""
    larger = np.empty((capacity, *array.shape[1:]), dtype=array.dtype)
    larger[: len(array)] = array
    return larger


def write_ply(
    path: Path, points: npt.ArrayLike, colours: npt.NDArray[np.uint8], *, is_metric: bool = True
) -> None:
    """Write ``(n, 3)`` points and ``(n, 3)`` uint8 colours as a binary PLY file.

    *is_metric* tells whether the unit is the metre or arbitrary, which the file says in a comment.

    Raises:
        OSError: The file cannot be written.
    """
    path.write_bytes(encode_ply(points, colours, is_metric=is_metric))


def read_ply(path: Path) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.uint8]]:
    """Return the ``(n, 3)`` points and ``(n, 3)`` colours of a binary PLY file.

    Raises:
        UsageError: The file cannot be read, is no binary PLY file, or is truncated.
    """
    try:
        return decode_ply(path.read_bytes())
    except OSError as error:
        raise UsageError(f"cannot read {path}: {error.strerror}", hint="name a .ply file") from error
    except BadRequest as error:
        raise UsageError(
            f"{path} is not a point cloud: {error.message}", hint="name a binary .ply file"
        ) from error
