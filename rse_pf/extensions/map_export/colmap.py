"""Write a map as a COLMAP model in text: ``cameras.txt``, ``images.txt`` and ``points3D.txt``.

The world frame of the model is that of the map, in metres.  COLMAP stores poses as T_camera_world with
quaternions ordered (w, x, y, z), and gives the centre of the upper left pixel the coordinates (0.5, 0.5);
a map gives that centre the coordinates (0, 0).

Source:
    COLMAP documentation, "Output Format", text format.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rse_pf.errors import UsageError
from rse_pf.extensions.map_export.tracks import Tracks, distinct_cameras, find_tracks
from rse_pf.geometry import Camera, inverse, to_quaternion
from rse_pf.maps.format import MapVersion

__all__ = ["PIXEL_CENTRE", "encode_colmap"]

PIXEL_CENTRE = 0.5
"""Coordinate in pixels of the centre of the upper left pixel in COLMAP and nerfstudio; 0 in a map."""


def encode_colmap(
    version: MapVersion, report: Callable[[float], None] = lambda done: None
) -> dict[str, bytes]:
    """Return the three text files of a COLMAP model by their names; cameras, images and points begin at 1.

    Args:
        version: The map; its poses are written unchanged.
        report: Called with the completed share of the feature matching, 0 to 1.

    Raises:
        UsageError: The map has no keyframe.
        MissingExtra: The native core, which matches ORB features, is not installed.
    """
    if not version.keyframes:
        raise UsageError("a map without keyframes is no COLMAP model", hint="export its cloud as ply")
    tracks = find_tracks(version, report)
    camera_ids = {camera: number for number, camera in enumerate(distinct_cameras(version), start=1)}
    return {
        "cameras.txt": _text(
            "# CAMERA_ID MODEL WIDTH HEIGHT FX FY CX CY",
            *(_camera_line(number, camera) for camera, number in camera_ids.items()),
        ),
        "images.txt": _text(
            "# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, and a line of X Y POINT3D_ID",
            *_image_lines(version, tracks, camera_ids),
        ),
        "points3D.txt": _text(
            "# POINT3D_ID X Y Z R G B ERROR, and IMAGE_ID POINT2D_IDX", *_point_lines(tracks)
        ),
    }


def _camera_line(number: int, camera: Camera) -> str:
    centre = f"{camera.cx + PIXEL_CENTRE:.12g} {camera.cy + PIXEL_CENTRE:.12g}"
    return f"{number} PINHOLE {camera.width} {camera.height} {camera.fx:.12g} {camera.fy:.12g} {centre}"


def _image_lines(version: MapVersion, tracks: Tracks, camera_ids: dict[Camera, int]) -> list[str]:
    """Return two lines for each keyframe, in their order.

    The first line has the number of the image, ``T_camera_world``, the number of the camera, and the name of
    the image file; the second line has the pixel of each feature and the number of its 3-D point, or -1
    without one.
    """
    order = np.argsort(tracks.keyframe, kind="stable")
    first = np.searchsorted(tracks.keyframe[order], np.arange(len(version.keyframes) + 1))
    lines = []
    for row, keyframe in enumerate(version.keyframes):
        T_camera_world = inverse(keyframe.T_world_camera)
        x, y, z, w = to_quaternion(T_camera_world[:3, :3])
        pose = " ".join(f"{number:.12g}" for number in (w, x, y, z, *T_camera_world[:3, 3]))
        lines.append(f"{row + 1} {pose} {camera_ids[keyframe.camera]} {keyframe.image_name}")
        point_ids = np.full(len(keyframe.pixels), -1)
        observations = order[first[row] : first[row + 1]]
        point_ids[tracks.feature[observations]] = tracks.point[observations] + 1
        pixels = keyframe.pixels.astype(np.float64) + PIXEL_CENTRE
        lines.append(
            " ".join(
                f"{u:.4f} {v:.4f} {point_id}"
                for (u, v), point_id in zip(pixels.tolist(), point_ids, strict=True)
            )
        )
    return lines


def _point_lines(tracks: Tracks) -> list[str]:
    """Return a line for each 3-D point: number, position, colour, mean reprojection error in px, and track.

    The track names each observation by the number of its image and the row of its feature, from 0.
    """
    first = np.searchsorted(tracks.point, np.arange(len(tracks.points) + 1))
    lines = []
    for row, (point, colour) in enumerate(zip(tracks.points.tolist(), tracks.colours.tolist(), strict=True)):
        observations = slice(first[row], first[row + 1])
        track = " ".join(
            f"{keyframe + 1} {feature}"
            for keyframe, feature in zip(
                tracks.keyframe[observations], tracks.feature[observations], strict=True
            )
        )
        position = " ".join(f"{coordinate:.9g}" for coordinate in point)
        red, green, blue = colour
        error_px = float(tracks.error_px[observations].mean())
        lines.append(f"{row + 1} {position} {red} {green} {blue} {error_px:.4f} {track}")
    return lines


def _text(*lines: str) -> bytes:
    return ("\n".join(lines) + "\n").encode("ascii")
