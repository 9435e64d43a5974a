"""Points that two views of one camera see, and how far points lie from the pixels that show them.

Which views are compared, and which points are used, is decided elsewhere.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array, Camera, transform

__all__ = ["parallax_deg", "reprojection_errors", "triangulate"]

_MIN_DEPTH = 1e-3


def triangulate(
    T_first_world: Array,
    T_second_world: Array,
    first: Array,
    second: Array,
    camera: Camera,
    *,
    max_error_px: float | Array = 2.0,
) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Return the ``(n, 3)`` points that two views see, and which lie before both and agree with both.

    Source:
        Hartley and Zisserman 2004, Sect. 12.2 (linear triangulation, in normalised coordinates).
    """
    rays = [_normalised(pixels, camera) for pixels in (first, second)]
    A = np.empty((len(first), 4, 4))
    for row, (pose, ray) in enumerate(zip((T_first_world, T_second_world), rays, strict=True)):
        A[:, 2 * row] = ray[:, :1] * pose[2] - pose[0]
        A[:, 2 * row + 1] = ray[:, 1:] * pose[2] - pose[1]
    # The smallest eigenvector of A^T A: with four well-scaled rows as good as the SVD, and faster.
    homogeneous = np.linalg.eigh(A.transpose(0, 2, 1) @ A)[1][:, :, 0]
    w = homogeneous[:, 3]
    far = np.abs(w) < 1e-9
    points = homogeneous[:, :3] / np.where(far, 1.0, w)[:, None]
    good = ~far
    for pose, pixels in ((T_first_world, first), (T_second_world, second)):
        moved = transform(pose, points)
        ahead = moved[:, 2] > _MIN_DEPTH
        moved[~ahead, 2] = 1.0
        errors = np.linalg.norm(camera.project(moved) - pixels, axis=1)
        good &= ahead & (errors <= max_error_px)
    return points, good


def parallax_deg(points: Array, first_centre: Array, second_centre: Array) -> Array:
    """Return the ``(n,)`` degrees between the rays from two camera centres to ``(n, 3)`` points."""
    one, two = points - first_centre, points - second_centre
    lengths = np.linalg.norm(one, axis=1) * np.linalg.norm(two, axis=1)
    cosines = np.einsum("ij,ij->i", one, two) / np.maximum(lengths, 1e-12)
    angles: Array = np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))
    return angles


def reprojection_errors(
    T_camera_world: Array, points_world: Array, pixels: Array, camera: Camera
) -> tuple[Array, Array]:
    """Return the ``(n,)`` distances in pixels and depths of ``(n, 3)`` points, each with its own pose.

    *T_camera_world* is ``(n, 4, 4)`` or ``(4, 4)``; the distance of a point behind the camera is infinite.
    """
    points = np.einsum("...ij,...j->...i", T_camera_world[..., :3, :3], points_world)
    points += T_camera_world[..., :3, 3]
    z = points[:, 2]
    ahead = points.copy()
    ahead[:, 2] = np.maximum(z, _MIN_DEPTH)
    distances = np.where(z > _MIN_DEPTH, np.linalg.norm(camera.project(ahead) - pixels, axis=1), np.inf)
    return distances, z


def _normalised(pixels: Array, camera: Camera) -> Array:
    return (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
