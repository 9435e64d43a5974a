"""Depth scale and late frames: the motion that the poses tell against the robot's odometry."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from rse_pf.geometry import Array, inverse, rotation_angle_deg, transform
from rse_pf.recording.explain.causes import Cause, PastCommand, PoseExplanation
from rse_pf.recording.explain.fitting import Fit, Matches

__all__ = ["depth_against_map", "motion_against_odometry"]

# Least change of the scale (log), least factor, and by how many deviations it must differ from 1.
_LEAST_SCALE, _LEAST_FACTOR, _CERTAIN = 0.10, 0.05, 4.0
# Noise of a step, metres, however well few steps fit.
_LEAST_NOISE_M = 0.005
_TURN_NOISE_DEG = 0.3
# What is the same factor, and how many steps must have it.
_SAME_FACTOR, _MOST = 0.15, 0.7
_LEAST_MOTION_M, _LEAST_TURN_DEG, _LEAST_WAY_M = 0.015, 1.0, 0.08
_STEPS = 10


def depth_against_map(matches: Matches, base: Fit) -> PoseExplanation | None:
    """Return the explanation where the depths at the pixels are a constant multiple of the points' depths."""
    if matches.depths_m is None:
        return None
    depths = transform(base.T_camera_world, matches.points)[:, 2]
    rows = base.agrees & (matches.depths_m > 0) & (depths > 0.1)
    if np.count_nonzero(rows) < 12:
        return None
    ratios = np.log(matches.depths_m[rows] / depths[rows])
    centre = float(np.median(ratios))
    spread = 1.4826 * float(np.median(np.abs(ratios - centre)))
    scale = math.exp(centre)
    if abs(centre) < 0.06 or abs(centre) < 2.0 * spread:
        return None
    return PoseExplanation(
        cause=Cause.DEPTH_SCALE,
        confidence=min(0.95, 0.75 + abs(centre)),
        sentence=(
            f"the depths of this image are {scale:.2f} times those of the points in {np.count_nonzero(rows)} "
            f"matches (spread {spread:.0%}): one of the two has a wrong depth scale"
        ),
        evidence={"depth_ratio": scale, "depth_ratio_spread": spread},
    )


def motion_against_odometry(
    T_camera_world: Array, T_odom_camera: Array | None, history: Sequence[PastCommand], *, is_pair: bool
) -> tuple[PoseExplanation | None, tuple[str, ...]]:
    """Return the explanation where steps are a constant multiple of the odometry's, and what was missing.

    A wrong depth scale changes lengths and no angles.  A late frame changes both alike, and the present
    step only.

    Args:
        T_camera_world: ``(4, 4)``, the pose of the command.
        T_odom_camera: ``(4, 4)``, odometry at its frame; None if there is none.
        history: Earlier commands of the robot, oldest first.
        is_pair: Whether the world of each command is a camera, as a rule that of the frame before.
    """
    if not history:
        return None, ("earlier commands of the robot (they would show its motion)",)
    steps = _steps(T_camera_world, T_odom_camera, history, is_pair=is_pair)
    if not steps:
        return None, ("the robot's odometry (it would show a wrong depth scale or a late frame)",)
    by_pose, by_odom = (np.array([step[k][:3, 3] for step in steps]) for k in (0, 1))
    moving = np.linalg.norm(by_odom, axis=1) > _LEAST_MOTION_M
    if not moving.any():
        return None, ("a motion of the robot (it stood still, so scale cannot be seen)",)
    scale, deviation, alike = _scale(by_pose[moving], by_odom[moving])
    if alike < _MOST or float(np.linalg.norm(by_odom[moving], axis=1).sum()) < _LEAST_WAY_M:
        return None, ()
    turns = np.array([[rotation_angle_deg(step[k][:3, :3]) for k in (0, 1)] for step in steps])
    turning = turns[:, 1] > _LEAST_TURN_DEG
    turn_scale = float(turns[turning, 0].sum() / turns[turning, 1].sum()) if turning.any() else 1.0
    count = int(np.count_nonzero(moving))
    differs = scale > _LEAST_FACTOR and abs(math.log(scale)) > _LEAST_SCALE
    if not differs or abs(scale - 1.0) < _CERTAIN * deviation:
        return None, ()
    turn_deviation = _TURN_NOISE_DEG * math.sqrt(count) / max(1e-9, float(turns[turning, 1].sum()))
    if abs(turn_scale - 1.0) > max(0.5 * abs(scale - 1.0), 3.0 * turn_deviation):
        return None, ()
    moved_m, odom_m = (
        float(np.linalg.norm(positions[moving], axis=1).sum()) for positions in (by_pose, by_odom)
    )
    return PoseExplanation(
        cause=Cause.DEPTH_SCALE,
        confidence=min(0.93, 0.7 + 0.5 * abs(math.log(scale))),
        sentence=(
            f"over {count} step(s), the poses moved {moved_m:.2f} m where the odometry moved {odom_m:.2f} m: "
            f"{scale:.2f} times as far along the same way, while turns agree: the depth scale is wrong by "
            "that factor"
        ),
        evidence={
            "scale": scale, "scale_deviation": deviation, "steps": float(count), "turn_scale": turn_scale,
            "moved_by_poses_m": moved_m, "moved_by_odometry_m": odom_m,
        },
    ), ()  # fmt: skip


def _steps(
    T_camera_world: Array, T_odom_camera: Array | None, history: Sequence[PastCommand], *, is_pair: bool
) -> list[tuple[Array, Array]]:
    """Return pairs of motions from one frame to the next, by the poses and by the odometry."""
    last = PastCommand(sent_s=0.0, T_camera_world=T_camera_world, T_odom_camera=T_odom_camera)
    chain = [*history[-_STEPS:], last]
    steps = []
    for before, after in pairwise(chain):
        if before.T_odom_camera is None or after.T_odom_camera is None or after.T_camera_world is None:
            continue
        odometry = inverse(after.T_odom_camera) @ before.T_odom_camera
        if is_pair:
            steps.append((after.T_camera_world, odometry))
        elif before.T_camera_world is not None:
            steps.append((after.T_camera_world @ inverse(before.T_camera_world), odometry))
    return steps


def _scale(by_pose: Array, by_odom: Array) -> tuple[float, float, float]:
    """Return the factor from odometry to poses, its standard deviation, and the share of steps that have it.

    Single poses may be wrong, and where the world of a command is an older keyframe, the factor is the number
    of frames since then: only steps that agree with the median are counted.
    """
    lengths = np.linalg.norm(by_odom, axis=1)
    factors = (by_pose * by_odom).sum(axis=1) / lengths**2
    median = float(np.median(factors))
    allowed = np.maximum(_SAME_FACTOR * abs(median), 4.0 * _LEAST_NOISE_M / lengths)
    alike = np.abs(factors - median) <= allowed
    poses, odom = by_pose[alike], by_odom[alike]
    if not len(odom):
        return median, math.inf, 0.0
    length2 = float(np.vdot(odom, odom))
    scale = float(np.vdot(poses, odom)) / length2
    rest = poses - scale * odom
    variance = float(np.vdot(rest, rest)) / max(1, rest.size - 1)
    return scale, max(math.sqrt(variance), _LEAST_NOISE_M) / math.sqrt(length2), float(np.mean(alike))
