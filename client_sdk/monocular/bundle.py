"""Bundle adjustment: the camera poses and points that agree best with all pixels; deterministic.

Levenberg-Marquardt with Huber weights.  The points are eliminated by the Schur complement, so that the linear
system has six rows for each free camera.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array, Camera, exp_se3
from rse_pf.slam.schur import NormalEquations

__all__ = ["Adjuster", "Bundle", "adjust"]

Rows = npt.NDArray[np.int64]

_HUBER_SIGMAS = 2.45
"""Threshold of the Huber loss, in standard deviations: 95 % of the residuals of a 2-D Gaussian are below
it."""
_MIN_DEPTH = 1e-3
"""Smallest depth of a point before its camera, in the unit of the map: an observation of a nearer point, or
of one behind the camera, has no weight in the normal equations, and costs `_BEHIND_COST`."""
_BEHIND_COST = 1e4
"""Cost of an observation whose point is not `_MIN_DEPTH` before its camera, in squared standard deviations:
above that of usual outliers, so that a step that moves points behind cameras raises the cost, and is
refused."""
_INITIAL_DAMPING = 1e-4
"""Initial damping of Levenberg-Marquardt as a share of the diagonal: nearly Gauss-Newton."""
_MIN_DAMPING = 1e-9
"""Smallest damping of Levenberg-Marquardt as a share of the diagonal, however many steps succeed."""
_MAX_DAMPING = 1e6
"""Largest damping of Levenberg-Marquardt as a share of the diagonal: with more, a step is shorter than the
rounding of a pose."""
_DAMPING_FACTOR = 10.0
"""The damping of Levenberg-Marquardt is multiplied by this factor after a step that does not lower the cost,
and divided by it after one that does."""
_CONVERGED_SHARE = 1e-4
"""The adjustment ends when a step lowers the cost by less than this share."""
_ADDED_INFORMATION = 1e-9
"""Information added to the diagonal blocks of cameras and points, far below that of any pixel: without it,
the block of a point behind all of its cameras, where all weights are 0, has no inverse."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Bundle:
    """Cameras, points, and the pixels at which cameras see points.

    Attributes:
        T_camera_world: ``(c, 4, 4)``, poses of the cameras.
        is_fixed: ``(c,)``, whether each camera keeps its pose; two or more fixed cameras fix frame and scale.
        points_world: ``(p, 3)``.
        cameras: ``(n,)``, camera of each observation.
        points: ``(n,)``, point of each observation; a camera sees a point at most once.
        pixels: ``(n, 2)``, undistorted, of each observation.
        sigma_px: ``(n,)``, standard deviation of each pixel.
    """

    T_camera_world: Array
    is_fixed: npt.NDArray[np.bool_]
    points_world: Array
    cameras: Rows
    points: Rows
    pixels: Array
    sigma_px: Array


class Adjuster(Protocol):
    """A function that adjusts a bundle, such as `adjust` or a user's optimiser."""

    def __call__(self, bundle: Bundle, camera: Camera, *, iterations: int = 8) -> tuple[Array, Array]:
        """Return adjusted poses ``T_camera_world`` ``(c, 4, 4)`` and points ``(p, 3)``.

        Fixed cameras keep their poses, and *iterations* is the largest number of steps, as in `adjust`.
        """


