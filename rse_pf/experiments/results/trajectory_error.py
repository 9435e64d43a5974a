"""Errors of an estimated trajectory against the true one: ATE and RPE as the TUM benchmark defines them.

Pure functions: they change neither trajectory and read no files.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from client_sdk.mapping import Trajectory
from rse_pf.errors import UsageError
from rse_pf.geometry import Array, inverse, rotation_angle_deg

__all__ = [
    "AbsoluteError",
    "RelativeError",
    "absolute_error",
    "align",
    "associate",
    "relative_error",
    "trajectory_figures",
]

MAX_STAMP_DIFFERENCE_S = 0.02
"""Poses further apart in time are not compared: the TUM benchmark's default (evo's is 0.01)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AbsoluteError:
    """Distances between aligned positions; the alignment maps the estimate onto the truth."""

    rmse_m: float
    median_m: float
    max_m: float
    matched: int
    scale: float
    T_truth_estimate: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class RelativeError:
    """Errors of the motion between consecutive matched poses."""

    rmse_m: float
    rmse_deg: float
    max_m: float
    max_deg: float
    steps: int


def absolute_error(
    estimate: Trajectory,
    truth: Trajectory,
    *,
    with_scale: bool = False,
    max_difference_s: float = MAX_STAMP_DIFFERENCE_S,
) -> AbsoluteError:
    """Return the absolute trajectory error after a rigid alignment of the estimate.

    Args:
        estimate: Poses to evaluate.
        truth: True poses, in any frame.
        with_scale: Also estimate a scale (Sim(3)), as for one camera without depth.
        max_difference_s: Largest difference of the time stamps of a pair.

    Raises:
        UsageError: Fewer than three poses match in time.

    Source:
        Sturm et al., IROS 2012, eq. 3; alignment after Umeyama, PAMI 1991.
    """
    rows, truth_rows = associate(estimate, truth, max_difference_s)
    positions, wanted = estimate.positions[rows], truth.positions[truth_rows]
    scale, T_truth_estimate = align(positions, wanted, with_scale=with_scale)
    moved = scale * positions @ T_truth_estimate[:3, :3].T + T_truth_estimate[:3, 3]
    distances = np.linalg.norm(moved - wanted, axis=1)
    return AbsoluteError(
        rmse_m=_rms(distances),
        median_m=float(np.median(distances)),
        max_m=float(distances.max()),
        matched=len(rows),
        scale=scale,
        T_truth_estimate=T_truth_estimate,
    )


def relative_error(
    estimate: Trajectory, truth: Trajectory, *, max_difference_s: float = MAX_STAMP_DIFFERENCE_S
) -> RelativeError:
    """Return the relative pose error over consecutive matched poses; it needs no alignment.

    Raises:
        UsageError: Fewer than three poses match in time.

    Source:
        Sturm et al., IROS 2012, eqs. 1 and 2, with a step of one frame.
    """
    rows, truth_rows = associate(estimate, truth, max_difference_s)
    poses, true_poses = estimate.T_world_camera[rows], truth.T_world_camera[truth_rows]
    distances, angles = [], []
    for row in range(len(rows) - 1):
        moved = inverse(poses[row]) @ poses[row + 1]
        truly = inverse(true_poses[row]) @ true_poses[row + 1]
        error = inverse(truly) @ moved
        distances.append(np.linalg.norm(error[:3, 3]))
        angles.append(rotation_angle_deg(error[:3, :3]))
    return RelativeError(
        rmse_m=_rms(np.array(distances)),
        rmse_deg=_rms(np.array(angles)),
        max_m=float(np.max(distances)),
        max_deg=float(np.max(angles)),
        steps=len(distances),
    )


def trajectory_figures(estimate: Trajectory, truth: Trajectory | None) -> dict[str, float | None]:
    """Return ``path_m``, ``ate_cm``, ``rpe_cm`` and ``rpe_deg``, rounded for a report.

    The errors are None without a truth, or where fewer than three poses match it in time.
    """
    figures: dict[str, float | None] = {
        "path_m": round(estimate.length_m, 3),
        "ate_cm": None,
        "rpe_cm": None,
        "rpe_deg": None,
    }
    if truth is not None:
        with contextlib.suppress(UsageError):
            relative = relative_error(estimate, truth)
            figures["ate_cm"] = round(100 * absolute_error(estimate, truth).rmse_m, 4)
            figures["rpe_cm"] = round(100 * relative.rmse_m, 4)
            figures["rpe_deg"] = round(relative.rmse_deg, 4)
    return figures


def associate(
    estimate: Trajectory, truth: Trajectory, max_difference_s: float = MAX_STAMP_DIFFERENCE_S
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Return the rows of both trajectories that belong together, nearest in time.

    Every pose of the shorter trajectory takes the nearest of the longer one.

    Raises:
        UsageError: Fewer than three poses match.
    """
    swapped = len(truth) < len(estimate)
    few, many = (truth, estimate) if swapped else (estimate, truth)
    rows = _nearest_rows(few.timestamps_s, many.timestamps_s)
    near = np.abs(few.timestamps_s - many.timestamps_s[rows]) <= max_difference_s if len(many) else rows > 0
    if near.sum() < 3:
        raise UsageError(
            f"{int(near.sum())} poses match within {max_difference_s:g} s, an evaluation needs 3",
            hint="check that both trajectories use the same clock",
        )
    of_few, of_many = np.flatnonzero(near), rows[near]
    return (of_many, of_few) if swapped else (of_few, of_many)


def _nearest_rows(wanted: Array, values: Array) -> npt.NDArray[np.int64]:
    """Return, for each wanted value, the row of the nearest of *values*, in any order."""
    if len(values) < 2:
        return np.zeros(len(wanted), dtype=np.int64)
    order = np.argsort(values, kind="stable")
    ascending = values[order]
    right = np.clip(np.searchsorted(ascending, wanted), 1, len(values) - 1)
    is_left = wanted - ascending[right - 1] <= ascending[right] - wanted
    return order[right - is_left]


def align(points: Array, wanted: Array, *, with_scale: bool = False) -> tuple[float, Array]:
    """Return scale and pose that bring ``(n, 3)`` points closest to *wanted*: ``s R p + t``.

    Source:
        Umeyama, PAMI 1991, eqs. 38-42.
    """
    mean, wanted_mean = points.mean(axis=0), wanted.mean(axis=0)
    centred, wanted_centred = points - mean, wanted - wanted_mean
    U, singular, Vt = np.linalg.svd(wanted_centred.T @ centred / len(points))
    S = np.ones(3)
    if np.linalg.det(U) * np.linalg.det(Vt) < 0:
        S[2] = -1.0  # eq. 39: a rotation, never a mirror
    rotation = U @ np.diag(S) @ Vt
    variance = float((centred**2).sum() / len(points))
    scale = float(singular @ S) / variance if with_scale and variance > 0 else 1.0
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = wanted_mean - scale * rotation @ mean
    return scale, pose


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
