"""Errors of an estimated trajectory against the true one: ATE and RPE as the TUM benchmark defines them.

The truth is interpolated to the time stamps of the estimate.  The functions change neither trajectory and
read no files.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from client_sdk.trajectory import Trajectory
from rse_pf.errors import UsageError
from rse_pf.geometry import Array, body_poses, inverse, pose_difference

__all__ = [
    "Accuracy",
    "accuracy",
    "align",
    "ate_m",
    "match_truth",
    "matched_poses",
    "residuals_m",
    "rms",
    "trajectory_figures",
    "with_truth",
]

MAX_TRUTH_GAP_S = 0.25
"""The truth is not interpolated between two true poses that are more than this many seconds apart."""
SAME_STAMP_S = 0.002
"""A pose within this many seconds of a true one has a truth, also before the first and after the last."""
STEP_S = 1.0
"""Time over which the relative pose error compares motions, in seconds."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Accuracy:
    """Errors of the poses that have a truth, after one alignment of the whole trajectory.

    ``rpe_m`` and ``rpe_deg`` are the errors of the motion over `STEP_S`, None if no two poses are that far
    apart in time; they are in metres also if the scale was estimated.  ``poses`` is the number of poses that
    were compared. ``compared`` holds the estimated poses before the alignment, ``aligned`` those after it,
    and ``truth`` the true poses at the same times.  ``has_unit`` says whether ``compared`` is in metres
    already, so that its scale need not be estimated.
    """

    ate_m: float
    ate_max_m: float
    rpe_m: float | None
    rpe_deg: float | None
    rpe_max_deg: float | None
    poses: int
    scale: float
    has_unit: bool
    compared: Trajectory
    aligned: Trajectory
    truth: Trajectory

    def figures(self) -> dict[str, float | None]:
        """Return ATE and RPE in centimetres and degrees, by the names that reports use."""
        return {
            "ate_cm": 100 * self.ate_m,
            "rpe_cm": None if self.rpe_m is None else 100 * self.rpe_m,
            "rpe_deg": self.rpe_deg,
        }


def accuracy(
    estimate: Trajectory,
    truth: Trajectory,
    *,
    with_scale: bool = False,
    T_body_camera: Array | None = None,
) -> Accuracy:
    """Return the errors of *estimate* against *truth*, interpolated to the time stamps of *estimate*.

    Args:
        estimate: Poses of a camera; those without truth are left out.
        truth: True poses of the same camera, in any world frame.
        with_scale: Align with a scale (Sim(3)), for an estimate whose unit is unknown; otherwise without
            (SE(3)).
        T_body_camera: ``(4, 4)``, metres.  If given, both trajectories are compared as poses of the body.
            With *with_scale* the camera's path is scaled to metres first, since the body's offset is in
            metres.

    Raises:
        UsageError: Fewer than three poses have a truth.

    Source:
        Sturm et al., IROS 2012, eqs. 1 to 3; alignment after Umeyama, PAMI 1991.
    """
    rows, true_poses = match_truth(estimate, truth)
    stamps_s, poses = estimate.timestamps_s[rows], estimate.T_world_camera[rows].copy()
    compared, scale = poses.copy(), 1.0
    if with_scale:
        scale, _ = align(poses[:, :3, 3], true_poses[:, :3, 3], with_scale=True)
        poses[:, :3, 3] *= scale
    if T_body_camera is not None:
        poses, true_poses = body_poses(poses, T_body_camera), body_poses(true_poses, T_body_camera)
        compared = poses
    _, T_truth_estimate = align(poses[:, :3, 3], true_poses[:, :3, 3])
    poses = T_truth_estimate @ poses
    distances = np.linalg.norm(poses[:, :3, 3] - true_poses[:, :3, 3], axis=1)
    metres, degrees = _motion_errors(stamps_s, poses, true_poses)
    return Accuracy(
        ate_m=rms(distances),
        ate_max_m=float(distances.max()),
        rpe_m=rms(metres) if len(metres) else None,
        rpe_deg=rms(degrees) if len(degrees) else None,
        rpe_max_deg=float(degrees.max()) if len(degrees) else None,
        poses=len(rows),
        scale=scale,
        has_unit=T_body_camera is not None or not with_scale,
        compared=Trajectory(stamps_s, compared),
        aligned=Trajectory(stamps_s, poses),
        truth=Trajectory(stamps_s, true_poses),
    )