def adjust(bundle: Bundle, camera: Camera, *, iterations: int = 8) -> tuple[Array, Array]:
    """Return the adjusted free cameras and points of a bundle, which stays as it is; the cost never grows.

    Args:
        bundle: Cameras, points and observations.
        camera: Intrinsics of all cameras.
        iterations: Largest number of steps that lower the cost.

    Returns:
        Poses ``T_camera_world`` ``(c, 4, 4)``, those of fixed cameras unchanged, and points ``(p, 3)``, those
        without an observation unchanged.

    Source:
        Triggs et al., "Bundle Adjustment - A Modern Synthesis", 2000, Sect. 6.1 (Schur complement).
    """
    system = _System(bundle, camera)
    poses, points = bundle.T_camera_world.copy(), bundle.points_world.copy()
    cost, damping = system.cost(poses, points), _INITIAL_DAMPING
    for _ in range(iterations):
        # 1. Linearise, and raise the damping until a step lowers the cost.
        system.linearise(poses, points)
        while True:
            try:
                new_poses, new_points = system.step(poses, points, damping)
                new_cost = system.cost(new_poses, new_points)
            except np.linalg.LinAlgError:
                new_cost = np.inf
            if new_cost < cost or damping > _MAX_DAMPING:
                break
            damping *= _DAMPING_FACTOR
        if not new_cost < cost:
            break
        # 2. Take the step; end when it lowered the cost by little.
        has_converged = cost - new_cost < _CONVERGED_SHARE * cost
        poses, points, cost = new_poses, new_points, new_cost
        damping = max(damping * 0.1, _MIN_DAMPING)
        if has_converged:
            break
    return poses, points


class _System:
    """The normal equations of a bundle.

    Observations are sorted by their points, so that the blocks of a point are sums over neighbouring rows.
    """

    def __init__(self, bundle: Bundle, camera: Camera) -> None:
        order = np.argsort(bundle.points, kind="stable")
        self._camera = camera
        self._cameras, self._points = bundle.cameras[order], bundle.points[order]
        self._pixels, self._sigma_px = bundle.pixels[order], bundle.sigma_px[order]
        self._seen_points, self._starts = np.unique(self._points, return_index=True)
        self._rows_of_points = np.searchsorted(self._seen_points, self._points)
        self._free_cameras = np.flatnonzero(~bundle.is_fixed)
        self._observations_of = [np.flatnonzero(self._cameras == c) for c in self._free_cameras]
        size, count = 6 * len(self._free_cameras), len(self._seen_points)
        # The blocks between points and cameras (E) are 0 where a camera does not see a point.  These zeros
        # are written once here; `linearise` writes all other blocks.
        self._equations = NormalEquations(
            np.zeros((size, size)),
            np.zeros(size),
            np.zeros((count, 3, size)),
            np.zeros((count, 3, 3)),
            np.zeros((count, 3)),
        )

    def cost(self, poses: Array, points: Array) -> float:
        """Return the sum of the Huber loss over all observations, in squared standard deviations.

        An observation whose point is not before its camera costs `_BEHIND_COST`.
        """
        camera_points = _transform_each(poses[self._cameras], points[self._points])
        squared = np.square(_residuals(camera_points, self._pixels, self._camera)).sum(axis=1)
        squared /= np.square(self._sigma_px)
        norm = np.sqrt(squared)
        losses = np.where(norm <= _HUBER_SIGMAS, squared, 2 * _HUBER_SIGMAS * norm - _HUBER_SIGMAS**2)
        losses = np.where(camera_points[:, 2] > _MIN_DEPTH, losses, _BEHIND_COST)
        return float(losses.sum())

    def linearise(self, poses: Array, points: Array) -> None:
        """Set the normal equations at these poses and points."""
        # 1. Compute residuals and Jacobians, divided by the noise and weighted.
        camera_points = _transform_each(poses[self._cameras], points[self._points])
        Jc, Jp = _jacobians(camera_points, poses[self._cameras, :3, :3], self._camera)
        residuals = _residuals(camera_points, self._pixels, self._camera) / self._sigma_px[:, None]
        weights = np.sqrt(_huber_weights(residuals) * (camera_points[:, 2] > _MIN_DEPTH))
        scale = (weights / self._sigma_px)[:, None, None]
        Jc, Jp, residuals = Jc * scale, Jp * scale, residuals * weights[:, None]
        # 2. Sum them to the blocks of the points, of the free cameras, and between both.
        equations, Jp_transposed = self._equations, Jp.transpose(0, 2, 1)
        equations.H_landmarks = np.add.reduceat(Jp_transposed @ Jp, self._starts, axis=0)
        equations.g_landmarks = np.add.reduceat(np.einsum("nij,ni->nj", Jp, residuals), self._starts, axis=0)
        for camera, own in enumerate(self._observations_of):
            block = slice(6 * camera, 6 * camera + 6)
            J = Jc[own].reshape(-1, 6)
            equations.H[block, block] = J.T @ J
            equations.g[block] = J.T @ residuals[own].ravel()
            equations.E[self._rows_of_points[own], :, block] = Jp_transposed[own] @ Jc[own]

    def step(self, poses: Array, points: Array, damping: float) -> tuple[Array, Array]:
        """Return new poses and points after one damped step from those at which `linearise` was called.

        Twists are applied on the left of ``T_camera_world``.
        """
        reduced = self._equations.reduce(damping, _ADDED_INFORMATION, _ADDED_INFORMATION)
        twists: Array = np.linalg.solve(reduced.S, reduced.right).astype(np.float64, copy=False)
        new_poses, new_points = poses.copy(), points.copy()
        for row, camera in enumerate(self._free_cameras):
            new_poses[camera] = exp_se3(twists[6 * row : 6 * row + 6]) @ poses[camera]
        new_points[self._seen_points] += self._equations.landmark_steps(reduced, twists)
        return new_poses, new_points


