"""Evidence for and against a proposed pose: residuals, probability of chance, geometry, covariance.

It is computed for every frame, and therefore from sums of products instead of tall matrices.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from rse_pf.geometry import Array, Camera

__all__ = [
    "Shape",
    "independent_inliers",
    "inverse_of_information",
    "log10_false_alarms",
    "view_of",
    "width_to_length",
]

U, V, ONE, Z_INV, ERROR2 = range(5)
"""Rows of a view: projected pixel, ones, 1/z in the camera's frame, and squared error, px^2."""

_LOG10_E = math.log10(math.e)
_SAMPLE, _POSES_OF_A_SAMPLE = 3, 4
# Lower bound of a squared residual: messages are rounded, and four points may fit by luck.
_MIN_ERROR2_PX2 = 0.01
_KEPT_SHARE = 0.8
_NEAR_M = 1e-6
_OUTLIER_FACTOR = 4.0
_CLEARLY_WIDE = 0.15
_CELLS_ACROSS = 40
_MANY_CELLS, _FIRST_INLIERS = 24, 32


@lru_cache(maxsize=64)
def _optics(camera: Camera) -> tuple[Array, Array]:
    """Return ``(4, 4)`` from camera-frame points to (u z, v z, z, 1), and ``(36, 256)`` to J^T J.

    Both rows of the Jacobian are linear in the products of a = x/z, b = y/z, 1 and 1/z with each
    other, and those in the products of a view's rows; so J^T J is linear in the moments of the latter.

    Source:
        Barfoot, State Estimation for Robotics (2017), Sect. 7.3 (left perturbation).
    """
    project = np.eye(4)
    project[:3, :3] = camera.matrix
    a, b, one, z_inv = range(4)
    by_u, by_v = np.zeros((6, 4, 4)), np.zeros((6, 4, 4))
    # d(a, b) by (rho, phi): [1/z, 0, -a/z, -ab, 1+a^2, -b] and [0, 1/z, -b/z, -1-b^2, ab, a]
    by_u[0, z_inv, one] = by_v[1, z_inv, one] = 1.0
    by_u[2, a, z_inv] = by_v[2, b, z_inv] = -1.0
    by_u[3, a, b] = by_v[3, one, one] = by_v[3, b, b] = -1.0
    by_u[4, one, one] = by_u[4, a, a] = by_v[4, a, b] = 1.0
    by_u[5, b, one], by_v[5, a, one] = -1.0, 1.0
    slopes_of_view = np.linalg.inv(project)
    pairs = np.kron(slopes_of_view, slopes_of_view)
    u, v = camera.fx * by_u.reshape(6, 16) @ pairs, camera.fy * by_v.reshape(6, 16) @ pairs
    return project, np.kron(u, u) + np.kron(v, v)


def view_of(T_camera_world: Array, points_world: Array, pixels: Array, camera: Camera) -> Array:
    """Return the ``(5, n)`` view of the points; its last row holds the squared reprojection errors (px^2).

    A point behind the camera has an infinite error.
    """
    project = _optics(camera)[0] @ T_camera_world
    homogeneous = project[:, :3] @ points_world.T
    homogeneous += project[:, 3:]
    z = homogeneous[2]
    behind = None if np.minimum.reduce(z) > _NEAR_M else z <= _NEAR_M
    if behind is not None:
        z[behind] = _NEAR_M
    view = np.empty((5, len(pixels)))
    np.divide(homogeneous, z, out=view[:ERROR2])
    error = view[:ONE] - pixels.T
    error *= error
    np.add(error[0], error[1], out=view[ERROR2])
    if behind is not None:
        view[ERROR2, behind] = np.inf
    return view


def log10_false_alarms(n: int, inliers: int, largest_error2_px2: float, camera: Camera) -> float:
    """Return log10 of the expected number of random poses with as many inliers at least as close.

    Below 0, chance is ruled out; the smaller, the more certain.

    Source:
        Moisan and Stival, IJCV 2004; for PnP: Moulon et al., ACCV 2012.
    """
    if inliers <= _SAMPLE:
        return math.inf
    area = float(camera.width * camera.height)
    share = min(1.0, math.pi * max(largest_error2_px2, _MIN_ERROR2_PX2) / area)
    log = (
        math.log(_POSES_OF_A_SAMPLE * (n - _SAMPLE))
        + _log_choose(n, inliers)
        + _log_choose(inliers, _SAMPLE)
        + (inliers - _SAMPLE) * math.log(share)
    )
    return log * _LOG10_E


