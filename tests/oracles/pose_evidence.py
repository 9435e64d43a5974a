"""The evidence for one camera pose, in numpy; the native core has its own derivation.

Sources: chance, Moisan and Stival, IJCV 2004, and Moulon et al., ACCV 2012; the second pose of a plane,
Schweighofer and Pinz, PAMI 2006; slopes, Barfoot, State Estimation for Robotics (2017), Sect. 7.3.
"""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np

from tests.oracles.pose_fit import Array, exp_se3


def seen(T: Array, points: Array, pixels: Array, camera: Any) -> tuple[Array, Array, Array, Array]:
    """Return the points in the camera's frame, their pixels, residuals, and squared errors (px^2)."""
    p = points @ T[:3, :3].T + T[:3, 3]
    z = np.maximum(p[:, 2], 1e-6)
    projected = np.column_stack([camera.fx * p[:, 0] / z + camera.cx, camera.fy * p[:, 1] / z + camera.cy])
    residual = pixels - projected
    return p, projected, residual, np.where(p[:, 2] > 1e-6, (residual**2).sum(axis=1), np.inf)


def normal(p: Array, residual: Array, camera: Any) -> tuple[Array, Array]:
    """Return J^T J and J^T r by the twist left of the pose."""
    z = p[:, 2]
    a, b, zero = p[:, 0] / z, p[:, 1] / z, np.zeros_like(z)
    u = camera.fx * np.array([1 / z, zero, -a / z, -a * b, 1 + a * a, -b])
    v = camera.fy * np.array([zero, 1 / z, -b / z, -1 - b * b, a * b, a])
    return u @ u.T + v @ v.T, u @ residual[:, 0] + v @ residual[:, 1]


def log10_false_alarms(n: int, inliers: int, largest2: float, camera: Any) -> float:
    """Return log10 of the expected number of random poses that fit as well."""
    if inliers <= 3:
        return math.inf
    share = min(1.0, math.pi * max(largest2, 0.01) / (camera.width * camera.height))
    samples = 4 * (n - 3) * math.comb(n, inliers) * math.comb(inliers, 3)
    return math.log10(samples) + (inliers - 3) * math.log10(share)


def count_independent(pixels: Array, camera: Any) -> int:
    """Count pixels in the same or in adjacent cells (40 across) once, unless 24 cells are occupied."""
    cells = set(map(tuple, (pixels * (40 / camera.width)).astype(int).tolist()))
    if len(cells) >= 24:
        return len(pixels)
    alone: set[tuple[int, ...]] = set()
    for u, v in sorted(cells):
        if not {(u - 1, v - 1), (u - 1, v), (u - 1, v + 1), (u, v - 1)} & alone:
            alone.add((u, v))
    return len(alone)


def width_to_length(rows: Array) -> float:
    """Return width over length, both without the farthest fifth of the rows."""
    centred = rows - rows.mean(axis=0)
    along = (centred @ np.linalg.eigh(centred.T @ centred)[1][:, -1]) ** 2
    aside = (centred**2).sum(axis=1) - along
    kth = min(len(rows) - 1, int(0.8 * len(rows)))
    width2, length2 = np.sort(aside)[kth], np.sort(along)[kth]
    return math.sqrt(max(0.0, width2) / length2) if length2 > 1e-18 else 0.0


def second_squares(T: Array, points: Array, pixels: Array, camera: Any) -> float | None:
    """Return the squared errors of the mirrored plane's pose; None where it is *T* or does not converge."""
    p = seen(T, points, pixels, camera)[0]
    centre = p.mean(axis=0)
    plane = np.linalg.eigh((p - centre).T @ (p - centre))[1][:, 0]
    sight = centre / np.linalg.norm(centre)
    mirrored = plane - 2 * (plane @ sight) * sight
    mirrored = -mirrored if plane @ mirrored < 0 else mirrored
    axis = np.cross(plane, mirrored)
    sine = np.linalg.norm(axis)
    if sine < 1e-6:
        return None
    turn = exp_se3(np.concatenate([np.zeros(3), axis / sine * math.atan2(sine, plane @ mirrored)]))
    turn[:3, 3] = centre - turn[:3, :3] @ centre
    other, damping = turn @ T, 1e-3
    p, _, residual, error2 = seen(other, points, pixels, camera)
    for _ in range(15):
        if not np.isfinite(error2).all():
            return None
        A, g = normal(p, residual, camera)
        step = np.linalg.solve(A + damping * np.diag(A.diagonal()), g)
        if not np.abs(step).max() < 10.0:
            return None
        moved = exp_se3(step) @ other
        after = seen(moved, points, pixels, camera)
        if after[3].sum() > error2.sum():
            damping *= 10
            continue
        is_done = error2.sum() - after[3].sum() < 1e-7 * error2.sum()
        other, damping, (p, _, residual, error2) = moved, damping / 10, after
        if is_done:
            break
    D = other[:3, :3].T @ T[:3, :3]
    metres = np.linalg.norm(T[:3, 3] - other[:3, 3])
    degrees = math.degrees(math.acos(min(1.0, (np.trace(D) - 1) / 2)))
    return None if metres < 0.05 and degrees < 1.0 else float(error2.sum())


def evidence(T: Array, points: Array, pixels: Array, camera: Any, inlier_px: float) -> Any:
    """Return the evidence of the pose *T*, which has at least four inliers."""
    p, projected, residual, error2 = seen(T, points, pixels, camera)
    rows = np.flatnonzero(error2 <= inlier_px**2)
    n, k = len(points), len(rows)
    p, projected, residual, error2 = p[rows], projected[rows], residual[rows], error2[rows]
    independent = count_independent(projected, camera)
    inverse_depth = 1 / p[:, 2]
    other = None
    if inverse_depth.std() / inverse_depth.mean() < 0.08:
        other = second_squares(T, points[rows], pixels[rows], camera)
    information, _ = normal(p, residual, camera)
    return SimpleNamespace(
        inliers=rows,
        rmse_px=math.sqrt(error2.mean()),
        independent_inliers=independent,
        log10_false_alarms=log10_false_alarms(n - k + independent, independent, error2.max(), camera),
        is_chance=log10_false_alarms(n, k, error2.max(), camera) > -5.0,
        inlier_width_to_length=width_to_length(projected),
        radius_px=math.sqrt(projected.var(axis=0).sum()),
        covariance=max(error2.sum() / max(1, 2 * k - 6), 0.01) * np.linalg.inv(information),
        second_pose_rmse_px=0.0 if other is None else math.sqrt(other / k),
    )
