"""Wrong intrinsics: another camera explains the same matches far better.

Two models are tried.  *Map*: the points are right, and only the pixels were read with the wrong camera.
*Pair*: the points were made from pixels of the same wrong camera, so that they are distorted with it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from rse_pf.errors import InvalidCamera
from rse_pf.geometry import Array, Camera, exp_se3, transform
from rse_pf.recording.explain.causes import Cause, PoseExplanation
from rse_pf.recording.explain.fitting import Fit, Mask, Matches, fit_pose

__all__ = ["intrinsics"]

_GRID = (0.5, 0.63, 0.8, 0.9, 1.12, 1.25, 1.6, 2.0)
_ITERATIONS = 12
_LEAST = 20
# Least change of the camera that counts: focal length, principal point (share of the focal length), bending.
_LEAST_FOCAL, _LEAST_CENTRE, _LEAST_BEND = 0.05, 0.05, 0.05
_CERTAIN = 6.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Freed:
    """A pose with a camera of its own: log of the focal factor, shift of the centre over f, and bending."""

    T_camera_world: Array
    change: Array
    deviation: Array
    errors_px: Array
    cost: float


def intrinsics(matches: Matches, base: Fit | None, *, is_pair: bool) -> tuple[PoseExplanation, int] | None:
    """Return the explanation where another camera fits clearly better, and how many matches agree then.

    Args:
        matches: Distinct rows.
        base: Their best pose with the camera of the command.
        is_pair: Whether the points were measured by the same camera (the world is a reference camera).
    """
    count = 0 if base is None else base.count
    best: tuple[_Freed, bool] | None = None
    starts = [(matches.camera, base)] if base is not None and base.count >= _LEAST else []
    if count < 0.6 * len(matches):
        starts += _grid(matches, count)
    for camera, fit in starts:
        factor = camera.fx / matches.camera.fx
        for pair in (False, True) if is_pair and factor == 1.0 else (False,):
            freed = _free_camera(matches, fit, math.log(factor), pair=pair)
            if freed is not None and (best is None or freed.cost < best[0].cost):
                best = (freed, pair)
    if best is None:
        return None
    freed, pair = best
    return _judge(matches, base, freed, pair=pair)


def _grid(matches: Matches, least: int) -> list[tuple[Camera, Fit]]:
    """Return the best of some cameras with another focal length, where it beats *least* inliers."""
    best: tuple[Camera, Fit] | None = None
    for factor in _GRID:
        for scaled_centre in (False, True):
            camera = matches.camera
            centre = (camera.cx * factor, camera.cy * factor) if scaled_centre else (camera.cx, camera.cy)
            try:
                other = _camera(camera, factor, centre)
            except InvalidCamera:
                continue
            fit = fit_pose(replace(matches, camera=other), iterations=150)
            if fit is not None and fit.count > max(least, _LEAST, 0 if best is None else best[1].count):
                best = (other, fit)
    return [] if best is None else [best]


def _camera(camera: Camera, factor: float, centre: tuple[float, float]) -> Camera:
    """Return *camera* with focal lengths times *factor* and another principal point.

    Raises:
        InvalidCamera: Such a camera is absurd.
    """
    return Camera(
        fx=camera.fx * factor, fy=camera.fy * factor, cx=centre[0], cy=centre[1],
        width=camera.width, height=camera.height,
    )  # fmt: skip


def _free_camera(matches: Matches, fit: Fit, log_factor: float, *, pair: bool) -> _Freed | None:
    """Fit pose, focal factor, principal point and one coefficient of radial distortion.

    The errors carry a Cauchy weight of ``tight_px``; the weak priors keep what the matches do not fix at 0.
    """
    pose = fit.T_camera_world
    change = np.array([log_factor, 0.0, 0.0, 0.0])
    prior = np.concatenate([np.zeros(6), 1.0 / np.array([0.7, 0.15, 0.15, 0.3]) ** 2])
    damping, last = 1e-4, math.inf
    state = _evaluate(matches, pose, change, pair=pair)
    normal = np.eye(10)
    for _ in range(_ITERATIONS):
        residual, slopes, near = state
        squares = (residual**2).sum(axis=0)
        weight = near / (1.0 + squares / matches.tight_px**2)
        normal = np.einsum("aik,bik,k->ab", slopes, slopes, weight) + np.diag(prior)
        gradient = np.einsum("aik,ik,k->a", slopes, residual, weight)
        gradient[6:] -= prior[6:] * change
        cost = _cost(matches, residual, near) + float(prior[6:] @ change**2)
        try:
            step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), gradient)
        except np.linalg.LinAlgError:
            return None
        if not np.isfinite(step).all() or float(np.abs(step[:6]).max()) > 2.0:
            damping *= 10.0
            continue
        moved, changed = exp_se3(step[:6]) @ pose, change + step[6:]
        if abs(changed[0]) > 1.2:
            return None
        tried = _evaluate(matches, moved, changed, pair=pair)
        tried_cost = _cost(matches, tried[0], tried[2]) + float(prior[6:] @ changed**2)
        if tried_cost > cost:
            damping = max(damping, 1e-6) * 10.0
            continue
        pose, change, state, damping = moved, changed, tried, damping / 10.0
        if last - tried_cost < 1e-5 * tried_cost:
            break
        last = tried_cost
    residual, _, near = state
    errors = np.sqrt((residual**2).sum(axis=0))
    errors[~near] = np.inf
    right = errors[errors <= 2.0 * matches.tight_px]
    if len(right) < _LEAST:
        return None
    variance = float(np.mean(right**2)) / 2.0 + 0.05
    try:
        deviation = np.sqrt(np.diag(np.linalg.inv(normal))[6:] * variance)
    except np.linalg.LinAlgError:
        return None
    return _Freed(
        T_camera_world=pose, change=change, deviation=deviation, errors_px=errors,
        cost=_cost(matches, residual, near),
    )  # fmt: skip


def _cost(matches: Matches, residual: Array, near: Mask) -> float:
    """Return the robust cost, px^2."""
    limit2 = matches.tight_px**2
    squares = np.where(near, (residual**2).sum(axis=0), 1e6)
    return float(limit2 * np.log1p(squares / limit2).sum())


def _evaluate(matches: Matches, pose: Array, change: Array, *, pair: bool) -> tuple[Array, Array, Mask]:
    """Return residuals ``(2, n)``, their slopes ``(10, 2, n)``, and which points are before the camera."""
    camera = matches.camera
    values = _project(matches, pose, change, pair=pair)
    near = values[2] > 0.05
    residual = matches.pixels.T - values[:2]
    slopes = np.empty((10, 2, len(matches)))
    x, y, z = values[3:6]
    f = math.exp(change[0])
    fx, fy = camera.fx * f, camera.fy * f
    w = np.where(near, 1.0 / np.where(near, z, 1.0), 0.0)
    a, b = x * w, y * w
    bent = 1.0 + change[3] * (a * a + b * b)
    zero = np.zeros_like(w)
    slopes[:6, 0] = fx * bent * np.array([w, zero, -a * w, -a * b, 1 + a * a, -b])
    slopes[:6, 1] = fy * bent * np.array([zero, w, -b * w, -1 - b * b, a * b, a])
    if pair:
        for index in range(4):
            small = np.zeros(4)
            small[index] = 1e-4
            moved = _project(matches, pose, change + small, pair=True)
            slopes[6 + index] = (moved[:2] - values[:2]) / 1e-4
    else:
        radius2 = a * a + b * b
        slopes[6] = [fx * a * bent, fy * b * bent]
        slopes[7] = [np.full_like(w, camera.fx), zero]
        slopes[8] = [zero, np.full_like(w, camera.fx)]
        slopes[9] = [fx * a * radius2, fy * b * radius2]
    slopes[:, :, ~near] = 0.0
    residual[:, ~near] = 0.0
    return residual, slopes, near


def _project(matches: Matches, pose: Array, change: Array, *, pair: bool) -> Array:
    """Return ``(6, n)``: the pixel, the depth, and the point in the camera's frame."""
    camera, points = matches.camera, matches.points
    f = math.exp(change[0])
    shift_u, shift_v = camera.fx * change[1], camera.fx * change[2]
    if pair:
        z = points[:, 2]
        points = np.column_stack(
            [
                (camera.fx * points[:, 0] - shift_u * z) / (camera.fx * f),
                (camera.fy * points[:, 1] - shift_v * z) / (camera.fy * f),
                z,
            ]
        )
        inverse_z = 1.0 / np.where(np.abs(z) > 1e-6, z, 1.0)
        radius2 = (points[:, 0] * inverse_z) ** 2 + (points[:, 1] * inverse_z) ** 2
        points[:, :2] *= (1.0 - change[3] * radius2)[:, None]
    seen = transform(pose, points)
    x, y, z = seen.T
    near = z > 0.05
    w = np.where(near, 1.0 / np.where(near, z, 1.0), 0.0)
    a, b = x * w, y * w
    bent = 1.0 + change[3] * (a * a + b * b)
    u = camera.fx * f * a * bent + camera.cx + shift_u
    v = camera.fy * f * b * bent + camera.cy + shift_v
    return np.array([u, v, z, x, y, z])


