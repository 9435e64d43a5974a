"""Cameras, rigid poses and projection: the one convention of the platform.

Frames: *camera* looks along +z, x to the right, y down (the field's pinhole convention).
A pose ``T_a_b`` is a ``(4, 4)`` float64 matrix that maps points of frame *b* into frame *a*.
Lengths are metres, image coordinates are pixels with the first pixel's centre at (0, 0).
"""

from __future__ import annotations

import math
from typing import Annotated, Any

import msgspec
import numpy as np
import numpy.typing as npt

from rse_pf.errors import InvalidCamera

__all__ = [
    "Array",
    "Camera",
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

_ROTATION_TOLERANCE = 2e-3
"""Of each number of R^T R - I: a rotation whose numbers have three decimals is off by up to 1.8e-3."""
_EXACT = 1e-9
"""A matrix that is off by less is left as it is, so that what was written is read to the byte."""
_LAST_ROW_TOLERANCE = 1e-5
_MAX_M = 1e9
_NEAR_HALF_A_TURN = -0.999
"""Cosine of 177.4 degrees."""
_SMALL_TURN = 1e-4

# No sensor of a robot is wider; a larger value is taken for a mistake in the unit.
_MAX_IMAGE_PX = 16384


class Camera(msgspec.Struct, frozen=True, kw_only=True):
    """Pinhole intrinsics of undistorted images, in pixels.

    Raises:
        InvalidCamera: A number is not finite, a focal length is not positive or is absurd
            for the image, or the principal point lies far outside the image.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: Annotated[int, msgspec.Meta(ge=1)]
    height: Annotated[int, msgspec.Meta(ge=1)]

    def __post_init__(self) -> None:
        numbers = (self.fx, self.fy, self.cx, self.cy)
        if not all(math.isfinite(value) for value in numbers):
            raise InvalidCamera("an intrinsic is not a finite number", hint="send fx fy cx cy in pixels")
        longest = max(self.width, self.height)
        if not (1 <= self.width <= _MAX_IMAGE_PX and 1 <= self.height <= _MAX_IMAGE_PX):
            raise InvalidCamera(
                f"image size {self.width}x{self.height} is not within 1..{_MAX_IMAGE_PX} px",
                hint="send the size of the image the pixels come from",
            )
        for name, focal in (("fx", self.fx), ("fy", self.fy)):
            if not 0.05 * longest <= focal <= 100.0 * longest:
                raise InvalidCamera(
                    f"{name} = {focal:g} px is absurd for an image of {self.width}x{self.height} px",
                    hint="send the focal length in pixels of this image size",
                )
        if abs(self.cx - self.width / 2) > self.width or abs(self.cy - self.height / 2) > self.height:
            raise InvalidCamera(
                f"the principal point ({self.cx:g}, {self.cy:g}) lies far outside "
                f"{self.width}x{self.height} px",
                hint="send cx cy in pixels of this image size",
            )

    @property
    def matrix(self) -> Array:
        """The ``(3, 3)`` matrix K."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def project(self, points_camera: Array) -> Array:
        """Return the ``(n, 2)`` pixels of ``(n, 3)`` points of the camera frame, z > 0."""
        z = points_camera[:, 2]
        pixels = np.empty((len(points_camera), 2))
        pixels[:, 0] = self.fx * points_camera[:, 0] / z + self.cx
        pixels[:, 1] = self.fy * points_camera[:, 1] / z + self.cy
        return pixels

    def back_project(self, pixels: Array, depth_m: Array) -> Array:
        """Return the ``(n, 3)`` camera-frame points at ``(n,)`` depths (metres along z)."""
        points = np.empty((len(pixels), 3))
        points[:, 0] = (pixels[:, 0] - self.cx) / self.fx * depth_m
        points[:, 1] = (pixels[:, 1] - self.cy) / self.fy * depth_m
        points[:, 2] = depth_m
        return points


def transform(T_a_b: Array, points_b: Array) -> Array:
    """Return ``(n, 3)`` points of frame *b* expressed in frame *a*."""
    moved: Array = points_b @ T_a_b[:3, :3].T + T_a_b[:3, 3]
    return moved


def inverse(T_a_b: Array) -> Array:
    """Return ``T_b_a`` of rigid poses ``(..., 4, 4)``."""
    T_b_a = np.zeros(T_a_b.shape)
    rotation = np.swapaxes(T_a_b[..., :3, :3], -1, -2)
    T_b_a[..., :3, :3] = rotation
    T_b_a[..., :3, 3:] = -(rotation @ T_a_b[..., :3, 3:])
    T_b_a[..., 3, 3] = 1.0
    return T_b_a


def body_poses(T_world_camera: Array, T_body_camera: Array) -> Array:
    """Return ``T_world_body`` ``(..., 4, 4)`` of the poses of a camera that is mounted at *T_body_camera*."""
    T_world_body: Array = T_world_camera @ inverse(T_body_camera)
    return T_world_body


def scaled(T: Array, scale: float | Array) -> Array:
    """Return poses ``(..., 4, 4)`` whose translations are multiplied by *scale*, one number or ``(...)``."""
    made: Array = T.copy()
    made[..., :3, 3] *= np.asarray(scale)[..., None]
    return made


def rigid(T: Array, max_m: float = _MAX_M) -> Array | None:
    """Return a ``(4, 4)`` matrix as a rigid motion, None if it is none.

    The one rule of the platform for a rotation, applied where a pose arrives: no number of ``R^T R - I`` is
    beyond 2e-3, and ``det R > 0``.  A matrix that is off by more than 1e-9 gets the nearest rotation, so that
    nothing that is computed from accepted poses is refused later.

    Args:
        T: Any ``(4, 4)`` numbers, NaN and infinity included.
        max_m: Largest number of the translation, metres.
    """
    if T.shape != (4, 4):
        return None
    # Twenty times faster than by arrays of this size; `rigid_many` decides the same.
    (a, b, c, x), (d, e, f, y), (g, h, i, z), (s, t, u, v) = T.tolist()
    off = max(
        abs(a * a + d * d + g * g - 1.0), abs(b * b + e * e + h * h - 1.0), abs(c * c + f * f + i * i - 1.0),
        abs(a * b + d * e + g * h), abs(a * c + d * f + g * i), abs(b * c + e * f + h * i),
    )  # fmt: skip
    if off <= _EXACT and s == t == u == 0.0 and v == 1.0 and abs(x) <= max_m and abs(y) <= max_m:
        determinant = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
        if abs(z) <= max_m and determinant > 0.0:
            return T
    found = rigid_many(T[None], max_m)
    return None if found is None else found[0]


def rigid_many(T: Array, max_m: float = _MAX_M) -> Array | None:
    """Return what `rigid` does of each of ``(n, 4, 4)`` matrices; None if one of them is no rigid motion."""
    rotations = T[:, :3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        gram = np.swapaxes(rotations, 1, 2) @ rotations
        off = np.abs(gram - np.eye(3)).max(axis=(1, 2))
        off_last = np.abs(T[:, 3] - (0.0, 0.0, 0.0, 1.0)).max(axis=1)
    # A NaN makes each comparison false.
    are_rigid = (
        (off <= _ROTATION_TOLERANCE) & (off_last <= _LAST_ROW_TOLERANCE)
        & (np.abs(T[:, :3, 3]) <= max_m).all(axis=1)
    )  # fmt: skip
    if not are_rigid.all() or (np.linalg.det(rotations) <= 0.0).any():
        return None
    rows = np.flatnonzero((off > _EXACT) | (off_last > 0.0))
    if not len(rows):
        return T
    made = T.astype(np.float64)
    U, _, Vt = np.linalg.svd(rotations[rows])
    made[rows, :3, :3] = U @ Vt
    made[rows, 3] = (0.0, 0.0, 0.0, 1.0)
    return made


def skew(v: npt.ArrayLike) -> Array:
    """Return the ``(..., 3, 3)`` matrices of the cross product with *v* ``(..., 3)``."""
    vectors = np.asarray(v, dtype=np.float64)
    K = np.zeros((*vectors.shape, 3))
    K[..., 0, 1], K[..., 0, 2], K[..., 1, 2] = -vectors[..., 2], vectors[..., 1], -vectors[..., 0]
    K[..., 1, 0], K[..., 2, 0], K[..., 2, 1] = vectors[..., 2], -vectors[..., 1], vectors[..., 0]
    return K


def exp_se3(xi: npt.ArrayLike) -> Array:
    """Return the ``(..., 4, 4)`` poses of twists ``xi = (rho, phi)`` ``(..., 6)``: metres, then radians.

    Source:
        Barfoot, State Estimation for Robotics (2017), eqs. 7.16 and 7.34.
    """
    twists = np.asarray(xi, dtype=np.float64)
    rho, phi = twists[..., :3], twists[..., 3:]
    angle2 = (phi**2).sum(axis=-1)
    angle = np.sqrt(angle2)
    small = angle < 1e-6
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 1.0 - angle2 / 6.0, np.sin(safe) / safe)
    # (1 - cos) / angle**2, without its cancellation.
    b = np.where(small, 0.5 - angle2 / 24.0, 2.0 * (np.sin(0.5 * safe) / safe) ** 2)
    c = np.where(small, 1.0 / 6.0, (1.0 - a) / safe**2)
    a, b, c = a[..., None, None], b[..., None, None], c[..., None, None]
    K = skew(phi)
    KK = K @ K
    T = np.zeros((*twists.shape[:-1], 4, 4))
    T[..., :3, :3] = np.eye(3) + a * K + b * KK
    T[..., :3, 3] = ((np.eye(3) + b * K + c * KK) @ rho[..., None])[..., 0]
    T[..., 3, 3] = 1.0
    return T


def log_se3(T: Array) -> Array:
    """Return the ``(n, 6)`` twists ``(rho, phi)`` of ``(n, 4, 4)`` poses; the inverse of `exp_se3`.

    Source:
        Barfoot, State Estimation for Robotics (2017), eqs. 7.18 and 7.36.
    """
    R = T[:, :3, :3]
    v = 0.5 * np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1)
    sine = np.sqrt((v * v).sum(axis=1))
    cosine = 0.5 * (R[:, 0, 0] + R[:, 1, 1] + R[:, 2, 2] - 1.0)
    angle = np.arctan2(sine, cosine)
    phi = v * np.where(sine < 1e-5, 1.0, angle / np.maximum(sine, 1e-12))[:, None]
    # The antisymmetric part vanishes at half a turn; the quaternion does not.
    for row in np.flatnonzero(cosine < _NEAR_HALF_A_TURN).tolist():
        q = to_quaternion(R[row])
        half_sine = float(np.linalg.norm(q[:3]))
        angle[row] = 2.0 * math.atan2(half_sine, q[3])
        phi[row] = q[:3] * (angle[row] / half_sine)
    half = np.where(angle < 1e-4, 1.0, 0.5 * angle)
    c = np.where(angle < 1e-4, 1.0 / 12.0, (1.0 - half / np.tan(half)) / (4.0 * half**2))
    K = skew(phi)
    across = K @ T[:, :3, 3:]
    rho = T[:, :3, 3:] - 0.5 * across + c[:, None, None] * (K @ across)
    return np.concatenate([rho[:, :, 0], phi], axis=1)


