"""Poses that fit points, pixels and depths by the noise of all, in numpy; the core has its own derivation.

The error of the depth refinement is that of the fit to landmarks, with the covariance of a point as the depth
camera of the reference image saw it, so both share `linearised`.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def exp_se3(twist: Array) -> Array:
    """Return the motion of a twist by the series of the exponential."""
    x, y, z = twist[3:]
    X = np.zeros((4, 4))
    X[:3, :3], X[:3, 3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]], twist[:3]
    T = term = np.eye(4)
    for k in range(1, 30):
        term = term @ X / k
        T = T + term
    return T


def linearised(observed: Any, camera: Any, T: Array, near_m: float) -> tuple[Array, ...]:
    """Return slopes by the twist and by the point, weights, residuals and their squared distances."""
    has_depth = observed.depths_m > 0.0
    p = observed.points @ T[:3, :3].T + T[:3, 3]
    p[:, 2] = np.maximum(p[:, 2], near_m)
    x, y, z = p.T
    n = len(p)
    expected = np.column_stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy, z])
    residual = np.column_stack([observed.pixels, observed.depths_m]) - expected
    residual[~has_depth, 2] = 0.0
    by_point = np.zeros((n, 3, 3))
    by_point[:, 0, 0], by_point[:, 0, 2] = camera.fx / z, -camera.fx * x / z**2
    by_point[:, 1, 1], by_point[:, 1, 2] = camera.fy / z, -camera.fy * y / z**2
    by_point[:, 2, 2] = has_depth
    moved = np.tile(np.eye(3, 6), (n, 1, 1))
    moved[:, 0, 4], moved[:, 0, 5], moved[:, 1, 3] = z, -y, -z
    moved[:, 1, 5], moved[:, 2, 3], moved[:, 2, 4] = x, y, -x
    by_world = by_point @ T[:3, :3]
    variance = by_world @ observed.covariances @ by_world.transpose(0, 2, 1)
    variance[:, (0, 1), (0, 1)] += np.square(observed.pixel_sigmas_px)[:, None]
    variance[:, 2, 2] = np.where(has_depth, variance[:, 2, 2] + observed.depth_sigmas_m**2, 1.0)
    W = np.linalg.inv(variance)
    return by_point @ moved, by_point, W, residual, np.einsum("ni,nij,nj->n", residual, W, residual)


def normal(J: Array, W: Array, residual: Array, weight: Array) -> tuple[Array, Array]:
    """Return the information and the gradient of weighted rows."""
    return np.einsum("nia,nij,njb,n->ab", J, W, J, weight), np.einsum(
        "nia,nij,nj,n->a", J, W, residual, weight
    )


def fit_pose(observed: Any, camera: Any, T: Array, cauchy: float = 2.5, gate2: float = 11.3) -> Any:
    """Return pose, information and inliers of landmarks, None where some motion is free."""
    for iteration in range(10):
        J, _, W, residual, distance2 = linearised(observed, camera, T, 0.05)
        weight = 1.0 / (1.0 + distance2 / cauchy**2)
        if iteration >= 3:
            weight = weight * _is_inlier(observed, T, distance2, gate2)
        information, gradient = normal(J, W, residual, weight)
        if np.linalg.matrix_rank(information) < 6:
            return None
        twist = np.linalg.solve(information, gradient)
        T = exp_se3(twist) @ T
        if np.abs(twist).max() < 1e-6 and iteration > 3:
            break
    J, _, W, residual, distance2 = linearised(observed, camera, T, 0.05)
    is_inlier = _is_inlier(observed, T, distance2, gate2)
    information, _ = normal(J, W, residual, is_inlier.astype(float))
    if not np.diag(information).all():
        return None
    scales = 1.0 / np.sqrt(np.diag(information))
    if not np.linalg.eigvalsh(information * scales[:, None] * scales)[0] > 1e-12:
        return None
    return SimpleNamespace(T_camera_world=T, information=information, is_inlier=is_inlier)


def _is_inlier(observed: Any, T: Array, distance2: Array, gate2: float) -> npt.NDArray[np.bool_]:
    return (distance2 < gate2) & (observed.points @ T[2, :3] + T[2, 3] > 0.05)


def fit_readout_change(
    observed: Any, displacements: Array, camera: Any, T: Array, cauchy: float = 2.5
) -> tuple[float, float]:
    """Return the amount of a motion of the points that is solved beside the pose, and its information."""
    J, by_point, W, residual, distance2 = linearised(observed, camera, T, 0.05)
    J = np.concatenate([J, by_point @ displacements[:, :, None]], axis=2)
    information, gradient = normal(J, W, residual, 1.0 / (1.0 + distance2 / cauchy**2))
    covariance = np.linalg.inv(information)
    return float((covariance @ gradient)[6]), float(1.0 / covariance[6, 6])


def refine_with_depth(
    solution: Any, points: Array, pixels: Array, depths_m: Array, camera: Any, noise: Any
) -> Any:
    """Return the refined pose, its covariance and the error of its pixels; None where the pose stays."""
    rows = solution.inliers
    points, pixels, depths_m = points[rows], pixels[rows], depths_m[rows]
    if not (depths_m > 0.0).any():
        return None

    def deviation_m(z: Array) -> Array:
        return noise.base_m + noise.growth_per_m * np.maximum(0.0, z - noise.from_m) ** 2

    T, z = solution.T_camera_world, points[:, 2]
    pixel_px = max(0.05, 0.5 * solution.rmse_px)
    along = points / z[:, None]
    covariances = along[:, :, None] * along[:, None] * np.square(deviation_m(z))[:, None, None]
    covariances[:, 0, 0] += (pixel_px * z / camera.fx) ** 2
    covariances[:, 1, 1] += (pixel_px * z / camera.fy) ** 2
    last = False
    for step in range(7):  # six steps at most, and the errors at the last pose
        expected_m = np.maximum(points @ T[2, :3] + T[2, 3], 1e-3)
        observed = SimpleNamespace(
            points=points,
            covariances=covariances,
            pixels=pixels,
            pixel_sigmas_px=np.full(len(rows), pixel_px),
            depths_m=depths_m,
            depth_sigmas_m=deviation_m(expected_m),
        )
        J, _, W, residual, distance2 = linearised(observed, camera, T, 1e-3)
        weight = 1.0 / (1.0 + distance2 / 2.5**2)
        if last:
            break
        twist = np.linalg.solve(*normal(J, W, residual, weight))
        T, last = exp_se3(twist) @ T, step == 5 or bool(np.abs(twist).max() < 1e-5)
    # The covariance of an M-estimator: Huber, Robust Statistics (1981), Sect. 7.6.
    numbers = 2.0 + (depths_m > 0.0)
    slope = ((numbers * weight) - 2.0 * weight**2 * distance2 / 2.5**2).sum() / numbers.sum()
    square = (weight**2 * distance2).sum() / max(1.0, numbers.sum() - 6.0)
    rmse_px = float(np.sqrt((residual[:, :2] ** 2).sum() / len(rows)))
    if not (slope > 0.0 and rmse_px <= 1.5 * max(0.2, solution.rmse_px)):
        return None
    covariance = np.linalg.inv(normal(J, W, residual, np.ones(len(rows)))[0])
    return SimpleNamespace(
        T_camera_world=T, covariance=covariance * max(0.01, square / slope**2), rmse_px=rmse_px
    )