def _judge(
    matches: Matches, base: Fit | None, freed: _Freed, *, pair: bool
) -> tuple[PoseExplanation, int] | None:
    """Return the explanation if the other camera differs, is certain, and fits more or closer."""
    camera = matches.camera
    tight = matches.tight_px
    count = 0 if base is None else base.count
    now = int(np.count_nonzero(freed.errors_px <= tight))
    focal = math.expm1(freed.change[0])
    least = np.array([_LEAST_FOCAL, _LEAST_CENTRE, _LEAST_CENTRE, _LEAST_BEND])
    ratio = np.abs(freed.change) / least
    certain = np.abs(freed.change) / np.maximum(freed.deviation, 1e-9)
    differs = bool(((ratio > 1.0) & (certain > _CERTAIN)).any())
    before_cost = 1e9 if base is None else _cost(matches, _residual(base), np.isfinite(base.errors_px))
    both = np.zeros(len(matches), dtype=np.bool_) if base is None else base.agrees
    both = both & (freed.errors_px <= tight)
    before_px = _rms(base.errors_px[both]) if base is not None and both.any() else math.inf
    after_px = _rms(freed.errors_px[freed.errors_px <= tight])
    gain = 1.0 - freed.cost / before_cost
    more = (now - count) / len(matches)
    if not differs or now < _LEAST or not (gain > 0.12 or more > 0.1) or now < 0.9 * count:
        return None
    parts = []
    if ratio[0] > 1.0 and certain[0] > _CERTAIN:
        parts.append(f"a focal length of {camera.fx * (1 + focal):.0f} px instead of {camera.fx:.0f}")
    if max(ratio[1:3]) > 1.0 and max(certain[1:3]) > _CERTAIN:
        parts.append(
            f"a principal point moved by ({camera.fx * freed.change[1]:.0f}, "
            f"{camera.fx * freed.change[2]:.0f}) px"
        )
    if ratio[3] > 1.0 and certain[3] > _CERTAIN:
        parts.append(f"radial distortion of {freed.change[3]:+.2f} left in the pixels")
    strength = min(1.0, max(gain, 2.0 * more))
    return PoseExplanation(
        cause=Cause.INTRINSICS,
        confidence=min(0.95, 0.62 + 0.35 * strength),
        sentence=(
            f"with {' and '.join(parts)}, {now} of {len(matches)} matches agree instead of {count}, to "
            f"{after_px:.2f} px: the intrinsics are not those of this image"
            + (" (nor of the image the points come from)" if pair else "")
        ),
        evidence={
            "focal_factor": 1.0 + focal, "focal_factor_deviation": float(freed.deviation[0]),
            "centre_shift_u_px": float(camera.fx * freed.change[1]),
            "centre_shift_v_px": float(camera.fx * freed.change[2]),
            "radial_distortion": float(freed.change[3]), "inliers": float(count),
            "inliers_with_that_camera": float(now), "cost_drop": gain,
            "rms_before_px": before_px if math.isfinite(before_px) else -1.0, "rms_after_px": after_px,
        },
    ), now  # fmt: skip


def _residual(fit: Fit) -> Array:
    return np.vstack([np.where(np.isfinite(fit.errors_px), fit.errors_px, 0.0), np.zeros(len(fit.errors_px))])


def _rms(errors: Array) -> float:
    return float(np.sqrt(np.mean(errors**2))) if len(errors) else math.inf
