"""Causes that the matches alone show: copies, a mirrored world, one plane, outliers, points that moved."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array, pose_difference, transform
from rse_pf.pnp.evidence import width_to_length
from rse_pf.recording.explain.causes import Cause, PoseExplanation
from rse_pf.recording.explain.fitting import Fit, Matches, fit_pose, is_chance, robust_cost

__all__ = ["distinct_rows", "duplicates", "explain_mirror", "line", "outliers", "plane", "stale_map"]

# Rows that agree to half a pixel and to half a centimetre say the same thing.
_CELL_PX, _CELL_M = 0.5, 0.005
_COPIES = 0.35
_LEAST = 12
_RIGHT_SHARE = 0.5
# Log likelihood that the reflected world must gain.
_REFLECTION_GAIN = 100.0
# Deviation of the position above which a plane is called a cause.
_LOOSE_M = 0.02
# Less is the noise of a depth camera some metres away, which bends small groups of points alike.
_LEAST_SHIFT_M, _NOISE_SHIFT_M, _LARGE_GROUP = 0.045, 0.015, 0.15
# Width over length of a line.
_THIN = 0.03


def distinct_rows(matches: Matches) -> npt.NDArray[np.intp]:
    """Return the first row of each group of copies, sorted."""
    best: npt.NDArray[np.intp] | None = None
    rows = np.hstack([matches.pixels / _CELL_PX, matches.points / _CELL_M])
    for shift in (0.0, 0.5):
        _, first = np.unique(np.floor(rows + shift), axis=0, return_index=True)
        if best is None or len(first) < len(best):
            best = np.sort(first)
    assert best is not None
    return best


def duplicates(n: int, distinct: int, inliers: int) -> PoseExplanation | None:
    """Return the explanation where many rows are copies of others.

    Args:
        n: How many rows there are.
        distinct: How many of them differ.
        inliers: How many of those agree with the best pose.
    """
    share = 1.0 - distinct / n
    if share < _COPIES:
        return None
    return PoseExplanation(
        cause=Cause.DUPLICATES,
        confidence=min(0.97, 0.7 + 0.3 * share),
        sentence=(
            f"{n - distinct} of {n} matches ({share:.0%}) are copies of others: only {distinct} are "
            f"independent, and {inliers} of those agree with one pose"
        ),
        evidence={"copies_share": share, "distinct": float(distinct), "matches": float(n)},
    )


def explain_mirror(matches: Matches, base: Fit | None) -> PoseExplanation | None:
    """Return the explanation where the points fit clearly better after a reflection than as they are."""
    reflected = replace(matches, points=-matches.points)
    fit = fit_pose(reflected, iterations=1000, polish=True)
    if fit is None or fit.count < _LEAST:
        return None
    count = 0 if base is None else base.count
    if is_chance(len(matches), fit.count, matches.tight_px, matches.camera) or fit.count <= count:
        return None
    # A plane seen through a mirror is a plane again: there, only the errors tell the two apart.
    variance = max(1.0, float(np.mean(fit.errors_px[fit.agrees] ** 2)))
    gain = math.inf if base is None else (robust_cost(matches, base) - robust_cost(matches, fit)) / variance
    if fit.count < 1.6 * count and gain < _REFLECTION_GAIN:
        return None
    return PoseExplanation(
        cause=Cause.MIRRORED,
        confidence=0.9 + 0.08 * fit.count / len(matches),
        sentence=(
            f"{fit.count} of {len(matches)} matches agree when the world is mirrored, and only {count} as it "
            "is: one axis of the points, the sign of the depth or the image is reversed"
        ),
        evidence={"inliers_mirrored": float(fit.count), "inliers": float(count)},
    )


def plane(matches: Matches, base: Fit, weakness: str, deviation_m: float) -> PoseExplanation | None:
    """Return the explanation where the matches that agree lie in one plane, or in a small part of the image.

    Args:
        matches: Distinct rows.
        base: Their best pose.
        weakness: Why the pose is weak or was refused; empty if it is neither.
        deviation_m: Standard deviation of its position, infinite if there is none.
    """
    rows = base.agrees
    if np.count_nonzero(rows) < 6:
        return None
    points, pixels = matches.points[rows], matches.pixels[rows]
    depths = transform(base.T_camera_world, points)[:, 2]
    share, thickness_m = _planar_share(points, depths)
    spread_px = float(np.sqrt(((pixels - pixels.mean(axis=0)) ** 2).sum(axis=1).mean()))
    lengths_px = np.sqrt(np.linalg.eigvalsh(np.cov(pixels.T)))
    thinness = float(lengths_px[0] / max(lengths_px[1], 1e-9))
    variation = float(np.std(1.0 / depths) * np.mean(depths))
    small = spread_px < 0.06 * matches.camera.width or thinness < 0.08
    if share < 0.97 and not small:
        return None
    geometric = weakness in (
        "ambiguous", "nearly-collinear", "poorly-constrained", "clustered", "degenerate",
    )  # fmt: skip
    if not (geometric or deviation_m > _LOOSE_M):
        return None
    where = "on one line or in one spot of the image" if small else "in one plane"
    return PoseExplanation(
        cause=Cause.PLANE,
        confidence=0.85 if geometric else 0.6,
        sentence=(
            f"{share:.0%} of the matches that agree lie {where} ({1000 * thickness_m:.0f} mm thick, "
            f"{spread_px:.0f} px wide, depth varies by {variation:.0%}): such points hold the position "
            + (f"only to {1000 * deviation_m:.0f} mm" if math.isfinite(deviation_m) else "not at all")
            + (f", and the solver called the pose {weakness}" if weakness else "")
        ),
        evidence={
            "planar_share": share, "thickness_m": thickness_m, "spread_px": spread_px,
            "width_to_length": thinness, "depth_variation": variation,
            "position_deviation_m": deviation_m if math.isfinite(deviation_m) else -1.0,
        },
    )  # fmt: skip


def line(matches: Matches, base: Fit | None) -> PoseExplanation | None:
    """Return the explanation where all points, or all pixels, lie on one line or coincide."""
    if base is not None and not is_chance(len(matches), base.count, matches.tight_px, matches.camera):
        return None
    thinness = min(width_to_length(matches.points), width_to_length(matches.pixels))
    if thinness > _THIN:
        return None
    return PoseExplanation(
        cause=Cause.PLANE,
        confidence=0.85,
        sentence=(
            f"the points or pixels of all {len(matches)} matches lie on one line or in one spot (width over "
            f"length {thinness:.3f}): no pose follows from them"
        ),
        evidence={"width_to_length": thinness, "matches": float(len(matches))},
    )


def _planar_share(points: Array, depths_m: Array) -> tuple[float, float]:
    """Return which share lies within depth noise of the best plane, and the median distance from it."""
    noise_m = 3.0 * (0.0025 + 0.0019 * np.maximum(0.0, depths_m - 0.4) ** 2) + 0.004
    is_inside = np.ones(len(points), dtype=np.bool_)
    distance = np.zeros(len(points))
    for _ in range(4):
        if np.count_nonzero(is_inside) < 4:
            break
        centre = points[is_inside].mean(axis=0)
        _, axes = np.linalg.eigh(np.cov((points[is_inside] - centre).T))
        distance = np.abs((points - centre) @ axes[:, 0])
        is_inside = distance <= np.maximum(noise_m, np.quantile(distance, 0.8))
    return float(np.mean(distance <= noise_m)), float(np.median(distance))


def stale_map(matches: Matches, base: Fit) -> tuple[PoseExplanation, int] | None:
    """Return the explanation where a second group of points fits a pose of its own, and all that fit one."""
    rest = matches.of(~base.agrees)
    if base.count < _LEAST or len(rest) < _LEAST:
        return None
    second = fit_pose(rest, iterations=1000, polish=True)
    least = max(_LEAST, 0.3 * len(rest), 0.08 * len(matches))
    if second is None or second.count < least:
        return None
    if is_chance(len(rest), second.count, matches.tight_px, matches.camera):
        return None
    metres, degrees = pose_difference(second.T_camera_world, base.T_camera_world)
    first = matches.points[base.agrees]
    moved_points = rest.points[second.agrees]
    shift_m = _median_shift(moved_points, base.T_camera_world, second.T_camera_world)
    apart = _apart(first, moved_points)
    small_group = second.count < _LARGE_GROUP * len(matches)
    if shift_m < (_LEAST_SHIFT_M if small_group else _NOISE_SHIFT_M):
        return None
    share = second.count / (second.count + base.count)
    explanation = PoseExplanation(
        cause=Cause.STALE_MAP,
        confidence=min(0.93, 0.6 + 0.25 * second.count / len(rest) + 0.2 * max(0.0, apart - 0.5)),
        sentence=(
            f"the matches fall into two groups that each fit one pose: {base.count} and {second.count} of "
            f"{len(matches)}, {100 * shift_m:.0f} cm apart: a part of the mapped world has moved"
        ),
        evidence={
            "first_group": float(base.count), "second_group": float(second.count), "moved_m": shift_m,
            "poses_apart_m": metres, "poses_apart_deg": degrees, "second_share": share, "separation": apart,
        },
    )  # fmt: skip
    return explanation, base.count + second.count


def _median_shift(points: Array, first: Array, second: Array) -> float:
    """Return how far the group is displaced between the two poses, in the camera's frame, at the median."""
    return float(np.median(np.linalg.norm(transform(first, points) - transform(second, points), axis=1)))