def independent_inliers(view: Array, camera: Camera) -> int:
    """Return how many of the inliers in *view* count as independent observations.

    Copies of one correspondence all agree with any pose that fits one of them.  Inliers in the same or in
    adjacent cells of the image (40 across) therefore count once; if very many cells are occupied, every
    inlier counts.
    """
    scale = _CELLS_ACROSS / camera.width
    if len(_cells(view[:ONE, :_FIRST_INLIERS], scale)) >= _MANY_CELLS:
        return int(view.shape[1])
    cells = _cells(view[:ONE], scale)
    if len(cells) >= _MANY_CELLS:
        return int(view.shape[1])
    alone: set[tuple[int, int]] = set()
    for u, v in sorted(cells):
        if not {(u - 1, v - 1), (u - 1, v), (u - 1, v + 1), (u, v - 1)} & alone:
            alone.add((u, v))
    return len(alone)


def _cells(pixels: Array, scale: float) -> set[tuple[int, int]]:
    columns, rows = (pixels * scale).astype(np.int64).tolist()
    return set(zip(columns, rows, strict=True))


class Shape:
    """The distribution of the inliers of a ``(5, k)`` view, and how well they constrain the pose.

    ``thinness`` is width over length in the image: 0 on a line, 0 if they coincide; points on one line
    in space lie on one line there.  ``radius_px`` is the root mean square distance
    from their centre.  ``depth_variation`` is the standard deviation of 1/z over its mean.
    ``information`` is the ``(6, 6)`` J^T J by the twist (rho, phi) left of the pose.
    """

    __slots__ = ("depth_variation", "information", "radius_px", "thinness")

    def __init__(self, view: Array, camera: Camera) -> None:
        k = view.shape[1]
        base = view[:ERROR2]
        products = (base[:, None] * base).reshape(16, k)
        moments = products @ products.T
        self.information: Array = (_optics(camera)[1] @ moments.ravel()).reshape(6, 6)
        # Product 10 is 1 * 1, so its row holds the plain sums of all products.
        uu, uv, u, _, _, vv, v, _, _, _, _, w, _, _, _, ww = moments[10].tolist()
        self.depth_variation = math.sqrt(max(0.0, ww * k / (w * w) - 1.0))
        mean_u, mean_v = u / k, v / k
        length2, width2 = _eigenvalues(uu - u * mean_u, uv - u * mean_v, vv - v * mean_v)
        self.radius_px = math.sqrt(max(0.0, length2 + width2) / k)
        # No inlier lies further out than the corner of the image (or, outside it, than three times the rms).
        reach_u, reach_v = max(mean_u, camera.width - mean_u), max(mean_v, camera.height - mean_v)
        margin = width2 - _OUTLIER_FACTOR * max(
            reach_u * reach_u + reach_v * reach_v, 9.0 * self.radius_px**2
        )
        if margin > _CLEARLY_WIDE**2 * length2:
            self.thinness = math.sqrt(margin / length2)
        else:
            self.thinness = width_to_length(view[:ONE].T)


