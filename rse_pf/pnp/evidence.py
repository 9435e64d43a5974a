"""What speaks for and against a proposed pose: residuals, chance, geometry, covariance.

Closed forms on small matrices, because this runs for every frame.  Promises to change no pose.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array, Camera, exp_se3

__all__ = ["Residuals", "flipped_rmse_px", "information", "log10_false_alarms", "residuals", "slenderness"]

_LOG10_E = math.log10(math.e)
_SAMPLE = 3
_POSES_OF_A_SAMPLE = 4
_KEPT_SHARE = 0.8


class Residuals:
    """Points in the camera's frame and their squared reprojection errors, ``(n,)`` px^2."""

    __slots__ = ("error2_px2", "points_camera")

    def __init__(self, points_camera: Array, error2_px2: Array) -> None:
        self.points_camera = points_camera
        self.error2_px2 = error2_px2


def residuals(pose: Array, points_world: Array, pixels: Array, camera: Camera) -> Residuals:
    """Return the residuals under ``(3, 4)`` *pose*; a point behind the camera has infinite error."""
    points_camera = points_world @ pose[:, :3].T
    points_camera += pose[:, 3]
    x, y, z = points_camera.T
    in_front = z > 1e-6
    if not in_front.all():
        z = np.where(in_front, z, 1.0)
    u = x / z
    u *= camera.fx
    u += camera.cx
    u -= pixels[:, 0]
    v = y / z
    v *= camera.fy
    v += camera.cy
    v -= pixels[:, 1]
    u *= u
    v *= v
    u += v
    if not in_front.all():
        u[~in_front] = np.inf
    return Residuals(points_camera, u)


def log10_false_alarms(n: int, inliers: int, largest_error2_px2: float, camera: Camera) -> float:
    """Return log10 of how many poses of pure chance would have as many inliers, as close.

    Below 0, chance is no explanation; the smaller, the surer.

    Source:
        Moisan and Stival, IJCV 2004; for PnP: Moulon et al., ACCV 2012.
    """
    area = float(camera.width * camera.height)
    share = min(1.0, math.pi * max(largest_error2_px2, 0.25) / area)
    log = (
        math.log(_POSES_OF_A_SAMPLE * max(1, n - _SAMPLE))
        + _log_choose(n, inliers)
        + _log_choose(inliers, _SAMPLE)
        + (inliers - _SAMPLE) * math.log(share)
    )
    return log * _LOG10_E


def slenderness(rows: Array) -> float:
    """Return width over length of ``(n, 2 or 3)`` *rows*: 0 on a line, 0 if they coincide.

    Width is the distance from the main axis that 80 % of the rows stay below, so a few strays
    beside a line do not make it wide.
    """
    centred = rows - rows.mean(axis=0)
    _, axes = np.linalg.eigh(centred.T @ centred)
    along = centred @ axes[:, -1]
    along *= along
    aside = np.einsum("ij,ij->i", centred, centred)
    aside -= along
    k = min(len(rows) - 1, int(_KEPT_SHARE * len(rows)))
    width2, length2 = float(np.partition(aside, k)[k]), float(np.partition(along, k)[k])
    if length2 <= 1e-18:
        return 0.0
    return math.sqrt(max(0.0, width2) / length2)


def information(points_camera: Array, camera: Camera) -> Array:
    """Return the ``(6, 6)`` matrix J^T J of the pixels by the twist (rho, phi) left of the pose.

    Source:
        Barfoot, State Estimation for Robotics (2017), Sect. 7.3 (left perturbation).
    """
    n = len(points_camera)
    z_inv = 1.0 / points_camera[:, 2]
    a = points_camera[:, 0] * z_inv
    b = points_camera[:, 1] * z_inv
    J = np.zeros((6, 2, n))
    ab = a * b
    J[0, 0] = z_inv
    J[1, 1] = z_inv
    J[2, 0] = -a * z_inv
    J[2, 1] = -b * z_inv
    J[3, 0] = -ab
    J[3, 1] = -1.0 - b * b
    J[4, 0] = 1.0 + a * a
    J[4, 1] = ab
    J[5, 0] = -b
    J[5, 1] = a
    J[:, 0] *= camera.fx
    J[:, 1] *= camera.fy
    flat = J.reshape(6, 2 * n)
    matrix: Array = flat @ flat.T
    return matrix


def flipped_rmse_px(pose: Array, points_world: Array, pixels: Array, camera: Camera) -> float | None:
    """Return the error of the second pose of a plane seen from afar, or None if points fill space.

    A plane's mirror image about the line of sight projects almost alike when perspective is weak;
    the flipped pose is refined before it is judged.

    Source:
        Schweighofer and Pinz, PAMI 2006; Collins and Bartoli, IJCV 2014.
    """
    points_camera = points_world @ pose[:, :3].T + pose[:, 3]
    centre = points_camera.mean(axis=0)
    centred = points_camera - centre
    spread, axes = np.linalg.eigh(centred.T @ centred)
    if spread[0] > 1e-3 * spread[2]:
        return None
    sight = centre / np.linalg.norm(centre)
    normal = axes[:, 0]
    mirrored = normal - 2.0 * (normal @ sight) * sight
    axis = np.cross(normal, mirrored)
    sine, cosine = float(np.linalg.norm(axis)), float(normal @ mirrored)
    if cosine < 0.0:
        axis, cosine = -axis, -cosine
    if sine < 1e-6:
        return None
    turn = exp_se3(np.concatenate([np.zeros(3), axis / sine * math.atan2(sine, cosine)]))[:3, :3]
    flipped = np.hstack([turn @ pose[:, :3], (turn @ (pose[:, 3] - centre) + centre)[:, None]])
    for _ in range(8):
        moved = _gauss_newton(flipped, points_world, pixels, camera)
        if moved is None:
            return None
        flipped = moved
    if np.linalg.norm(flipped - pose) < 1e-3:
        return None
    error2 = residuals(flipped, points_world, pixels, camera).error2_px2
    return math.sqrt(float(error2.mean()))


def _gauss_newton(pose: Array, points_world: Array, pixels: Array, camera: Camera) -> Array | None:
    points = points_world @ pose[:, :3].T + pose[:, 3]
    if points[:, 2].min() <= 1e-6:
        return None
    x, y, z = points.T
    a, b = x / z, y / z
    zero = np.zeros_like(z)
    Ju = camera.fx * np.array([1 / z, zero, -a / z, -a * b, 1 + a * a, -b])
    Jv = camera.fy * np.array([zero, 1 / z, -b / z, -1 - b * b, a * b, a])
    ru = pixels[:, 0] - (camera.fx * a + camera.cx)
    rv = pixels[:, 1] - (camera.fy * b + camera.cy)
    try:
        step = np.linalg.solve(Ju @ Ju.T + Jv @ Jv.T + 1e-9 * np.eye(6), Ju @ ru + Jv @ rv)
    except np.linalg.LinAlgError:
        return None
    if not np.isfinite(step).all() or np.linalg.norm(step) > 10.0:
        return None
    T = exp_se3(step)
    turned: npt.NDArray[np.float64] = np.hstack(
        [T[:3, :3] @ pose[:, :3], (T[:3, :3] @ pose[:, 3] + T[:3, 3])[:, None]]
    )
    return turned


def _log_choose(n: int, k: int) -> float:
    return math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1)