def match_truth(estimate: Trajectory, truth: Trajectory) -> tuple[npt.NDArray[np.int64], Array]:
    """Return the rows ``(n,)`` of *estimate* that have a truth, and their true poses ``(n, 4, 4)``.

    Raises:
        UsageError: Fewer than three poses have a truth.
    """
    rows = np.flatnonzero(with_truth(truth, estimate.timestamps_s))
    if len(rows) < 3:
        raise UsageError(
            f"{len(rows)} poses have a true one at their time, an evaluation needs 3",
            hint="check that recording and truth use the same clock",
        )
    return rows, truth.at(estimate.timestamps_s[rows])


def with_truth(truth: Trajectory, stamps_s: npt.ArrayLike) -> npt.NDArray[np.bool_]:
    """Return for each of the times ``(n,)`` whether it has a truth.

    A time has a truth between two true poses at most `MAX_TRUTH_GAP_S` apart, or within `SAME_STAMP_S` of a
    true pose.
    """
    stamps, known = np.asarray(stamps_s, dtype=float), np.sort(truth.timestamps_s)
    if not len(known):
        return np.zeros(len(stamps), dtype=bool)
    after = np.searchsorted(known, stamps)
    left, right = known[np.clip(after - 1, 0, None)], known[np.clip(after, None, len(known) - 1)]
    is_between = (left <= stamps) & (stamps <= right) & (right - left <= MAX_TRUTH_GAP_S)
    nearest = np.minimum(np.abs(left - stamps), np.abs(right - stamps))
    return np.asarray(is_between | (nearest <= SAME_STAMP_S))


def _motion_errors(stamps_s: Array, poses: Array, true_poses: Array) -> tuple[Array, Array]:
    """Return the errors (metres, degrees) of the motion from each pose to the pose `STEP_S` later.

    A pose without another pose at that time, within half the median interval, has no error in the arrays.
    """
    errors = []
    half_s = 0.5 * float(np.median(np.diff(stamps_s)))
    for row, stamp_s in enumerate(stamps_s):
        later = int(np.argmin(np.abs(stamps_s - stamp_s - STEP_S)))
        if later > row and abs(stamps_s[later] - stamp_s - STEP_S) <= half_s + 1e-3:
            moved = inverse(poses[row]) @ poses[later]
            errors.append(pose_difference(moved, inverse(true_poses[row]) @ true_poses[later]))
    return np.array([metres for metres, _ in errors]), np.array([degrees for _, degrees in errors])


def ate_m(T_estimate: Array, T_truth: Array) -> float:
    """Return the rmse (m) of the positions of poses ``(n, 4, 4)`` after the least-squares SE(3) alignment."""
    return rms(residuals_m(T_estimate[:, :3, 3], T_truth[:, :3, 3]))


def trajectory_figures(
    estimate: Trajectory, truth: Trajectory | None, T_body_camera: Array | None = None
) -> dict[str, float | None]:
    """Return the length ``path_m`` of *estimate*, and its ``ate_cm``, ``rpe_cm`` and ``rpe_deg``, rounded.

    The errors are None without a truth, or if fewer than three poses have one.  With *T_body_camera* ``(4,
    4)`` they are errors of the body.
    """
    figures: dict[str, float | None] = {
        "path_m": round(estimate.length_m, 3),
        "ate_cm": None,
        "rpe_cm": None,
        "rpe_deg": None,
    }
    if truth is not None:
        with contextlib.suppress(UsageError):
            errors = accuracy(estimate, truth, T_body_camera=T_body_camera).figures()
            figures |= {name: None if value is None else round(value, 4) for name, value in errors.items()}
    return figures


def align(points: Array, wanted: Array, *, with_scale: bool = False) -> tuple[float, Array]:
    """Return scale ``s`` and pose ``[R t]`` with which ``s R p + t`` maps *points* closest to *wanted*.

    Both are ``(n, 3)``, and the sum of squared distances is minimal.  The scale is 1 without *with_scale*.

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


def matched_poses(
    estimate: Trajectory, truth: Trajectory | None
) -> tuple[npt.NDArray[np.int64], Array] | None:
    """Return the result of `match_truth`; None without a truth, or if fewer than three poses have one."""
    if truth is None:
        return None
    try:
        return match_truth(estimate, truth)
    except UsageError:
        return None


def residuals_m(points: Array, wanted: Array) -> Array:
    """Return the distances ``(n,)`` of *points* from *wanted*, after one rigid alignment of all *points*."""
    _, T = align(points, wanted)
    distances: Array = np.linalg.norm(points @ T[:3, :3].T + T[:3, 3] - wanted, axis=1)
    return distances


def rms(values: Array) -> float:
    """Return the root of the mean square of *values*."""
    return float(np.sqrt(np.mean(np.square(values))))