def _apart(first: Array, second: Array) -> float:
    """Return the share of points whose nearest neighbour is of their own group: 0.5 if they are mixed."""
    points = np.vstack([first, second])
    group = np.arange(len(points)) >= len(first)
    if len(points) > 800:
        chosen = np.linspace(0, len(points) - 1, 800).astype(np.intp)
        points, group = points[chosen], group[chosen]
    squares = (points**2).sum(axis=1)
    distance = squares[:, None] + squares - 2.0 * points @ points.T
    np.fill_diagonal(distance, np.inf)
    same = group[distance.argmin(axis=1)] == group
    return float((same[group].mean() + same[~group].mean()) / 2.0) if group.any() and not group.all() else 1.0


def outliers(matches: Matches, base: Fit | None) -> PoseExplanation | None:
    """Return the explanation where most matches agree with no common pose."""
    n, count = len(matches), 0 if base is None else base.count
    share = 1.0 - count / n
    if share < _RIGHT_SHARE:
        return None
    chance = is_chance(n, count, matches.tight_px, matches.camera)
    errors = np.array([math.inf]) if base is None else base.errors_px[~base.agrees]
    median_px = float(np.median(errors))
    return PoseExplanation(
        cause=Cause.OUTLIERS,
        confidence=0.35 if chance else 0.4 + 0.4 * share,
        sentence=(
            f"{n - count} of {n} matches ({share:.0%}) agree with no common pose"
            + (", and the rest may do so by chance" if chance else f": {count} do, which is not chance")
        ),
        evidence={
            "outlier_share": share, "inliers": float(count), "matches": float(n),
            "outlier_median_px": median_px if math.isfinite(median_px) else -1.0,
        },
    )  # fmt: skip
