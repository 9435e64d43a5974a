"""Export maps for other programs as one file: PLY and PCD clouds, TUM trajectories, g2o pose graphs.

Units are metres and binary data is little-endian; quaternions of TUM and g2o end with w; g2o gets the upper
triangle of an information matrix.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rse_pf.errors import UsageError
from rse_pf.geometry import Array, to_quaternion
from rse_pf.maps.format import MapVersion
from rse_pf.slam.ply import encode_ply
from rse_pf.slam.pose_graph import g2o_edge, g2o_vertex

__all__ = ["FORMATS", "export_map"]


def export_map(version: MapVersion, kind: str, robot: str | None = None) -> bytes:
    """Return the file of *kind* (one of `FORMATS`).

    Args:
        version: The map.
        kind: ``ply``, ``pcd``, ``tum`` or ``g2o``.
        robot: ``tum`` only: this robot's keyframes; None for all.

    Raises:
        UsageError: There is no such format, no such robot in the map, or the map has no points for a cloud.
    """
    if kind not in FORMATS:
        raise UsageError(f"{kind!r} is not a format of maps", hint=f"use one of {', '.join(FORMATS)}")
    if kind in _CLOUDS and not len(version.points):
        raise UsageError(
            f"this map has no points, so there is no {kind} of it", hint="export it as tum or g2o"
        )
    return FORMATS[kind](version, robot)


def _ply(version: MapVersion, robot: str | None) -> bytes:
    return encode_ply(version.points, version.colours)


def _pcd(version: MapVersion, robot: str | None) -> bytes:
    n = len(version.points)
    rows = np.empty(n, dtype=[("xyz", "<f4", (3,)), ("rgb", "<u4")])
    red, green, blue = version.colours.astype(np.uint32).T if n else np.zeros((3, 0), dtype=np.uint32)
    rows["xyz"], rows["rgb"] = version.points, (red << 16) | (green << 8) | blue
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\n"
        f"TYPE F F F U\nCOUNT 1 1 1 1\nWIDTH {n}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\n"
        f"POINTS {n}\nDATA binary\n"
    )
    return header.encode("ascii") + rows.tobytes()


def _tum(version: MapVersion, robot: str | None) -> bytes:
    chosen = [keyframe for keyframe in version.keyframes if robot in (None, keyframe.robot)]
    if robot is not None and not chosen:
        raise UsageError(f"no keyframe of robot {robot!r} is in this map", hint="see rse-pf map show")
    chosen.sort(key=lambda keyframe: (keyframe.timestamp_s, keyframe.id))
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    lines += [f"{keyframe.timestamp_s:.6f} {_pose(keyframe.T_world_camera)}" for keyframe in chosen]
    return ("\n".join(lines) + "\n").encode("ascii")


def _g2o(version: MapVersion, robot: str | None) -> bytes:
    lines = [g2o_vertex(keyframe.id, keyframe.T_world_camera) for keyframe in version.keyframes]
    if version.keyframes:
        lines.append(f"FIX {version.keyframes[0].id}")
    lines += [g2o_edge(edge.a, edge.b, edge.T_a_b, edge.information) for edge in version.edges]
    return ("\n".join(lines) + "\n").encode("ascii")


def _pose(T: Array) -> str:
    numbers = np.concatenate([T[:3, 3], to_quaternion(T[:3, :3])])
    return " ".join(f"{number:.9g}" for number in numbers)


FORMATS: dict[str, Callable[[MapVersion, str | None], bytes]] = {
    "ply": _ply, "pcd": _pcd, "tum": _tum, "g2o": _g2o,
}  # fmt: skip
"""The formats of `export_map` by name."""
_CLOUDS = ("ply", "pcd")
