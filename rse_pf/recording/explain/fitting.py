"""Poses under a hypothesis: what fits, how closely, and with how many of the matches.

All engines are deterministic.  What a fit means is decided elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rse_pf.errors import ConfigurationError, PnpError, RsePfError
from rse_pf.geometry import Array, Camera, exp_se3, transform
from rse_pf.pnp import PnpOptions, PnpSolution, solve_pnp, usable_engine
from rse_pf.pnp.engines import engine_for
from rse_pf.pnp.evidence import log10_false_alarms
from rse_pf.pnp.rules import MAX_LOG10_FALSE_ALARMS

__all__ = [
    "Fit",
    "Mask",
    "Matches",
    "errors_px",
    "fit_of",
    "fit_pose",
    "is_chance",
    "refine_pose",
    "robust_cost",
    "solve_or_refuse",
]

_LAST_ROW = np.array([[0.0, 0.0, 0.0, 1.0]])
_NEAR_M = 1e-6
_ITERATIONS = 300
_REFINEMENTS = 8
_LEAST_ROWS = 6

Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Matches:
    """The matches of one command, checked: finite rows only.

    Attributes:
        points: ``(n, 3)``, metres, world frame.
        pixels: ``(n, 2)``.
        camera: As the command named it.
        inlier_px: As the command asked for.
        tight_px: What a right match may be off.
        depths_m: ``(n,)`` at the pixels, 0 where there is none; None if the command has none.
        left_out: How many rows were not finite.
    """

    points: Array
    pixels: Array
    camera: Camera
    inlier_px: float
    tight_px: float
    depths_m: Array | None
    left_out: int

    def __len__(self) -> int:
        return len(self.pixels)

    def of(self, rows: npt.NDArray[np.intp] | Mask) -> Matches:
        """Return these rows only."""
        return replace(
            self, points=self.points[rows], pixels=self.pixels[rows],
            depths_m=None if self.depths_m is None else self.depths_m[rows],
        )  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fit:
    """A pose, the error of each match, and which matches are closer than ``tight_px``."""

    T_camera_world: Array
    errors_px: Array
    agrees: Mask

    @property
    def count(self) -> int:
        """How many matches agree."""
        return int(np.count_nonzero(self.agrees))


def errors_px(T_camera_world: Array, points: Array, pixels: Array, camera: Camera) -> Array:
    """Return the ``(n,)`` reprojection errors, infinite behind the camera."""
    seen = transform(T_camera_world, points)
    behind = seen[:, 2] <= _NEAR_M
    seen[behind, 2] = 1.0
    errors: Array = np.linalg.norm(camera.project(seen) - pixels, axis=1)
    errors[behind] = np.inf
    return errors


def fit_of(T_camera_world: Array, matches: Matches) -> Fit:
    """Return *T_camera_world* with its errors."""
    errors = errors_px(T_camera_world, matches.points, matches.pixels, matches.camera)
    return Fit(T_camera_world=T_camera_world, errors_px=errors, agrees=errors <= matches.tight_px)


def fit_pose(
    matches: Matches, *, iterations: int = _ITERATIONS, start: Array | None = None, polish: bool = False
) -> Fit | None:
    """Return the pose that most matches agree with, None if there is none.

    Args:
        matches: Rows of any quality.
        iterations: The most that RANSAC takes.
        start: A pose that is a candidate, too.
        polish: Whether each pose is refined by all matches, which takes 1 ms.
    """
    poses = [] if start is None else [start]
    if len(matches) >= 4:
        options = PnpOptions(inlier_px=matches.tight_px, max_iterations=iterations)
        try:
            engine = engine_for(usable_engine("native"))
            solution = engine(matches.points, matches.pixels, matches.camera, options)
        except (ConfigurationError, PnpError):
            solution = None
        if solution is not None and np.isfinite(solution).all():
            poses.append(np.vstack([solution, _LAST_ROW]))
    best: Fit | None = None
    for pose in poses:
        tried = [fit_of(pose, matches)]
        if polish:
            tried.append(fit_of(refine_pose(pose, matches), matches))
        for trial in tried:
            if best is None or trial.count > best.count:
                best = trial
    return best


def refine_pose(T_camera_world: Array, matches: Matches) -> Array:
    """Return the pose after iterated least squares with a Cauchy weight of ``tight_px``."""
    pose, camera = T_camera_world, matches.camera
    for _ in range(_REFINEMENTS):
        seen = transform(pose, matches.points)
        x, y, z = seen.T
        near = z > 0.05
        if np.count_nonzero(near) < _LEAST_ROWS:
            return T_camera_world
        w = np.where(near, 1.0 / np.where(near, z, 1.0), 0.0)
        a, b = x * w, y * w
        zero = np.zeros_like(w)
        by_u = camera.fx * np.array([w, zero, -a * w, -a * b, 1 + a * a, -b])
        by_v = camera.fy * np.array([zero, w, -b * w, -1 - b * b, a * b, a])
        residual_u = matches.pixels[:, 0] - (camera.fx * a + camera.cx)
        residual_v = matches.pixels[:, 1] - (camera.fy * b + camera.cy)
        weight = near / (1.0 + (residual_u**2 + residual_v**2) / matches.tight_px**2)
        normal = (by_u * weight) @ by_u.T + (by_v * weight) @ by_v.T
        gradient = by_u @ (weight * residual_u) + by_v @ (weight * residual_v)
        try:
            step = np.linalg.solve(normal + 1e-9 * np.trace(normal) * np.eye(6), gradient)
        except np.linalg.LinAlgError:
            return T_camera_world
        if not float(np.abs(step).max()) < 1.0:
            return T_camera_world
        pose = exp_se3(step) @ pose
        if float(np.abs(step).max()) < 1e-6:
            break
    return pose


def robust_cost(matches: Matches, fit: Fit) -> float:
    """Return the sum of Cauchy losses of all errors, px^2; beyond 50 px all errors are alike."""
    limit2 = matches.tight_px**2
    errors = np.minimum(fit.errors_px, 50.0)
    return float(limit2 * np.log1p(errors * errors / limit2).sum())


def is_chance(n: int, count: int, tight_px: float, camera: Camera) -> bool:
    """Return whether *count* of *n* matches agree with some pose by chance."""
    return count <= 3 or log10_false_alarms(n, count, tight_px**2, camera) > MAX_LOG10_FALSE_ALARMS


def solve_or_refuse(matches: Matches, options: PnpOptions) -> PnpSolution | RsePfError:
    """Return what the service answers to these matches, or its refusal."""
    try:
        return solve_pnp(matches.points, matches.pixels, matches.camera, options)
    except RsePfError as error:
        return error
