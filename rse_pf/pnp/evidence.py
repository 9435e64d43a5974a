"""What speaks for and against a proposed pose: residuals, chance, geometry, covariance.

Closed forms on small matrices, because this runs for every frame.  Promises to change no pose.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array, Camera, exp_se3

__all__ = ["Spread", "flipped_rmse_px", "information", "log10_false_alarms", "slenderness", "view_of"]

_LOG10_E = math.log10(math.e)
_SAMPLE = 3
_POSES_OF_A_SAMPLE = 4
_KEPT_SHARE = 0.8
_NEAR_M = 1e-6
_STRAYS = 4.0
_PLAINLY_WIDE = 0.15

# Rows of the Jacobian by (rho, phi) as signed rows of 1/z, a/z, b/z, ab, 1+a^2, 1+b^2, a, b.
_ROWS_U, _SIGNS_U = np.array([0, 0, 1, 3, 4, 7]), np.array([1.0, 0, -1, -1, 1, -1])
_ROWS_V, _SIGNS_V = np.array([0, 0, 2, 5, 3, 6]), np.array([0.0, 1, -1, -1, 1, 1])
_TAKE_U, _SIGN_U = _ROWS_U[:, None] * 8 + _ROWS_U, np.outer(_SIGNS_U, _SIGNS_U)
_TAKE_V, _SIGN_V = _ROWS_V[:, None] * 8 + _ROWS_V, np.outer(_SIGNS_V, _SIGNS_V)

X, Y, Z, A, B, Z_INV = range(6)
"""Rows of a view: camera-frame coordinates, slopes a = x/z and b = y/z, and 1/z."""


def view_of(pose: Array, points_world: Array, pixels: Array, camera: Camera) -> tuple[Array, Array]:
    """Return the ``(6, n)`` view under ``(3, 4)`` *pose* and ``(n,)`` squared errors, px^2.

    A point that is not before the camera has infinite error.
    """
    view = np.empty((6, len(pixels)))
    np.matmul(pose[:, :3], points_world.T, out=view[:3])
    view[:3] += pose[:, 3:]
    z = view[Z]
    behind = None if z.min() > _NEAR_M else z <= _NEAR_M
    if behind is not None:
        z[behind] = _NEAR_M
    np.divide(1.0, z, out=view[Z_INV])
    np.multiply(view[:2], view[Z_INV], out=view[A : B + 1])
    error2 = view[A] * camera.fx
    error2 += camera.cx - pixels[:, 0]
    error2 *= error2
    down = view[B] * camera.fy
    down += camera.cy - pixels[:, 1]
    down *= down
    error2 += down
    if behind is not None:
        error2[behind] = np.inf
    return view, error2


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


class Spread:
    """How wide the inliers lie, in space and in the image.

    ``thinness`` is width over length, of the slimmer of the two: 0 on a line, 0 if they coincide.
    ``image_radius`` is the largest distance from their centre in the image, in slopes.
    """

    __slots__ = ("image_radius", "thinness")

    def __init__(self, view: Array) -> None:
        k = view.shape[1]
        centred = view[: B + 1] - np.add.reduce(view[: B + 1], axis=1, keepdims=True) / k
        moments = centred @ centred.T
        squares = centred * centred
        radius2 = squares[X] + squares[Y] + squares[Z]
        image2 = squares[A] + squares[B]
        self.image_radius = math.sqrt(float(image2.max()))
        self.thinness = min(
            _thinness(centred[:A], moments[:A, :A], radius2), _thinness(centred[A:], moments[A:, A:], image2)
        )


def slenderness(rows: Array) -> float:
    """Return width over length of ``(n, 2 or 3)`` *rows*: 0 on a line, 0 if they coincide."""
    centred = (rows - rows.mean(axis=0)).T
    return _thinness(centred, centred @ centred.T, (centred * centred).sum(axis=0))


def _thinness(centred: Array, moments: Array, radius2: Array) -> float:
    """Width is the distance from the main axis that 80 % of the rows stay below.

    So a few strays beside a line do not make it wide.  Where the moments alone prove the rows wide
    even without the four farthest of them, no axis is computed.
    """
    largest, middle = _two_largest_eigenvalues(moments.tolist())
    if largest <= 1e-18:
        return 0.0
    spare = middle - _STRAYS * float(radius2.max())
    if spare > _PLAINLY_WIDE**2 * largest:
        return math.sqrt(spare / largest)
    _, axes = np.linalg.eigh(moments)
    along = axes[:, -1] @ centred
    along *= along
    aside = radius2 - along
    k = min(len(along) - 1, int(_KEPT_SHARE * len(along)))
    width2, length2 = float(np.partition(aside, k)[k]), float(np.partition(along, k)[k])
    if length2 <= 1e-18:
        return 0.0
    return math.sqrt(max(0.0, width2) / length2)


def _two_largest_eigenvalues(m: list[list[float]]) -> tuple[float, float]:
    """Return the two largest eigenvalues of a symmetric 2x2 or 3x3 matrix, largest first.

    Source:
        Smith, Communications of the ACM 4 (1961): the trigonometric closed form.
    """
    if len(m) == 2:
        mean, half = (m[0][0] + m[1][1]) / 2, (m[0][0] - m[1][1]) / 2
        root = math.hypot(half, m[0][1])
        return mean + root, mean - root
    mean = (m[0][0] + m[1][1] + m[2][2]) / 3
    d0, d1, d2 = m[0][0] - mean, m[1][1] - mean, m[2][2] - mean
    o01, o02, o12 = m[0][1], m[0][2], m[1][2]
    p = math.sqrt((d0 * d0 + d1 * d1 + d2 * d2 + 2 * (o01 * o01 + o02 * o02 + o12 * o12)) / 6)
    if p == 0.0:
        return mean, mean
    determinant = d0 * (d1 * d2 - o12 * o12) - o01 * (o01 * d2 - o12 * o02) + o02 * (o01 * o12 - d1 * o02)
    angle = math.acos(max(-1.0, min(1.0, determinant / (2 * p**3)))) / 3
    largest = mean + 2 * p * math.cos(angle)
    smallest = mean + 2 * p * math.cos(angle + 2 * math.pi / 3)
    return largest, 3 * mean - largest - smallest


def information(view: Array, camera: Camera) -> Array:
    """Return the ``(6, 6)`` matrix J^T J of the pixels by the twist (rho, phi) left of the pose.

    The Jacobian's rows are linear in eight products of a, b and 1/z, so one small product of
    matrices replaces a tall one.

    Source:
        Barfoot, State Estimation for Robotics (2017), Sect. 7.3 (left perturbation).
    """
    products = np.empty((8, view.shape[1]))
    products[0] = view[Z_INV]
    np.multiply(view[A : B + 1], view[Z_INV], out=products[1:3])
    np.multiply(view[A], view[B], out=products[3])
    np.multiply(view[A : B + 1], view[A : B + 1], out=products[4:6])
    products[4:6] += 1.0
    products[6:] = view[A : B + 1]
    moments = products @ products.T
    matrix: Array = moments.take(_TAKE_U)
    matrix *= _SIGN_U * camera.fx**2
    other = moments.take(_TAKE_V)
    other *= _SIGN_V * camera.fy**2
    matrix += other
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
    _, error2 = view_of(flipped, points_world, pixels, camera)
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
