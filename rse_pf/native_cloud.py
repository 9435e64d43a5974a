"""Readings in voxels, by the native core; `client_sdk.mapping` has the same in numpy.

The library is the one that `rse_pf.native` finds.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array, Camera
from rse_pf.native import address_of, aligned, load_core, load_part

__all__ = ["CloudCore", "VoxelArrays", "cloud_core", "open_cloud"]

_ABI = 1
_P, _I, _D, _F = ctypes.c_void_p, ctypes.c_int64, ctypes.c_double, ctypes.c_float

_NO_READINGS = np.empty((0, 3)), np.empty((0, 3), dtype=np.float32), np.empty(0, dtype=np.int32)


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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class VoxelArrays:
    """A hash table ``(slots,)`` of voxels, and ``(room,)`` voxels; there are more slots than voxels."""

    slot_keys: npt.NDArray[np.int64]
    slot_rows: npt.NDArray[np.int32]
    keys: npt.NDArray[np.int64]
    means: npt.NDArray[np.float32]
    counts: npt.NDArray[np.int32]


class CloudCore:
    """The part of one loaded library that adds readings to voxels; every thread may call it."""

    def __init__(
        self, add: Callable[..., int], add_frame: Callable[..., int], index: Callable[..., int]
    ) -> None:
        self._add, self._add_frame, self._index = add, add_frame, index

    def add(
        self, points: Array, colours: npt.NDArray[np.float32], readings: npt.NDArray[np.int32],
        voxels: VoxelArrays, size: int, voxel_m: float, reach: int,
    ) -> tuple[int, int, int]:  # fmt: skip
        """Add readings to *size* voxels; return how many voxels there are, readings used and slots read."""
        arrays = aligned(points, np.float64), aligned(colours, np.float32), aligned(readings, np.int32)
        request = _request(arrays, voxels, size, voxel_m, reach)
        self._add(ctypes.byref(request))
        return request.size, request.used, request.probes

    def add_frame(
        self, depth_m: npt.NDArray[np.float32], rgb: npt.NDArray[np.uint8], camera: Camera,
        T_world_camera: Array, chosen: tuple[float, float, float, int], voxels: VoxelArrays, size: int,
        voxel_m: float, reach: int,
    ) -> tuple[int, int, int]:  # fmt: skip
        """Add what a depth camera shows, see `add`.

        *chosen* are the least and the largest depth, by which share neighbours may differ, and the step.
        """
        arrays = aligned(depth_m, np.float32), aligned(rgb, np.uint8)
        height, width = depth_m.shape
        frame = _Frame(
            width, height, chosen[3], *map(address_of, arrays), camera.fx, camera.fy, camera.cx, camera.cy,
            *chosen[:3], 0.0, (_D * 16)(*T_world_camera.ravel().tolist()),
        )  # fmt: skip
        request = _request(_NO_READINGS, voxels, size, voxel_m, reach)
        self._add_frame(ctypes.byref(request), ctypes.byref(frame))
        return request.size, request.used, request.probes

    def index(self, voxels: VoxelArrays, size: int) -> int:
        """Fill the hash table with the keys of *size* voxels; return how many slots were read."""
        request = _request(_NO_READINGS, voxels, size, 1.0, 1)
        self._index(ctypes.byref(request))
        probes: int = request.probes
        return probes


def _request(
    arrays: Sequence[npt.NDArray[Any]], voxels: VoxelArrays, size: int, voxel_m: float, reach: int
) -> _Request:
    """Return a request that points to *arrays* and *voxels*, which must live as long."""
    return _Request(
        _ABI, 0, len(arrays[0]), *map(address_of, arrays), voxel_m, reach, len(voxels.slot_keys),
        address_of(voxels.slot_keys), address_of(voxels.slot_rows), size, len(voxels.counts),
        address_of(voxels.keys), address_of(voxels.means), address_of(voxels.counts), 0, 0,
    )  # fmt: skip


def open_cloud(path: Path) -> CloudCore:
    """Load the library at *path*; raises ConfigurationError as `load_part` says."""
    add, add_frame, index = load_part(
        path, "cloud", _ABI, "rse_pf_cloud_add", "rse_pf_cloud_add_frame", "rse_pf_cloud_index"
    )
    add.argtypes, add.restype = (_P,), ctypes.c_int32
    add_frame.argtypes, add_frame.restype = (_P, _P), ctypes.c_int32
    index.argtypes, index.restype = (_P,), ctypes.c_int32
    return CloudCore(add, add_frame, index)


@cache
def cloud_core() -> CloudCore:
    """Return the point cloud of the native core, which is required."""
    return load_core(open_cloud)