def adjoint(T_a_b: Array) -> Array:
    """Return the ``(..., 6, 6)`` matrices that take a twist (rho, phi) of frame *b* to frame *a*."""
    rotation = T_a_b[..., :3, :3]
    matrices = np.zeros((*T_a_b.shape[:-2], 6, 6))
    matrices[..., :3, :3] = matrices[..., 3:, 3:] = rotation
    matrices[..., :3, 3:] = skew(T_a_b[..., :3, 3]) @ rotation
    return matrices


def median_pose(T_a_b: Array) -> Array:
    """Return the one of ``(n, 4, 4)`` poses that differs least from the others, so that none is averaged."""
    apart_m = np.sqrt(((T_a_b[:, None, :3, 3] - T_a_b[None, :, :3, 3]) ** 2).sum(axis=2))
    turned = np.sqrt(((T_a_b[:, None, :3, :3] - T_a_b[None, :, :3, :3]) ** 2).sum(axis=(2, 3)))
    median: Array = T_a_b[int(np.argmin((apart_m + turned).sum(axis=1)))]
    return median


def rotation_angle_deg(rotation: Array) -> float:
    """Return the angle of a ``(3, 3)`` rotation, in degrees, accurate near zero."""
    sine = 0.5 * math.sqrt(
        (rotation[2, 1] - rotation[1, 2]) ** 2
        + (rotation[0, 2] - rotation[2, 0]) ** 2
        + (rotation[1, 0] - rotation[0, 1]) ** 2
    )
    cosine = 0.5 * (float(np.trace(rotation)) - 1.0)
    return math.degrees(math.atan2(sine, cosine))


