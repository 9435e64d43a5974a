"""Write maps as COLMAP models in text: ``cameras.txt``, ``images.txt`` and ``points3D.txt``.

The world is that of the map, in metres.  Poses lead from the world to the camera, quaternions begin with w,
and the centre of the upper left pixel is (0.5, 0.5), where the map has (0, 0).

Source:
    COLMAP documentation, "Output Format", text format.
"""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np

from rse_pf.errors import UsageError
from rse_pf.geometry import Camera, inverse, to_quaternion
from rse_pf.maps.format import Keyframe, MapVersion
from rse_pf.slam.tracks import Tracks, find_tracks

__all__ = ["PIXEL_CENTRE", "colmap_files", "image_name"]

PIXEL_CENTRE = 0.5
"""Of the upper left pixel, as COLMAP and nerfstudio count; 0 in maps."""
_UNSAFE = re.compile(r"[^A-Za-z0-9._-]+")


def image_name(keyframe: Keyframe) -> str:
    """Return the name of the image of a keyframe: unique in its map, of plain letters only."""
    robot = _UNSAFE.sub("-", keyframe.robot).strip(".-") or "camera"
    return f"{robot}-{keyframe.id:06d}.jpg"


def colmap_files(
    version: MapVersion, report: Callable[[float], None] = lambda done: None
) -> dict[str, bytes]:
    """Return the files of a model by their names; images and cameras are numbered from 1.

    Args:
        version: The map; its poses are not changed.
        report: Gets how much is done, 0 to 1.

    Raises:
        UsageError: The map has no keyframe.
        MissingExtra: There is no matcher.
    """
    if not version.keyframes:
        raise UsageError("a map without keyframes is no COLMAP model", hint="export its cloud as ply")
    tracks = find_tracks(version, report)
    cameras = {camera: number for number, camera in enumerate(cameras_of(version), start=1)}
    return {
        "cameras.txt": _text(
            "# CAMERA_ID MODEL WIDTH HEIGHT FX FY CX CY",
            *(_camera_line(number, camera) for camera, number in cameras.items()),
        ),
        "images.txt": _text(
            "# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, and a line of X Y POINT3D_ID",
            *_image_lines(version, tracks, cameras),
        ),
        "points3D.txt": _text(
            "# POINT3D_ID X Y Z R G B ERROR, and IMAGE_ID POINT2D_IDX", *_point_lines(tracks)
        ),
    }  # fmt: skip


def cameras_of(version: MapVersion) -> list[Camera]:
    """Return the cameras of a map, each once."""
    return list(dict.fromkeys(keyframe.camera for keyframe in version.keyframes))


def _camera_line(number: int, camera: Camera) -> str:
    centre = f"{camera.cx + PIXEL_CENTRE:.12g} {camera.cy + PIXEL_CENTRE:.12g}"
    return f"{number} PINHOLE {camera.width} {camera.height} {camera.fx:.12g} {camera.fy:.12g} {centre}"


def _image_lines(version: MapVersion, tracks: Tracks, cameras: dict[Camera, int]) -> list[str]:
    order = np.argsort(tracks.keyframe, kind="stable")
    first = np.searchsorted(tracks.keyframe[order], np.arange(len(version.keyframes) + 1))
    lines = []
    for place, keyframe in enumerate(version.keyframes):
        T_camera_world = inverse(keyframe.T_world_camera)
        x, y, z, w = to_quaternion(T_camera_world[:3, :3])
        pose = " ".join(f"{number:.12g}" for number in (w, x, y, z, *T_camera_world[:3, 3]))
        lines.append(f"{place + 1} {pose} {cameras[keyframe.camera]} {image_name(keyframe)}")
        points = np.full(len(keyframe.pixels), -1)
        rows = order[first[place] : first[place + 1]]
        points[tracks.feature[rows]] = tracks.point[rows] + 1
        pixels = keyframe.pixels.astype(np.float64) + PIXEL_CENTRE
        lines.append(
            " ".join(
                f"{u:.4f} {v:.4f} {point}" for (u, v), point in zip(pixels.tolist(), points, strict=True)
            )
        )
    return lines


def _point_lines(tracks: Tracks) -> list[str]:
    first = np.searchsorted(tracks.point, np.arange(len(tracks.points) + 1))
    lines = []
    for number, (point, colour) in enumerate(
        zip(tracks.points.tolist(), tracks.colours.tolist(), strict=True)
    ):
        seen = slice(first[number], first[number + 1])
        track = " ".join(
            f"{keyframe + 1} {feature}"
            for keyframe, feature in zip(tracks.keyframe[seen], tracks.feature[seen], strict=True)
        )
        numbers = " ".join(f"{each:.9g}" for each in point)
        red, green, blue = colour
        error = float(tracks.error_px[seen].mean())
        lines.append(f"{number + 1} {numbers} {red} {green} {blue} {error:.4f} {track}")
    return lines


def _text(*lines: str) -> bytes:
    return ("\n".join(lines) + "\n").encode("ascii")
