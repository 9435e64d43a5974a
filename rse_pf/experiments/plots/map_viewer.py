"""A map in the browser: its cloud, and the cameras of its keyframes by robot.

Needs the extra "view" (viser).  The page is served on this machine only, until the caller ends it.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import numpy as np

from rse_pf.errors import MissingExtra, UsageError
from rse_pf.experiments.plots.map_image import COLOURS
from rse_pf.geometry import Array, to_quaternion
from rse_pf.maps.format import MapVersion
from rse_pf.terminal import printable

__all__ = ["browse_map", "first_view"]

_HOST = "127.0.0.1"
_MAX_POINTS = 1_000_000
_CAMERA_M = 0.08
_ELEVATION_RAD = np.deg2rad(40.0)
_DISTANCE_RADII = 1.6
"""From the centre of the cloud: the whole of it is in a view of 75 degrees, and the view is outside of it."""
_OUTLIERS_PERCENT = 2.0
_LEAST_RADIUS_M = 1.0
_NO_DIRECTION = 1e-6


def browse_map(
    version: MapVersion,
    port: int,
    on_address: Callable[[str], None],
    until: threading.Event,
    viser: Any = None,
) -> None:
    """Show *version* until *until* is set.

    Args:
        version: The map; clouds of more than a million points are thinned.
        port: Port of the page on this machine; another one is used if it is taken.
        on_address: Called with the address of the page.
        until: Ends the page when it is set.
        viser: The package; None means the installed one.

    Raises:
        MissingExtra: viser is not installed.
        UsageError: *port* is not a port number.
    """
    if not 1 <= port <= 65535:
        raise UsageError(f"port {port} is not within 1..65535", hint="leave --port out")
    package = viser if viser is not None else _viser()
    server = package.ViserServer(host=_HOST, port=port, verbose=False)
    try:
        _draw(server, version)
        on_address(f"http://{_HOST}:{server.get_port()}")
        until.wait()
    finally:
        server.stop()


def first_view(version: MapVersion) -> tuple[Array, Array, Array]:
    """Return where the first view stands, what it looks at, and what is up, each ``(3,)``, world frame.

    Up is opposite to the mean of the cameras' downward axes.  The view stands outside of the cloud and above
    it, on the side from which the cameras looked, so that it sees the surfaces that they saw.
    """
    poses = np.array([keyframe.T_world_camera for keyframe in version.keyframes]).reshape(-1, 4, 4)
    up = _unit(-poses[:, :3, 1].sum(axis=0), np.array([0.0, -1.0, 0.0]))
    points = np.asarray(version.points, dtype=np.float64).reshape(-1, 3)
    points = points if len(points) else poses[:, :3, 3]
    if not len(points):
        return up * _LEAST_RADIUS_M, np.zeros(3), up
    low, high = np.percentile(points, [_OUTLIERS_PERCENT, 100 - _OUTLIERS_PERCENT], axis=0)
    centre = (low + high) / 2
    radius_m = max(_LEAST_RADIUS_M, float(np.linalg.norm(high - low)) / 2)
    ahead = poses[:, :3, 2].sum(axis=0)
    ahead = _unit(ahead - up * (ahead @ up), np.cross(up, _unit(np.cross(up, [1.0, 0.3, 0.2]), up)))
    height, back = np.sin(_ELEVATION_RAD), np.cos(_ELEVATION_RAD)
    return centre + _DISTANCE_RADII * radius_m * (height * up - back * ahead), centre, up


def _unit(vector: Array, otherwise: Array) -> Array:
    length = float(np.linalg.norm(vector))
    unit: Array = vector / length if length > _NO_DIRECTION else otherwise
    return unit


def _draw(server: Any, version: MapVersion) -> None:
    position, look_at, up = (tuple(float(x) for x in vector) for vector in first_view(version))
    server.scene.set_up_direction(up)
    camera = server.initial_camera
    camera.position, camera.look_at, camera.up = position, look_at, up
    every = max(1, -(-len(version.points) // _MAX_POINTS))
    server.scene.add_point_cloud(
        "/cloud", points=version.points[::every], colors=version.colours[::every], point_size=0.01
    )
    robots = sorted({row.robot for row in version.keyframes})
    for keyframe in version.keyframes:
        T, camera = keyframe.T_world_camera, keyframe.camera
        x, y, z, w = to_quaternion(T[:3, :3])
        server.scene.add_camera_frustum(
            f"/{printable(keyframe.robot)}/{keyframe.id}",
            fov=float(2 * np.arctan2(camera.height / 2, camera.fy)),
            aspect=camera.width / camera.height,
            scale=_CAMERA_M,
            color=COLOURS[robots.index(keyframe.robot) % len(COLOURS)],
            wxyz=(w, x, y, z),
            position=tuple(float(value) for value in T[:3, 3]),
        )


def _viser() -> Any:
    try:
        import viser
    except ImportError as error:
        raise MissingExtra("viser", "view") from error
    return viser
