"""Rotations and rigid transforms: exponential maps, quaternions, and the rule for what is a rotation.

A pose ``T_a_b`` is a ``(4, 4)`` matrix that maps points of frame *b* into frame *a*, in metres.  A twist
``(rho, phi)`` is a translation in metres and a rotation vector in radians, in this order.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = [
    "Array",
    "adjoint",
    "body_poses",
    "exp_se3",
    "exp_so3",
    "from_quaternion",
    "inverse",
    "left_jacobian_so3",
    "log_se3",
    "log_so3",
    "median_pose",
    "orthonormalise",
    "planar_pose",
    "pose_difference",
    "right_jacobian_so3",
    "rigid",
    "rigid_many",
    "rotation_angle_deg",
    "scaled",
    "skew",
    "to_quaternion",
    "transform",
]

Array = npt.NDArray[np.float64]
"""A numpy array of float64; the docstring of each function states its shape."""

ROTATION_TOLERANCE = 2e-3
"""Largest absolute element of R^T R - I for which a matrix R is accepted as a rotation: for a rotation whose
elements are rounded to three decimals, it is up to 1.8e-3."""
EXACT_TOLERANCE = 1e-9
"""Largest absolute element of R^T R - I for which a pose keeps its rotation R; `rigid` replaces a rotation
that deviates more by the nearest rotation.  Rotations that this platform writes deviate less, so that a pose
is read back with every bit unchanged."""
LAST_ROW_TOLERANCE = 1e-5  # largest deviation of a pose's last row from 0 0 0 1: float32 rounds by less
# Largest absolute coordinate of a pose's translation in metres: beyond any map, and far from the limits of
# float64.
MAX_TRANSLATION_M = 1e9
NEAR_HALF_TURN_COSINE = -0.999
"""Cosine of the rotation angle below which `log_se3` computes the rotation vector from the quaternion, which
is for angles above 177.4 degrees: the antisymmetric part of the matrix, which it uses for smaller angles,
vanishes at 180 degrees."""
SMALL_ANGLE_RAD = 1e-4  # below this angle, series replace quotients whose denominators vanish


def planar_pose(x_m: float, y_m: float, yaw_rad: float) -> Array:
    """Return the pose ``(4, 4)`` of a robot in the plane z = 0, turned by *yaw_rad* about z."""
    pose: Array = np.eye(4)
    cosine, sine = math.cos(yaw_rad), math.sin(yaw_rad)
    pose[:2, :2] = [[cosine, -sine], [sine, cosine]]
    pose[:2, 3] = x_m, y_m
    return pose


def transform(T_a_b: Array, points_b: Array) -> Array:
    """Return ``(n, 3)`` points of frame *b*, expressed in frame *a* by the ``(4, 4)`` pose *T_a_b*."""
    points_a: Array = points_b @ T_a_b[:3, :3].T + T_a_b[:3, 3]
    return points_a


def inverse(T_a_b: Array) -> Array:
    """Return the inverses ``T_b_a`` of rigid poses ``(..., 4, 4)``."""
    T_b_a = np.zeros(T_a_b.shape)
    rotation = np.swapaxes(T_a_b[..., :3, :3], -1, -2)
    T_b_a[..., :3, :3] = rotation
    T_b_a[..., :3, 3:] = -(rotation @ T_a_b[..., :3, 3:])
    T_b_a[..., 3, 3] = 1.0
    return T_b_a


def body_poses(T_world_camera: Array, T_body_camera: Array) -> Array:
    """Return the poses ``(..., 4, 4)`` of the body from the poses *T_world_camera* of its camera.

    *T_body_camera* ``(4, 4)`` is the pose of the camera in the frame of the body.
    """
    return T_world_camera @ inverse(T_body_camera)


def scaled(T: Array, scale: float | Array) -> Array:
    """Return new poses ``(..., 4, 4)`` with translations multiplied by *scale*, a number or ``(...)``."""
    scaled_poses: Array = T.copy()
    scaled_poses[..., :3, 3] *= np.asarray(scale)[..., None]
    return scaled_poses


def rigid(T: Array, max_m: float = MAX_TRANSLATION_M) -> Array | None:
    """Return a ``(4, 4)`` matrix as a rigid motion, or None if the matrix is no rigid motion.

    This is the one rule of the platform for poses, applied where a pose arrives.  A matrix with the upper
    left 3x3 block R is a rigid motion if ``det R > 0``, no element of ``R^T R - I`` is beyond
    `ROTATION_TOLERANCE`, no element of the last row differs from 0 0 0 1 by more than `LAST_ROW_TOLERANCE`,
    and no coordinate of the translation is beyond *max_m*.

    If the last row is exactly 0 0 0 1 and no element of ``R^T R - I`` is beyond `EXACT_TOLERANCE`, *T* itself
    is returned.  Otherwise a new matrix is returned, with the last row 0 0 0 1 and the rotation nearest to R
    (by singular value decomposition).  Without this correction, a product of several accepted poses could
    deviate more than the rule accepts.

    Args:
        T: Any ``(4, 4)`` numbers, NaN and infinity included.
        max_m: Largest absolute value of a coordinate of the translation, metres.
    """
    if T.shape != (4, 4):
        return None
    # Return a pose that needs no correction at once: plain floats check it twenty times faster than numpy
    # does.  `rigid_many` applies the same rule to all other matrices.
    (a, b, c, x), (d, e, f, y), (g, h, i, z), (s, t, u, v) = T.tolist()
    deviation = max(
        abs(a * a + d * d + g * g - 1.0),
        abs(b * b + e * e + h * h - 1.0),
        abs(c * c + f * f + i * i - 1.0),
        abs(a * b + d * e + g * h),
        abs(a * c + d * f + g * i),
        abs(b * c + e * f + h * i),
    )
    is_exact = deviation <= EXACT_TOLERANCE and s == t == u == 0.0 and v == 1.0
    if is_exact and abs(x) <= max_m and abs(y) <= max_m and abs(z) <= max_m:
        determinant = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
        if determinant > 0.0:
            return T
    poses = rigid_many(T[None], max_m)
    return None if poses is None else poses[0]


def orthonormalise(T: Array) -> Array:
    """Return a copy of a ``(4, 4)`` pose whose upper left block is replaced by the nearest rotation.

    A pose that is the product of many poses needs this, because rounding errors add up in its rotation.
    """
    U, _, Vt = np.linalg.svd(T[:3, :3])
    orthonormal: Array = T.copy()
    orthonormal[:3, :3] = U @ Vt
    return orthonormal


def rigid_many(T: Array, max_m: float = MAX_TRANSLATION_M) -> Array | None:
    """Return ``(n, 4, 4)`` matrices as rigid motions by the rule of `rigid`; None if one matrix is none.

    If `rigid` would return each matrix itself, *T* itself is returned.  Otherwise a copy of *T* is returned,
    in which the matrices that `rigid` would replace are replaced.
    """
    # 1. Check that all matrices are rigid motions; a NaN makes each comparison false.
    rotations = T[:, :3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        gram = np.swapaxes(rotations, 1, 2) @ rotations
        deviation = np.abs(gram - np.eye(3)).max(axis=(1, 2))
        last_row_deviation = np.abs(T[:, 3] - (0.0, 0.0, 0.0, 1.0)).max(axis=1)
    is_rotation = (deviation <= ROTATION_TOLERANCE) & (last_row_deviation <= LAST_ROW_TOLERANCE)
    is_within = (np.abs(T[:, :3, 3]) <= max_m).all(axis=1)
    if not (is_rotation & is_within).all() or (np.linalg.det(rotations) <= 0.0).any():
        return None
    # 2. In a copy, replace the rotations of the poses that are not exact by the nearest rotations (orthogonal
    #    Procrustes), and their last rows by 0 0 0 1.
    inexact = np.flatnonzero((deviation > EXACT_TOLERANCE) | (last_row_deviation > 0.0))
    if not len(inexact):
        return T
    poses = T.astype(np.float64)
    U, _, Vt = np.linalg.svd(rotations[inexact])
    poses[inexact, :3, :3] = U @ Vt
    poses[inexact, 3] = (0.0, 0.0, 0.0, 1.0)
    return poses


def skew(v: npt.ArrayLike) -> Array:
    """Return the skew-symmetric matrices ``(..., 3, 3)`` whose product with w is the cross product v x w."""
    vectors = np.asarray(v, dtype=np.float64)
    K = np.zeros((*vectors.shape, 3))
    K[..., 0, 1], K[..., 0, 2], K[..., 1, 2] = -vectors[..., 2], vectors[..., 1], -vectors[..., 0]
    K[..., 1, 0], K[..., 2, 0], K[..., 2, 1] = vectors[..., 2], -vectors[..., 1], vectors[..., 0]
    return K


def exp_se3(xi: npt.ArrayLike) -> Array:
    """Return the poses ``(..., 4, 4)`` of twists *xi* ``(..., 6)``: the exponential map of SE(3).

    A twist is ``(rho, phi)``: three metres, then a rotation vector in radians.

    Source:
        Barfoot, State Estimation for Robotics (2017), eqs. 7.16 and 7.34.
    """
    twists = np.asarray(xi, dtype=np.float64)
    rho, phi = twists[..., :3], twists[..., 3:]
    angle2 = (phi**2).sum(axis=-1)
    angle = np.sqrt(angle2)
    is_small = angle < 1e-6
    safe = np.where(is_small, 1.0, angle)
    a = np.where(is_small, 1.0 - angle2 / 6.0, np.sin(safe) / safe)
    # (1 - cos(angle)) / angle**2, in a form without cancellation near 0.
    b = np.where(is_small, 0.5 - angle2 / 24.0, 2.0 * (np.sin(0.5 * safe) / safe) ** 2)
    c = np.where(is_small, 1.0 / 6.0, (1.0 - a) / safe**2)
    a, b, c = a[..., None, None], b[..., None, None], c[..., None, None]
    K = skew(phi)
    KK = K @ K
    T = np.zeros((*twists.shape[:-1], 4, 4))
    T[..., :3, :3] = np.eye(3) + a * K + b * KK
    T[..., :3, 3] = ((np.eye(3) + b * K + c * KK) @ rho[..., None])[..., 0]
    T[..., 3, 3] = 1.0
    return T


def log_se3(T: Array) -> Array:
    """Return the twists ``(n, 6)`` of poses ``(n, 4, 4)``: the logarithm of SE(3), the inverse of `exp_se3`.

    A twist is ``(rho, phi)``: three metres, then a rotation vector in radians, at most half a turn.

    Source:
        Barfoot, State Estimation for Robotics (2017), eqs. 7.18 and 7.36.
    """
    R = T[:, :3, :3]
    v = 0.5 * np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1)
    sine = np.sqrt((v * v).sum(axis=1))
    cosine = 0.5 * (R[:, 0, 0] + R[:, 1, 1] + R[:, 2, 2] - 1.0)
    angle = np.arctan2(sine, cosine)
    phi = v * np.where(sine < 1e-5, 1.0, angle / np.maximum(sine, 1e-12))[:, None]
    # Near half a turn, where the antisymmetric part of R vanishes, compute the angle and the rotation vector
    # from the quaternion instead.
    for row in np.flatnonzero(cosine < NEAR_HALF_TURN_COSINE).tolist():
        q = to_quaternion(R[row])
        half_sine = float(np.linalg.norm(q[:3]))
        angle[row] = 2.0 * math.atan2(half_sine, q[3])
        phi[row] = q[:3] * (angle[row] / half_sine)
    half = np.where(angle < SMALL_ANGLE_RAD, 1.0, 0.5 * angle)
    c = np.where(angle < SMALL_ANGLE_RAD, 1.0 / 12.0, (1.0 - half / np.tan(half)) / (4.0 * half**2))
    K = skew(phi)
    K_t = K @ T[:, :3, 3:]
    rho = T[:, :3, 3:] - 0.5 * K_t + c[:, None, None] * (K @ K_t)
    return np.concatenate([rho[:, :, 0], phi], axis=1)


def adjoint(T_a_b: Array) -> Array:
    """Return the adjoint matrices ``(..., 6, 6)`` that map a twist (rho, phi) of frame *b* into frame *a*."""
    rotation = T_a_b[..., :3, :3]
    matrices = np.zeros((*T_a_b.shape[:-2], 6, 6))
    matrices[..., :3, :3] = matrices[..., 3:, 3:] = rotation
    matrices[..., :3, 3:] = skew(T_a_b[..., :3, 3]) @ rotation
    return matrices


def median_pose(T_a_b: Array) -> Array:
    """Return the medoid of ``(n, 4, 4)`` poses, n >= 1: the one with the smallest summed differences to all.

    If several poses have the same sum, the first of them is returned.  The difference of two poses is the
    distance of their positions in metres plus the Frobenius norm of the difference of their rotation
    matrices: a distance of 1 m counts as much as a rotation by about 41 degrees.
    """
    distances_m = np.sqrt(((T_a_b[:, None, :3, 3] - T_a_b[None, :, :3, 3]) ** 2).sum(axis=2))
    rotation_distances = np.sqrt(((T_a_b[:, None, :3, :3] - T_a_b[None, :, :3, :3]) ** 2).sum(axis=(2, 3)))
    median: Array = T_a_b[int(np.argmin((distances_m + rotation_distances).sum(axis=1)))]
    return median


def rotation_angle_deg(rotation: Array) -> float:
    """Return the angle of a ``(3, 3)`` rotation, 0 to 180 degrees, without loss of precision near 0."""
    sine = 0.5 * math.sqrt(
        (rotation[2, 1] - rotation[1, 2]) ** 2
        + (rotation[0, 2] - rotation[2, 0]) ** 2
        + (rotation[1, 0] - rotation[0, 1]) ** 2
    )
    cosine = 0.5 * (float(np.trace(rotation)) - 1.0)
    return math.degrees(math.atan2(sine, cosine))


def pose_difference(T_a_b: Array, S_a_b: Array) -> tuple[float, float]:
    """Return distance (metres) and angle (degrees) between two ``(4, 4)`` poses of the same frames."""
    difference = inverse(S_a_b) @ T_a_b
    return float(np.linalg.norm(difference[:3, 3])), rotation_angle_deg(difference[:3, :3])


def to_quaternion(rotation: Array) -> Array:
    """Return the unit quaternion ``(qx, qy, qz, qw)`` with ``qw >= 0`` of a ``(3, 3)`` rotation.

    Source:
        Shepperd, Quaternion from Rotation Matrix, 1978: divide by the largest of the four components.
    """
    m: Any = rotation
    # Row i holds 4 q_i q, the quaternion q times four of its i-th component.
    multiples = np.array(
        [
            [
                1.0 + m[0, 0] - m[1, 1] - m[2, 2],
                m[0, 1] + m[1, 0],
                m[0, 2] + m[2, 0],
                m[2, 1] - m[1, 2],
            ],
            [
                m[0, 1] + m[1, 0],
                1.0 - m[0, 0] + m[1, 1] - m[2, 2],
                m[1, 2] + m[2, 1],
                m[0, 2] - m[2, 0],
            ],
            [
                m[0, 2] + m[2, 0],
                m[1, 2] + m[2, 1],
                1.0 - m[0, 0] - m[1, 1] + m[2, 2],
                m[1, 0] - m[0, 1],
            ],
            [
                m[2, 1] - m[1, 2],
                m[0, 2] - m[2, 0],
                m[1, 0] - m[0, 1],
                1.0 + m[0, 0] + m[1, 1] + m[2, 2],
            ],
        ]
    )
    q = multiples[int(np.argmax(multiples.diagonal()))]
    q /= np.linalg.norm(q)
    unit: Array = -q if q[3] < 0 else q
    return unit


def from_quaternion(q: npt.ArrayLike) -> Array:
    """Return the ``(3, 3)`` rotation of a quaternion ``(qx, qy, qz, qw)``, which is normalised first."""
    quaternion = np.asarray(q, dtype=np.float64)
    x, y, z, w = quaternion / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def exp_so3(phi: Array) -> Array:
    """Return the rotations ``(..., 3, 3)`` of rotation vectors *phi* ``(..., 3)``, radians."""
    return exp_se3(np.concatenate([np.zeros_like(phi), phi], axis=-1))[..., :3, :3]


def log_so3(R: Array) -> Array:
    """Return the rotation vectors ``(n, 3)``, radians, of rotations ``(n, 3, 3)``."""
    T = np.zeros((len(R), 4, 4))
    T[:, :3, :3], T[:, 3, 3] = R, 1.0
    return log_se3(T)[:, 3:]


def right_jacobian_so3(phi: Array) -> Array:
    """Return the right Jacobians ``(..., 3, 3)`` of SO(3) at rotation vectors *phi* ``(..., 3)``, radians.

    For small d, ``Exp(phi + d) = Exp(phi) Exp(J d)``.

    Source:
        Forster et al., On-Manifold Preintegration, IEEE TRO 2017, eq. 8.
    """
    return left_jacobian_so3(-phi)


def left_jacobian_so3(phi: Array) -> Array:
    """Return the left Jacobians ``(..., 3, 3)`` of SO(3) at rotation vectors *phi* ``(..., 3)``, radians.

    For small d, ``Exp(phi + d) = Exp(J d) Exp(phi)``.

    Source:
        Barfoot, State Estimation for Robotics (2017), Sect. 7.1.
    """
    squared = np.square(phi).sum(axis=-1)
    angle = np.sqrt(squared)
    is_small = angle < SMALL_ANGLE_RAD
    safe = np.where(is_small, 1.0, angle)
    a = np.where(is_small, 0.5 - squared / 24.0, 2.0 * np.square(np.sin(0.5 * safe) / safe))
    b = np.where(is_small, 1.0 / 6.0, (safe - np.sin(safe)) / safe**3)
    K = skew(phi)
    return np.eye(3) + a[..., None, None] * K + b[..., None, None] * (K @ K)
