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
from rse_pf.geometry import to_quaternion
from rse_pf.maps.format import MapVersion
from rse_pf.terminal import printable

__all__ = ["browse_map"]

_HOST = "127.0.0.1"
_MAX_POINTS = 1_000_000
_CAMERA_M = 0.08


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


def _draw(server: Any, version: MapVersion) -> None:
    if version.keyframes:
        up = -np.mean([each.T_world_camera[:3, 1] for each in version.keyframes], axis=0)
        server.scene.set_up_direction(tuple(float(x) for x in up / np.linalg.norm(up)))
    every = max(1, -(-len(version.points) // _MAX_POINTS))
    server.scene.add_point_cloud(
        "/cloud", points=version.points[::every], colors=version.colours[::every], point_size=0.01
    )
    robots = sorted({each.robot for each in version.keyframes})
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
