"""Bundle adjustment over few keyframes: poses and points that agree best with all pixels.

Levenberg-Marquardt with Huber weights; the points are eliminated by the Schur complement, so that the linear
system has six rows for each free camera.  Deterministic.  It does not decide what is adjusted.
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

# Huber's threshold in standard deviations: 95 % of the residuals of a 2-D Gaussian are below.
_HUBER = 2.45
_MIN_DEPTH = 1e-3
_FIRST_DAMPING = 1e-4  # Levenberg-Marquardt's share of the diagonal: nearly Gauss-Newton at first
_MAX_DAMPING = 1e6  # with more, a step is shorter than the rounding of a pose
_CONVERGED = 1e-4
"""The adjustment ends when a step lowers the cost by less than this share."""
_LITTLE_INFORMATION = 1e-9  # far below that of any pixel: a point behind all cameras has an inverse


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Bundle:
    """Cameras, points, and which camera sees which point where.

    Attributes:
        T_camera_world: ``(c, 4, 4)``.
        is_fixed: ``(c,)``, cameras that keep their poses; two or more of them fix position and scale.
        points_world: ``(p, 3)``.
        cameras: ``(n,)``, row of the camera of each observation.
        points: ``(n,)``, row of the point of each observation; a camera sees a point at most once.
        pixels: ``(n, 2)``, undistorted.
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
    """What adjusts a bundle as `adjust` does."""

    def __call__(self, bundle: Bundle, camera: Camera, *, iterations: int = 8) -> tuple[Array, Array]:
        """Return adjusted poses and points."""


def adjust(bundle: Bundle, camera: Camera, *, iterations: int = 8) -> tuple[Array, Array]:
    """Return adjusted poses ``(c, 4, 4)`` and points ``(p, 3)`` of *bundle*; its cost never grows.

    Source:
        Triggs et al., "Bundle Adjustment - A Modern Synthesis", 2000, Sect. 6.1 (Schur complement).
    """
    order = np.argsort(bundle.points, kind="stable")
    system = _System(bundle, order, camera)
    poses, points = bundle.T_camera_world.copy(), bundle.points_world.copy()
    cost, damping = system.cost(poses, points), _FIRST_DAMPING
    for _ in range(iterations):
        system.linearise(poses, points)
        while True:
            try:
                moved_poses, moved_points = system.step(poses, points, damping)
                moved_cost = system.cost(moved_poses, moved_points)
            except np.linalg.LinAlgError:
                moved_cost = np.inf
            if moved_cost < cost or damping > _MAX_DAMPING:
                break
            damping *= 10.0
        if not moved_cost < cost:
            break
        is_done = cost - moved_cost < _CONVERGED * cost
        poses, points, cost = moved_poses, moved_points, moved_cost
        damping = max(damping * 0.1, 1e-9)
        if is_done:
            break
    return poses, points


class _System:
    """The normal equations of a bundle, with observations in the order of their points."""

    def __init__(self, bundle: Bundle, order: Rows, camera: Camera) -> None:
        self._camera = camera
        self._cameras, self._points = bundle.cameras[order], bundle.points[order]
        self._pixels, self._sigma_px = bundle.pixels[order], bundle.sigma_px[order]
        self._seen, self._starts = np.unique(self._points, return_index=True)
        self._slot = np.searchsorted(self._seen, self._points)
        self._free = np.flatnonzero(~bundle.is_fixed)
        self._of_camera = [np.flatnonzero(self._cameras == row) for row in self._free]
        size = 6 * len(self._free)
        # What no camera sees of a point stays 0 in E from one step to the next.
        self._equations = NormalEquations(
            np.zeros((size, size)), np.zeros(size), np.zeros((len(self._seen), 3, size)),
            np.zeros((len(self._seen), 3, 3)), np.zeros((len(self._seen), 3)),
        )  # fmt: skip

    def cost(self, poses: Array, points: Array) -> float:
        """Return the sum of Huber's function over the observations."""
        camera_points = _moved(poses[self._cameras], points[self._points])
        squared = np.square(_residuals(camera_points, self._pixels, self._camera)).sum(axis=1)
        squared /= np.square(self._sigma_px)
        norm = np.sqrt(squared)
        each = np.where(norm <= _HUBER, squared, 2 * _HUBER * norm - _HUBER**2)
        each = np.where(camera_points[:, 2] > _MIN_DEPTH, each, 1e4)
        return float(each.sum())

    def linearise(self, poses: Array, points: Array) -> None:
        """Take the Jacobians at these poses and points."""
        camera_points = _moved(poses[self._cameras], points[self._points])
        Jc, Jp = _jacobians(camera_points, poses[self._cameras, :3, :3], self._camera)
        residuals = _residuals(camera_points, self._pixels, self._camera) / self._sigma_px[:, None]
        weights = np.sqrt(_huber_weights(residuals) * (camera_points[:, 2] > _MIN_DEPTH))
        scale = (weights / self._sigma_px)[:, None, None]
        Jc, Jp, residuals = Jc * scale, Jp * scale, residuals * weights[:, None]
        equations, J_pt = self._equations, Jp.transpose(0, 2, 1)
        equations.H_landmarks = np.add.reduceat(J_pt @ Jp, self._starts, axis=0)
        equations.g_landmarks = np.add.reduceat(np.einsum("nij,ni->nj", Jp, residuals), self._starts, axis=0)
        for row, own in enumerate(self._of_camera):
            at = slice(6 * row, 6 * row + 6)
            J = Jc[own].reshape(-1, 6)
            equations.H[at, at] = J.T @ J
            equations.g[at] = J.T @ residuals[own].ravel()
            equations.E[self._slot[own], :, at] = J_pt[own] @ Jc[own]

    def step(self, poses: Array, points: Array, damping: float) -> tuple[Array, Array]:
        """Return the poses and points after one damped step."""
        reduced = self._equations.reduce(damping, _LITTLE_INFORMATION, _LITTLE_INFORMATION)
        dc: Array = np.linalg.solve(reduced.S, reduced.right).astype(np.float64, copy=False)
        moved_poses, moved_points = poses.copy(), points.copy()
        for column, row in enumerate(self._free):
            moved_poses[row] = exp_se3(dc[6 * column : 6 * column + 6]) @ poses[row]
        moved_points[self._seen] += self._equations.landmark_steps(reduced, dc)
        return moved_poses, moved_points


def _moved(T_camera_world: Array, points_world: Array) -> Array:
    rotation, translation = T_camera_world[..., :3, :3], T_camera_world[..., :3, 3]
    moved: Array = np.einsum("...ij,...j->...i", rotation, points_world) + translation
    return moved


def _residuals(points_camera: Array, pixels: Array, camera: Camera) -> Array:
    z = np.maximum(points_camera[:, 2], _MIN_DEPTH)
    residuals = np.empty((len(pixels), 2))
    residuals[:, 0] = camera.fx * points_camera[:, 0] / z + camera.cx - pixels[:, 0]
    residuals[:, 1] = camera.fy * points_camera[:, 1] / z + camera.cy - pixels[:, 1]
    return residuals


def _jacobians(points_camera: Array, rotation: Array, camera: Camera) -> tuple[Array, Array]:
    """Return the derivatives of the pixels by the twist ``(n, 2, 6)`` and by the point ``(n, 2, 3)``."""
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
    norm = np.hypot(residuals[:, 0], residuals[:, 1])
    weights: Array = np.minimum(1.0, _HUBER / np.maximum(norm, 1e-12))
    return weights