def pose_difference(T_a_b: Array, S_a_b: Array) -> tuple[float, float]:
    """Return how far two poses of the same frames are apart: ``(metres, degrees)``."""
    difference = inverse(S_a_b) @ T_a_b
    return float(np.linalg.norm(difference[:3, 3])), rotation_angle_deg(difference[:3, :3])


def to_quaternion(rotation: Array) -> Array:
    """Return ``(qx, qy, qz, qw)``, unit length, ``qw >= 0``, of a ``(3, 3)`` rotation.

    Source:
        Shepperd 1978: divide by the largest of the four components.
    """
    m: Any = rotation
    four = np.array(
        [
            1.0 + m[0, 0] - m[1, 1] - m[2, 2],
            1.0 - m[0, 0] + m[1, 1] - m[2, 2],
            1.0 - m[0, 0] - m[1, 1] + m[2, 2],
            1.0 + m[0, 0] + m[1, 1] + m[2, 2],
        ]
    )
    largest = int(np.argmax(four))
    if largest == 3:
        q = np.array([m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], four[3]])
    elif largest == 0:
        q = np.array([four[0], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[2, 1] - m[1, 2]])
    elif largest == 1:
        q = np.array([m[0, 1] + m[1, 0], four[1], m[1, 2] + m[2, 1], m[0, 2] - m[2, 0]])
    else:
        q = np.array([m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], four[2], m[1, 0] - m[0, 1]])
    q /= np.linalg.norm(q)
    unit: Array = -q if q[3] < 0 else q
    return unit


