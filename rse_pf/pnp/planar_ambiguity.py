"""The planar pose ambiguity: under weak perspective, a plane and its mirror image look alike.

This module finds the second pose; the solver decides what it means.
"""

from __future__ import annotations

import math

import numpy as np

from rse_pf.geometry import Array, Camera, exp_se3, pose_difference, transform
from rse_pf.pnp.evidence import ERROR2, view_of

__all__ = ["second_planar_pose"]

_MAX_ITERATIONS = 15
_CONVERGED = 1e-7
_MAX_STEP = 10.0
_DISTINCT_M, _DISTINCT_DEG = 0.05, 1.0


def second_planar_pose(
    T_camera_world: Array, points_world: Array, pixels: Array, camera: Camera
) -> tuple[Array, float] | None:
    """Return the second ``(4, 4)`` pose and its sum of squared errors (px^2), or None.

    The plane through the points is mirrored about the line of sight, and the resulting pose is refined.
    None means that the refinement failed or converged to *T_camera_world*.  Points that fill space have a
    second pose as well, but its errors are large.

    Args:
        T_camera_world: ``(4, 4)``, the first pose.
        points_world: ``(n, 3)``, metres, world frame.
        pixels: ``(n, 2)``, undistorted pixels of the points.
        camera: Intrinsics of the image.

    Source:
        Schweighofer and Pinz, PAMI 2006; Collins and Bartoli, IJCV 2014.
    """
    points_camera = transform(T_camera_world, points_world)
    centre = points_camera.mean(axis=0)
    centred = points_camera - centre
    _, axes = np.linalg.eigh(centred.T @ centred)
    sight = centre / np.linalg.norm(centre)
    normal = axes[:, 0]
    mirrored = normal - 2.0 * (normal @ sight) * sight
    axis = np.cross(normal, mirrored)
    sine, cosine = float(np.linalg.norm(axis)), float(normal @ mirrored)
    if cosine < 0.0:
        axis, cosine = -axis, -cosine
    if sine < 1e-6:
        return None
    turn = exp_se3(np.concatenate([np.zeros(3), axis / sine * math.atan2(sine, cosine)]))
    turn[:3, 3] = centre - turn[:3, :3] @ centre
    other = _refined(turn @ T_camera_world, points_world, pixels, camera)
    if other is None:
        return None
    metres, degrees = pose_difference(T_camera_world, other)
    if metres < _DISTINCT_M and degrees < _DISTINCT_DEG:
        return None
    return other, float(view_of(other, points_world, pixels, camera)[ERROR2].sum())


def _refined(pose: Array, points_world: Array, pixels: Array, camera: Camera) -> Array | None:
    """Refine *pose* by Levenberg-Marquardt over all rows, with a left perturbation; None if it fails."""
    damping = 1e-3
    points = transform(pose, points_world)
    cost = math.inf if points[:, 2].min() <= 1e-6 else _cost(points, pixels, camera)
    if not math.isfinite(cost):
        return None
    for _ in range(_MAX_ITERATIONS):
        normal, gradient = _normal_equations(points, pixels, camera)
        normal[np.diag_indices(6)] *= 1.0 + damping
        try:
            step = np.linalg.solve(normal, gradient)
        except np.linalg.LinAlgError:
            return None
        if not float(np.abs(step).max()) < _MAX_STEP:
            return None
        moved = exp_se3(step) @ pose
        points_moved = transform(moved, points_world)
        cost_moved = math.inf if points_moved[:, 2].min() <= 1e-6 else _cost(points_moved, pixels, camera)
        if cost_moved > cost:
            damping *= 10.0
            continue
        has_converged = cost - cost_moved < _CONVERGED * cost
        pose, points, cost, damping = moved, points_moved, cost_moved, damping / 10.0
        if has_converged:
            break
    return pose


def _cost(points: Array, pixels: Array, camera: Camera) -> float:
    residual = camera.project(points) - pixels
    return float(np.vdot(residual, residual))


def _normal_equations(points: Array, pixels: Array, camera: Camera) -> tuple[Array, Array]:
    x, y, z = points.T
    a, b = x / z, y / z
    zero = np.zeros_like(z)
    by_u = camera.fx * np.array([1 / z, zero, -a / z, -a * b, 1 + a * a, -b])
    by_v = camera.fy * np.array([zero, 1 / z, -b / z, -1 - b * b, a * b, a])
    residual = pixels - camera.project(points)
    return by_u @ by_u.T + by_v @ by_v.T, by_u @ residual[:, 0] + by_v @ residual[:, 1]
