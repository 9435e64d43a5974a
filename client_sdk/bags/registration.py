"""Register depth images: project the readings of a depth camera into the image of a colour camera."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array, Camera, transform

__all__ = ["register_depth"]

_MIN_DEPTH_M = 0.01  # smallest depth in the colour camera, metres, of a reading that is used


def register_depth(
    depth_m: npt.NDArray[np.float32], depth_camera: Camera, T_colour_depth: Array, colour_camera: Camera
) -> npt.NDArray[np.float32]:
    """Return the depth image of the colour camera, metres, 0 for pixels without a reading.

    If several readings are projected to one pixel, the nearest is used.  If the colour camera has a larger
    focal length in pixels, each reading fills a square of pixels whose side is the ratio, rounded up.

    Args:
        depth_m: ``(h, w)``, undistorted depth image of the depth camera, metres, 0 without a reading.
        depth_camera: Pinhole camera of the depth image.
        T_colour_depth: ``(4, 4)``, metres, from the frame of the depth camera to that of the colour camera.
        colour_camera: Pinhole camera of the result.
    """
    rows, columns = np.nonzero(depth_m)
    depths = depth_m[rows, columns].astype(np.float64)
    pixels = np.stack((columns, rows), axis=1).astype(np.float64)
    points = transform(T_colour_depth, depth_camera.back_project(pixels, depths))
    points = points[points[:, 2] > _MIN_DEPTH_M]
    # Sort the readings from far to near: of several readings in one pixel, the nearest is written last.
    points = points[np.argsort(-points[:, 2], kind="stable")]
    registered_m = np.zeros((colour_camera.height, colour_camera.width), dtype=np.float32)
    spread = max(1, math.ceil(colour_camera.fx / depth_camera.fx - 1e-6))
    corner = np.round(colour_camera.project(points) - (spread - 1) / 2).astype(np.int64)
    for across in range(spread):
        for down in range(spread):
            x, y = corner[:, 0] + across, corner[:, 1] + down
            inside = (x >= 0) & (x < colour_camera.width) & (y >= 0) & (y < colour_camera.height)
            seen = points[inside, 2].astype(np.float32)
            if spread == 1:
                registered_m[y[inside], x[inside]] = seen
                continue
            # The squares of several readings overlap: the nearest reading counts, not the last one.
            layer = np.zeros_like(registered_m)
            layer[y[inside], x[inside]] = seen
            registered_m = np.where(
                (registered_m == 0) | ((layer > 0) & (layer < registered_m)), layer, registered_m
            )
    return registered_m
