"""Write a map as one file: a PLY or PCD point cloud, a TUM trajectory, or a g2o pose graph.

Lengths are in metres and binary numbers are little-endian.  Quaternions in TUM and g2o files are ordered
(x, y, z, w).  A g2o edge holds the upper triangle of its 6x6 information matrix.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rse_pf.errors import UsageError
from rse_pf.geometry import Array, to_quaternion
from rse_pf.maps.format import MapVersion
from rse_pf.slam.ply import encode_ply
from rse_pf.slam.pose_graph import g2o_edge, g2o_vertex

__all__ = ["SINGLE_FILE_FORMATS", "encode_single_file"]


def encode_single_file(version: MapVersion, format_name: str, robot: str | None = None) -> bytes:
    """Return a map as the bytes of one file.

    Args:
        version: The map.
        format_name: ``ply``, ``pcd``, ``tum`` or ``g2o``.
        robot: For ``tum`` only: the robot whose keyframes are written; None writes those of all robots.

    Raises:
        UsageError: The format is unknown, the format is ``tum`` and the map has no keyframe of *robot*, or
            the format is a point cloud and the map has no points.
    """
    if format_name not in SINGLE_FILE_FORMATS:
        raise UsageError(
            f"{format_name!r} is not a format of maps", hint=f"use one of {', '.join(SINGLE_FILE_FORMATS)}"
        )
    if format_name in _CLOUD_FORMATS and not len(version.points):
        raise UsageError(
            f"this map has no points, so there is no {format_name} of it", hint="export it as tum or g2o"
        )
    return SINGLE_FILE_FORMATS[format_name](version, robot)


def _encode_ply(version: MapVersion, robot: str | None) -> bytes:
    return encode_ply(version.points, version.colours)


def _encode_pcd(version: MapVersion, robot: str | None) -> bytes:
    """Return the whole point cloud as a binary PCD file of version 0.7 with packed 24-bit RGB colours.

    *robot* is not used, since a point of a map belongs to no robot.
    """
    n = len(version.points)
    rows = np.empty(n, dtype=[("xyz", "<f4", (3,)), ("rgb", "<u4")])
    red, green, blue = version.colours.astype(np.uint32).T if n else np.zeros((3, 0), dtype=np.uint32)
    rows["xyz"] = version.points
    rows["rgb"] = (red << 16) | (green << 8) | blue
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\n"
        f"TYPE F F F U\nCOUNT 1 1 1 1\nWIDTH {n}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\n"
        f"POINTS {n}\nDATA binary\n"
    )
    return header.encode("ascii") + rows.tobytes()


def _encode_tum(version: MapVersion, robot: str | None) -> bytes:
    """Return the camera poses, ordered by time, as a trajectory file of the TUM RGB-D benchmark.

    Each line has the Unix time of a keyframe in seconds and its ``T_world_camera``; a map without keyframes
    gives a file with the heading only.

    Raises:
        UsageError: *robot* is not None, and the map has no keyframe of it.
    """
    keyframes = [keyframe for keyframe in version.keyframes if robot in (None, keyframe.robot)]
    if robot is not None and not keyframes:
        raise UsageError(f"no keyframe of robot {robot!r} is in this map", hint="see rse-pf map show")
    keyframes.sort(key=lambda keyframe: (keyframe.timestamp_s, keyframe.id))
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    lines += [f"{keyframe.timestamp_s:.6f} {_pose_text(keyframe.T_world_camera)}" for keyframe in keyframes]
    return ("\n".join(lines) + "\n").encode("ascii")


def _encode_g2o(version: MapVersion, robot: str | None) -> bytes:
    """Return the whole pose graph as a g2o file whose first keyframe is fixed; *robot* is not used."""
    lines = [g2o_vertex(keyframe.id, keyframe.T_world_camera) for keyframe in version.keyframes]
    if version.keyframes:
        lines.append(f"FIX {version.keyframes[0].id}")
    lines += [g2o_edge(edge.a, edge.b, edge.T_a_b, edge.information) for edge in version.edges]
    return ("\n".join(lines) + "\n").encode("ascii")


def _pose_text(T_world_camera: Array) -> str:
    numbers = np.concatenate([T_world_camera[:3, 3], to_quaternion(T_world_camera[:3, :3])])
    return " ".join(f"{number:.9g}" for number in numbers)


SINGLE_FILE_FORMATS: dict[str, Callable[[MapVersion, str | None], bytes]] = {
    "ply": _encode_ply,
    "pcd": _encode_pcd,
    "tum": _encode_tum,
    "g2o": _encode_g2o,
}
"""The function that encodes a map in each single-file format, by the name of the format."""
_CLOUD_FORMATS = ("ply", "pcd")  # the single-file formats that hold the point cloud of a map
