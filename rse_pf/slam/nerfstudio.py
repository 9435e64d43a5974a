"""Write maps as ``transforms.json``, which nerfstudio and trainers of splats read.

Poses lead from the camera to the world, with the axes of OpenGL: y up, z backwards.  Where gravity is known
the world is turned so that z points up, and ``applied_transform`` is that turn.

Source:
    nerfstudio documentation, "Data conventions": ``transforms.json``, ``ply_file_path``.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from rse_pf.errors import UsageError
from rse_pf.geometry import Array, Camera, transform
from rse_pf.maps.format import MapVersion
from rse_pf.slam.colmap import PIXEL_CENTRE, cameras_of, image_name
from rse_pf.slam.inertial import upright_turn
from rse_pf.slam.ply import encode_ply

__all__ = ["nerfstudio_files"]

_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_CLOUD = "points.ply"


def nerfstudio_files(version: MapVersion) -> dict[str, bytes]:
    """Return ``transforms.json``, and ``points.ply`` if the map has points.

    Intrinsics are those of all frames, or of each frame if there are several cameras.  Pixels of a map are
    undistorted, so all coefficients are 0.

    Raises:
        UsageError: The map has no keyframe.
    """
    if not version.keyframes:
        raise UsageError("a map without keyframes has no transforms", hint="export its cloud as ply")
    up = version.up
    turn = np.eye(4) if up is None else upright_turn(-up)
    cameras = cameras_of(version)
    document: dict[str, Any] = {"camera_model": "OPENCV"}
    if len(cameras) == 1:
        document |= _intrinsics(cameras[0])
    if not np.array_equal(turn, np.eye(4)):
        document["applied_transform"] = turn[:3].tolist()
    files = {}
    if len(version.points):
        document["ply_file_path"] = _CLOUD
        files[_CLOUD] = encode_ply(transform(turn, version.points.astype(np.float64)), version.colours)
    document["frames"] = [
        {
            "file_path": f"images/{image_name(keyframe)}",
            **(_intrinsics(keyframe.camera) if len(cameras) > 1 else {}),
            "transform_matrix": _matrix(turn @ keyframe.T_world_camera),
        }
        for keyframe in version.keyframes
    ]
    return {"transforms.json": (json.dumps(document, indent=1) + "\n").encode(), **files}


def _intrinsics(camera: Camera) -> dict[str, float]:
    return {
        "fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx + PIXEL_CENTRE, "cy": camera.cy + PIXEL_CENTRE,
        "w": camera.width, "h": camera.height, "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0,
    }  # fmt: skip


def _matrix(T_world_camera: Array) -> list[list[float]]:
    rows: list[list[float]] = (T_world_camera @ _OPENGL).tolist()
    return rows
