"""`explain`: from one recorded command to the causes that fit it, likeliest first.

Nothing is measured here; each cause has a module of its own.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from rse_pf.errors import RsePfError
from rse_pf.geometry import Array
from rse_pf.pnp import PnpOptions, PnpSolution
from rse_pf.recording.explain.causes import (
    Cause,
    MatchesLike,
    PastCommand,
    PoseExplanation,
    ReplyLike,
    Timing,
)
from rse_pf.recording.explain.clocks import late
from rse_pf.recording.explain.fitting import Fit, Matches, fit_pose, solve_or_refuse
from rse_pf.recording.explain.inputs import (
    check_history,
    check_matches,
    check_pose,
    check_reply,
    check_timing,
)
from rse_pf.recording.explain.intrinsics import intrinsics
from rse_pf.recording.explain.matches import (
    distinct_rows,
    duplicates,
    explain_mirror,
    line,
    outliers,
    plane,
    stale_map,
)
from rse_pf.recording.explain.motion import depth_against_map, motion_against_odometry
from rse_pf.recording.explain.pictures import blur
from rse_pf.recording.explain.row_order import row_order

__all__ = ["explain"]

_MAX_THUMBNAILS = 5
_LEAST_ROWS = 4
# Share of agreeing rows above which nothing but another camera is looked for in them.
_HEALTHY_SHARE = 0.9
_RIGHT_SHARE = 0.5
# A wrong camera scatters the rows, and what is left of them may well lie in one plane.
_BEHIND_CAMERA = 0.7


def explain(
    matches: MatchesLike,
    reply: ReplyLike | None,
    *,
    thumbnail: bytes | None = None,
    history: Sequence[PastCommand] | None = None,
    timing: Timing | None = None,
    T_odom_camera: Array | None = None,
) -> list[PoseExplanation]:
    """Return the causes that fit a bad pose, likeliest first; one of `Cause.NONE` where nothing is wrong.

    Deterministic; at most 200 ms on one core.  What was not recorded is named in ``missing``.

    Args:
        matches: The command's payload, as it was sent.
        reply: The answer; None where there was none or it was a failure.
        thumbnail: A small picture of the frame, JPEG or PNG.
        history: Earlier commands of the same robot, oldest first; 5 to 10 suffice.
        timing: When command and answer were where.
        T_odom_camera: ``(4, 4)``, the robot's own odometry at the frame.
    """
    with np.errstate(all="ignore"):
        return _rank(
            matches, check_reply(reply), thumbnail, check_history(history), check_timing(timing),
            check_pose(T_odom_camera),
        )  # fmt: skip


def _rank(
    matches: MatchesLike, reply: ReplyLike | None, thumbnail: bytes | None, history: Sequence[PastCommand],
    timing: Timing | None, T_odom_camera: Array | None,
) -> list[PoseExplanation]:  # fmt: skip
    rows, options = check_matches(matches)
    found_late, missing = late(timing)
    thumbnails = [past.thumbnail for past in history if past.thumbnail is not None]
    usual = [past.matches for past in history if past.matches]
    usual_matches = float(np.median(usual)) if usual else None
    found_blur, lacks = blur(thumbnail, thumbnails[-_MAX_THUMBNAILS:], len(rows), usual_matches)
    missing += lacks
    explanations = [explanation for explanation in (found_late, found_blur) if explanation is not None]
    if len(rows) >= _LEAST_ROWS:
        more, lacks = _by_matches(rows, options, reply, history, T_odom_camera)
        explanations += more
        missing += lacks
    explanations.sort(key=lambda each: -each.confidence)
    if not explanations:
        explanations = [_nothing_found(rows, reply)]
    lacking = tuple(dict.fromkeys(missing))
    return [
        replace(explanation, evidence=_finite(explanation.evidence), missing=lacking)
        for explanation in explanations
    ]


def _finite(evidence: Mapping[str, float]) -> dict[str, float]:
    return {name: value for name, value in evidence.items() if math.isfinite(value)}


def _by_matches(
    rows: Matches, options: PnpOptions, reply: ReplyLike | None, history: Sequence[PastCommand],
    T_odom_camera: Array | None,
) -> tuple[list[PoseExplanation], tuple[str, ...]]:  # fmt: skip
    """Return what the matches and the motion show, and what was missing for it."""
    distinct = rows.of(distinct_rows(rows))
    start = None if reply is None else check_pose(reply.T_camera_world)
    base = fit_pose(distinct, iterations=1000, start=start, polish=True)
    count = 0 if base is None else base.count
    is_pair = rows.depths_m is not None or _is_camera_frame(distinct)
    explanations: list[PoseExplanation | None] = [
        duplicates(len(rows), len(distinct), count),
        line(rows, base if len(distinct) >= _LEAST_ROWS else None),
    ]
    reflected = explain_mirror(distinct, base)
    if reflected is not None:
        return [explanation for explanation in (*explanations, reflected) if explanation is not None], ()
    if count < _HEALTHY_SHARE * len(distinct):
        explanations += _rivals(distinct, base, history, is_pair=is_pair)
    elif base is not None:
        freed = intrinsics(distinct, base, is_pair=is_pair)
        explanations.append(None if freed is None else freed[0])
    other_camera = any(
        explanation is not None and explanation.cause is Cause.INTRINSICS for explanation in explanations
    )
    lacks: tuple[str, ...] = ()
    if base is not None:
        weakness, deviation_m = _weakness(rows, options, reply)
        flat = plane(distinct, base, weakness, deviation_m)
        if flat is not None and other_camera:
            flat = replace(flat, confidence=_BEHIND_CAMERA * flat.confidence)
        explanations.append(flat)
        pose = base.T_camera_world if start is None else start
        moved, lacks = motion_against_odometry(pose, T_odom_camera, history, is_pair=is_pair)
        # Another camera moves along its axis, too, and a pose of few rows moves anywhere.
        if not other_camera and count >= _RIGHT_SHARE * len(distinct):
            explanations += [moved, depth_against_map(distinct, base)]
    return [explanation for explanation in explanations if explanation is not None], lacks


def _rivals(
    rows: Matches, base: Fit | None, history: Sequence[PastCommand], *, is_pair: bool
) -> list[PoseExplanation | None]:
    """Return the causes that may explain why rows disagree: of those, the one that explains most rows."""
    priors = [np.eye(4)] if is_pair else []
    past = [command.T_camera_world for command in history if command.T_camera_world is not None]
    priors += past[-1:]
    count = 0 if base is None else base.count
    tried = [row_order(rows, base, priors), intrinsics(rows, base, is_pair=is_pair)]
    if base is not None:
        tried.append(stale_map(rows, base))
    rivals = sorted((trial for trial in tried if trial is not None), key=lambda each: -each[1])
    result: list[PoseExplanation | None] = [outliers(rows, base)]
    for place, (explanation, explained) in enumerate(rivals):
        lower = 0.0 if place == 0 else 0.15 + 0.3 * (rivals[0][1] - explained) / len(rows)
        if explained > count:
            result.append(replace(explanation, confidence=max(0.05, explanation.confidence - lower)))
    return result


def _is_camera_frame(rows: Matches) -> bool:
    """Return whether the world looks like a reference camera: all points lie in its image."""
    points = rows.points
    if float(np.mean(points[:, 2] > 0.05)) < 0.98:
        return False
    camera = rows.camera
    front = points[points[:, 2] > 0.05]
    pixels = camera.project(front)
    margin = 0.02 * camera.width
    inside = (
        (pixels[:, 0] > -margin)
        & (pixels[:, 0] < camera.width + margin)
        & (pixels[:, 1] > -margin)
        & (pixels[:, 1] < camera.height + margin)
    )
    return bool(np.mean(inside) > 0.97)


def _weakness(rows: Matches, options: PnpOptions, reply: ReplyLike | None) -> tuple[str, float]:
    """Return why the pose is weak or was refused, and the deviation of its position, metres."""
    answer = solve_or_refuse(rows, options)
    if isinstance(answer, RsePfError):
        return (answer.code if reply is None else reply.reason), math.inf
    assert isinstance(answer, PnpSolution)
    deviation_m = math.sqrt(max(0.0, float(np.trace(answer.covariance[:3, :3]))))
    return (answer.reason if reply is None else reply.reason), deviation_m


def _nothing_found(rows: Matches, reply: ReplyLike | None) -> PoseExplanation:
    n = len(rows)
    evidence = {"matches": float(n), "rows_left_out": float(rows.left_out)}
    if n < _LEAST_ROWS:
        text = f"only {n} of {n + rows.left_out} rows hold usable numbers, and a pose needs {_LEAST_ROWS}"
        return PoseExplanation(cause=Cause.UNKNOWN, confidence=0.5, sentence=text, evidence=evidence)
    if reply is None:
        fit = fit_pose(rows)
        count = 0 if fit is None else fit.count
        evidence["inliers"] = float(count)
        text = (
            f"there is no pose, although {count} of {n} matches agree: the refusal has another reason"
            if count >= _RIGHT_SHARE * n
            else f"{n} matches gave no pose, and no known cause explains it"
        )
        return PoseExplanation(cause=Cause.UNKNOWN, confidence=0.3, sentence=text, evidence=evidence)
    inliers = int(np.asarray(reply.inliers).size)
    evidence |= {"inliers": float(inliers), "rmse_px": float(reply.rmse_px)}
    if reply.verdict != "ok":
        return PoseExplanation(
            cause=Cause.UNKNOWN, confidence=0.3,
            sentence=f"the pose is weak ({reply.reason}), and no known cause explains it", evidence=evidence,
        )  # fmt: skip
    return PoseExplanation(
        cause=Cause.NONE, confidence=0.9,
        sentence=f"nothing is wrong: {inliers} of {n} matches agree to {reply.rmse_px:.2f} px",
        evidence=evidence,
    )  # fmt: skip