def from_quaternion(q: npt.ArrayLike) -> Array:
    """Return the ``(3, 3)`` rotation of ``(qx, qy, qz, qw)``; it is normalised first."""
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
    """Return the rotations ``(..., 3, 3)`` of rotation vectors ``(..., 3)``."""
    rotations: Array = exp_se3(np.concatenate([np.zeros_like(phi), phi], axis=-1))[..., :3, :3]
    return rotations


def log_so3(R: Array) -> Array:
    """Return the rotation vectors ``(n, 3)`` of rotations ``(n, 3, 3)``."""
    T = np.zeros((len(R), 4, 4))
    T[:, :3, :3], T[:, 3, 3] = R, 1.0
    return log_se3(T)[:, 3:]


def right_jacobian_so3(phi: Array) -> Array:
    """Return ``(..., 3, 3)`` J with ``Exp(phi + d) = Exp(phi) Exp(J d)``, of ``(..., 3)``; Forster, eq. 8."""
    return left_jacobian_so3(-phi)


def left_jacobian_so3(phi: Array) -> Array:
    """Return ``(..., 3, 3)`` J with ``Exp(phi + d) = Exp(J d) Exp(phi)``, of ``(..., 3)``."""
    squared = np.square(phi).sum(axis=-1)
    angle = np.sqrt(squared)
    is_small = angle < _SMALL_TURN
    safe = np.where(is_small, 1.0, angle)
    a = np.where(is_small, 0.5 - squared / 24.0, 2.0 * np.square(np.sin(0.5 * safe) / safe))
    b = np.where(is_small, 1.0 / 6.0, (safe - np.sin(safe)) / safe**3)
    K = skew(phi)
    J: Array = np.eye(3) + a[..., None, None] * K + b[..., None, None] * (K @ K)
    return J