def _transform_each(T_camera_world: Array, points_world: Array) -> Array:
    """Return ``(n, 3)`` points, each transformed by its own pose of ``(n, 4, 4)``."""
    rotation, translation = T_camera_world[..., :3, :3], T_camera_world[..., :3, 3]
    moved: Array = np.einsum("...ij,...j->...i", rotation, points_world) + translation
    return moved


def _residuals(points_camera: Array, pixels: Array, camera: Camera) -> Array:
    """Return the ``(n, 2)`` projections minus the pixels; points nearer than `_MIN_DEPTH` get that depth."""
    z = np.maximum(points_camera[:, 2], _MIN_DEPTH)
    residuals = np.empty((len(pixels), 2))
    residuals[:, 0] = camera.fx * points_camera[:, 0] / z + camera.cx - pixels[:, 0]
    residuals[:, 1] = camera.fy * points_camera[:, 1] / z + camera.cy - pixels[:, 1]
    return residuals


def _jacobians(points_camera: Array, rotation: Array, camera: Camera) -> tuple[Array, Array]:
    """Return the derivatives of the projections by the twists and by the points.

    The twist (translation, rotation) of a camera is applied on the left of ``T_camera_world``, whose
    rotations are *rotation* ``(n, 3, 3)``.  The shapes are ``(n, 2, 6)`` and ``(n, 2, 3)``.
    """
    x, y = points_camera[:, 0], points_camera[:, 1]
    z = np.maximum(points_camera[:, 2], _MIN_DEPTH)
    Jc = np.zeros((len(points_camera), 2, 6))
    Jc[:, 0, 0] = camera.fx / z
    Jc[:, 0, 2] = -camera.fx * x / z**2
    Jc[:, 1, 1] = camera.fy / z
    Jc[:, 1, 2] = -camera.fy * y / z**2
    Jc[:, :, 3] = Jc[:, :, 2] * y[:, None] - Jc[:, :, 1] * z[:, None]
    Jc[:, :, 4] = Jc[:, :, 0] * z[:, None] - Jc[:, :, 2] * x[:, None]
    Jc[:, :, 5] = Jc[:, :, 1] * x[:, None] - Jc[:, :, 0] * y[:, None]
    return Jc, Jc[:, :, :3] @ rotation


def _huber_weights(residuals: Array) -> Array:
    """Return the ``(n,)`` Huber weights of ``(n, 2)`` residuals in standard deviations."""
    norm = np.hypot(residuals[:, 0], residuals[:, 1])
    weights: Array = np.minimum(1.0, _HUBER_SIGMAS / np.maximum(norm, 1e-12))
    return weights