def inverse_of_information(information: Array, variance_px2: float) -> tuple[Array, list[float]]:
    """Return *variance_px2* times the inverse of a symmetric ``(6, 6)`` matrix, and its diagonal.

    By blocks of 3x3 with plain numbers: a third of the time of a general inverse at this size.

    Raises:
        ZeroDivisionError: A block is singular: some motion of the camera changes no pixel.
    """
    rows = (information / variance_px2).tolist()
    (a0, a1, a2, b00, b01, b02), (_, a3, a4, b10, b11, b12), (_, _, a5, b20, b21, b22) = rows[:3]
    (_, _, _, d0, d1, d2), (_, _, _, _, d3, d4), (_, _, _, _, _, d5) = rows[3:]
    p0, p1, p2, p3, p4, p5 = _symmetric_inverse(a0, a1, a2, a3, a4, a5)
    # W = A^-1 B, then the Schur complement S = D - B^T W.
    w00, w01, w02 = (
        p0 * b00 + p1 * b10 + p2 * b20,
        p0 * b01 + p1 * b11 + p2 * b21,
        p0 * b02 + p1 * b12 + p2 * b22,
    )
    w10, w11, w12 = (
        p1 * b00 + p3 * b10 + p4 * b20,
        p1 * b01 + p3 * b11 + p4 * b21,
        p1 * b02 + p3 * b12 + p4 * b22,
    )
    w20, w21, w22 = (
        p2 * b00 + p4 * b10 + p5 * b20,
        p2 * b01 + p4 * b11 + p5 * b21,
        p2 * b02 + p4 * b12 + p5 * b22,
    )
    q0, q1, q2, q3, q4, q5 = _symmetric_inverse(
        d0 - b00 * w00 - b10 * w10 - b20 * w20,
        d1 - b00 * w01 - b10 * w11 - b20 * w21,
        d2 - b00 * w02 - b10 * w12 - b20 * w22,
        d3 - b01 * w01 - b11 * w11 - b21 * w21,
        d4 - b01 * w02 - b11 * w12 - b21 * w22,
        d5 - b02 * w02 - b12 * w12 - b22 * w22,
    )
    # X = W S^-1 is minus the block off the diagonal, and the first block is A^-1 + X W^T.
    x00, x01, x02 = (
        w00 * q0 + w01 * q1 + w02 * q2,
        w00 * q1 + w01 * q3 + w02 * q4,
        w00 * q2 + w01 * q4 + w02 * q5,
    )
    x10, x11, x12 = (
        w10 * q0 + w11 * q1 + w12 * q2,
        w10 * q1 + w11 * q3 + w12 * q4,
        w10 * q2 + w11 * q4 + w12 * q5,
    )
    x20, x21, x22 = (
        w20 * q0 + w21 * q1 + w22 * q2,
        w20 * q1 + w21 * q3 + w22 * q4,
        w20 * q2 + w21 * q4 + w22 * q5,
    )
    p0 += x00 * w00 + x01 * w01 + x02 * w02
    p1 += x00 * w10 + x01 * w11 + x02 * w12
    p2 += x00 * w20 + x01 * w21 + x02 * w22
    p3 += x10 * w10 + x11 * w11 + x12 * w12
    p4 += x10 * w20 + x11 * w21 + x12 * w22
    p5 += x20 * w20 + x21 * w21 + x22 * w22
    inverse = np.array(
        [
            p0, p1, p2, -x00, -x01, -x02, p1, p3, p4, -x10, -x11, -x12, p2, p4, p5, -x20, -x21, -x22,
            -x00, -x10, -x20, q0, q1, q2, -x01, -x11, -x21, q1, q3, q4, -x02, -x12, -x22, q2, q4, q5,
        ]
    )  # fmt: skip
    return inverse.reshape(6, 6), [p0, p3, p5, q0, q3, q5]


def _symmetric_inverse(
    a: float, b: float, c: float, d: float, e: float, f: float
) -> tuple[float, float, float, float, float, float]:
    """Return the upper triangle of the inverse of [[a, b, c], [b, d, e], [c, e, f]]."""
    first, second, third = d * f - e * e, c * e - b * f, b * e - c * d
    scale = 1.0 / (a * first + b * second + c * third)
    return (
        first * scale, second * scale, third * scale,
        (a * f - c * c) * scale, (b * c - a * e) * scale, (a * d - b * b) * scale,
    )  # fmt: skip


def width_to_length(rows: Array) -> float:
    """Return width over length of ``(n, 2 or 3)`` *rows*: 0 on a line, 0 if they coincide.

    Width is the distance from the main axis that 80 % of the rows stay below, so that a few outliers
    beside a line do not count.
    """
    centred = (rows - rows.mean(axis=0)).T
    radius2 = np.add.reduce(centred * centred, axis=0)
    _, axes = np.linalg.eigh(centred @ centred.T)
    along = axes[:, -1] @ centred
    along *= along
    aside = radius2 - along
    kth = min(len(along) - 1, int(_KEPT_SHARE * len(along)))
    width2, length2 = float(np.partition(aside, kth)[kth]), float(np.partition(along, kth)[kth])
    if length2 <= 1e-18:
        return 0.0
    return math.sqrt(max(0.0, width2) / length2)


def _eigenvalues(xx: float, xy: float, yy: float) -> tuple[float, float]:
    mean, root = (xx + yy) / 2.0, math.hypot((xx - yy) / 2.0, xy)
    return mean + root, mean - root


def _log_choose(n: int, k: int) -> float:
    return math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1)
