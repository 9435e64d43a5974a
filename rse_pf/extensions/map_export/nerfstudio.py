"""Write a map as ``transforms.json``, the input of nerfstudio and of programs that train Gaussian splats.

Poses are T_world_camera with the camera axes of OpenGL: y up, z backwards.  Where the map knows gravity, the
world is rotated so that its z axis points up, and ``applied_transform`` holds this rotation.

Source:
    nerfstudio documentation, "Data conventions": ``transforms.json``, ``ply_file_path``.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from rse_pf.errors import UsageError
from rse_pf.extensions.map_export.colmap import PIXEL_CENTRE
from rse_pf.extensions.map_export.tracks import distinct_cameras
from rse_pf.geometry import Array, Camera, transform
from rse_pf.maps.format import IMAGES_FOLDER, MapVersion
from rse_pf.slam.inertial import upright_rotation
from rse_pf.slam.ply import encode_ply

__all__ = ["encode_nerfstudio"]

_CAMERA_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Transform of points from OpenGL's camera axes (y up, z backwards) to those of maps (y down, z forwards)."""
_CLOUD_FILE = "points.ply"  # name of the file with the point cloud, to which transforms.json refers


def encode_nerfstudio(version: MapVersion) -> dict[str, bytes]:
    """Return the file ``transforms.json``, and ``points.ply`` if the map has points, by their names.

    Poses and points are in the rotated world; a map without gravity, or whose z axis points up already, is
    not rotated, and its document has no ``applied_transform``.  The intrinsics stand at the top of the
    document if all keyframes have the same camera, else in each frame. The distortion coefficients are 0,
    since the pixels of a map are undistorted.

    Raises:
        UsageError: The map has no keyframe.
    """
    if not version.keyframes:
        raise UsageError("a map without keyframes has no transforms", hint="export its cloud as ply")
    up = version.up
    T_upright_world = np.eye(4) if up is None else upright_rotation(-up)
    cameras = distinct_cameras(version)
    document: dict[str, Any] = {"camera_model": "OPENCV"}
    if len(cameras) == 1:
        document |= _intrinsics(cameras[0])
    if not np.array_equal(T_upright_world, np.eye(4)):
        document["applied_transform"] = T_upright_world[:3].tolist()
    files = {}
    if len(version.points):
        document["ply_file_path"] = _CLOUD_FILE
        points = transform(T_upright_world, version.points.astype(np.float64))
        files[_CLOUD_FILE] = encode_ply(points, version.colours)
    document["frames"] = [
        {
            "file_path": f"{IMAGES_FOLDER}/{keyframe.image_name}",
            **(_intrinsics(keyframe.camera) if len(cameras) > 1 else {}),
            "transform_matrix": _opengl_pose(T_upright_world @ keyframe.T_world_camera),
        }
        for keyframe in version.keyframes
    ]
    return {"transforms.json": (json.dumps(document, indent=1) + "\n").encode(), **files}


def _intrinsics(camera: Camera) -> dict[str, float]:
    return {
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx + PIXEL_CENTRE,
        "cy": camera.cy + PIXEL_CENTRE,
        "w": camera.width,
        "h": camera.height,
        "k1": 0.0,
        "k2": 0.0,
        "p1": 0.0,
        "p2": 0.0,
    }


def _opengl_pose(T_world_camera: Array) -> list[list[float]]:
    rows: list[list[float]] = (T_world_camera @ _CAMERA_OPENGL).tolist()
    return rows
