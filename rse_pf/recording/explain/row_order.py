"""Points and pixels out of step: the same sets, but not row by row."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array, Camera, transform
from rse_pf.recording.explain.causes import Cause, PoseExplanation
from rse_pf.recording.explain.fitting import Fit, Mask, Matches, fit_of, fit_pose, is_chance

__all__ = ["row_order"]

_SHIFTS = (1, -1, 2, -2, 3, -3)
_LEAST, _LEAST_SHARE, _CLEAR_SHARE = 12, 0.35, 0.6
_WINDOWS_PX = (40.0, 20.0, 10.0)
_BIN_PX = 12.0
_VOTERS = 100
Rows = npt.NDArray[np.intp]


def row_order(
    matches: Matches, base: Fit | None, priors: Sequence[Array]
) -> tuple[PoseExplanation, int] | None:
    """Return the explanation where points find their pixels in other rows, and how many do so in all.

    Args:
        matches: Distinct rows in their order.
        base: Their best pose as they are.
        priors: Poses that the camera may have, by its past.
    """
    count = 0 if base is None else base.count
    best: tuple[float, Fit, str] | None = None
    for fit, how in _candidates(matches, base, priors):
        explained = _count_elsewhere(matches, fit)
        if best is None or explained > best[0]:
            best = (explained, fit, how)
        if explained > max(_LEAST, _CLEAR_SHARE * np.count_nonzero(~fit.agrees)):
            break
    if best is None:
        return None
    explained, fit, how = best
    own = int(np.count_nonzero(fit.agrees))
    strays = len(matches) - own
    expected = _by_chance(matches, strays)
    if (
        explained < _LEAST
        or explained < _LEAST_SHARE * strays
        or explained < 3.0 * expected
        or own + explained < 1.3 * count
    ):
        return None
    if is_chance(len(matches), int(own + explained - expected), matches.tight_px, matches.camera):
        return None
    shift, with_shift = _shift_of(matches, fit)
    steady = with_shift > 0.5 * explained
    text = f", most of them {abs(shift)} row(s) {'later' if shift > 0 else 'earlier'}" if steady else ""
    return PoseExplanation(
        cause=Cause.ROW_ORDER,
        confidence=min(0.96, 0.72 + 0.25 * explained / max(1, strays)),
        sentence=(
            f"{explained:.0f} of {strays} points that miss their pixel find one in another row{text}: "
            f"points and pixels are out of step ({how})"
        ),
        evidence={
            "found_elsewhere": float(explained), "by_chance": expected, "agree_in_their_row": float(own),
            "row_shift": float(shift) if steady else 0.0,
        },
    ), int(own + explained)  # fmt: skip


def _candidates(matches: Matches, base: Fit | None, priors: Sequence[Array]) -> Iterator[tuple[Fit, str]]:
    """Yield poses under which the sets may agree, each with how it was found, cheap ones first."""
    n = len(matches)
    if base is not None and not is_chance(n, base.count, matches.tight_px, matches.camera):
        yield base, "the other rows give the pose"
    rows = np.arange(n)
    orders = [(np.roll(rows, -shift), f"shifted by {shift}") for shift in _SHIFTS]
    orders.append((rows[::-1], "in reverse order"))
    for order, how in orders:
        fit = fit_pose(_reorder(matches, order), iterations=150)
        if fit is not None and not is_chance(n, fit.count, matches.tight_px, matches.camera):
            yield fit_of(fit.T_camera_world, matches), how
    for prior in priors:
        fit = _align_sets(matches, prior)
        if fit is not None:
            yield fit, "the robot's past gives the pose"


def _reorder(matches: Matches, order: Rows) -> Matches:
    other = matches.of(np.arange(len(matches)))
    return Matches(
        points=other.points, pixels=matches.pixels[order], camera=matches.camera,
        inlier_px=matches.inlier_px, tight_px=matches.tight_px, depths_m=None, left_out=0,
    )  # fmt: skip


def _project(T_camera_world: Array, points: Array, camera: Camera) -> tuple[Array, Mask]:
    seen = transform(T_camera_world, points)
    front = seen[:, 2] > 0.05
    seen[~front, 2] = 1.0
    return camera.project(seen), front


def _count_elsewhere(matches: Matches, fit: Fit) -> float:
    """Return how many points that miss their own pixel have another stray pixel, each pixel used once."""
    strays = np.flatnonzero(~fit.agrees)
    if not len(strays):
        return 0.0
    projected, front = _project(fit.T_camera_world, matches.points[strays], matches.camera)
    nearest, distance = _nearest(projected, matches.pixels[strays])
    hits = front & (distance <= matches.tight_px)
    return float(len(np.unique(nearest[hits])))


def _nearest(first: Array, second: Array) -> tuple[Rows, Array]:
    """Return for each row of *first* the nearest row of *second* and its distance."""
    squares = (first**2).sum(axis=1)[:, None] + (second**2).sum(axis=1) - 2.0 * first @ second.T
    nearest = squares.argmin(axis=1)
    return nearest, np.sqrt(np.maximum(squares[np.arange(len(first)), nearest], 0.0))


def _by_chance(matches: Matches, strays: int) -> float:
    """Return how many points find a pixel by chance, if pixels lie as densely as these do."""
    spread = matches.pixels.std(axis=0)
    area = float(np.clip(12.0 * np.prod(np.maximum(spread, 1.0)), 1.0, None))
    return strays * min(1.0, strays * np.pi * matches.tight_px**2 / area)


def _shift_of(matches: Matches, fit: Fit) -> tuple[int, int]:
    """Return the most common distance in rows between a point and its pixel, and how often it occurs."""
    strays = np.flatnonzero(~fit.agrees)
    projected, front = _project(fit.T_camera_world, matches.points[strays], matches.camera)
    nearest, distance = _nearest(projected, matches.pixels[strays])
    hits = front & (distance <= matches.tight_px)
    if not hits.any():
        return 0, 0
    values, counts = np.unique(strays[nearest[hits]] - strays[hits], return_counts=True)
    most = int(counts.argmax())
    return int(values[most]), int(counts[most])


def _align_sets(matches: Matches, prior: Array) -> Fit | None:
    """Return the pose that brings all points onto pixels, whatever their rows, starting near *prior*."""
    camera = matches.camera
    projected, front = _project(prior, matches.points, camera)
    inside = (
        front
        & (np.abs(projected[:, 0] - camera.cx) < camera.width)
        & (np.abs(projected[:, 1] - camera.cy) < camera.height)
    )
    if np.count_nonzero(inside) < _LEAST:
        return None
    offset = _most_common_offset(projected[inside], matches.pixels)
    # A turn of the camera moves all pixels nearly alike: find it by votes first.
    moved = projected + offset
    points = matches.points
    fit: Fit | None = None
    for window_px in _WINDOWS_PX:
        nearest, distance = _nearest(moved, matches.pixels)
        back, _ = _nearest(matches.pixels, moved)
        mutual = front & (distance < window_px) & (back[nearest] == np.arange(len(moved)))
        rows = np.flatnonzero(mutual)
        if len(rows) < _LEAST:
            return None
        paired = Matches(
            points=points[rows], pixels=matches.pixels[nearest[rows]], camera=camera,
            inlier_px=matches.inlier_px, tight_px=max(matches.tight_px, window_px / 4.0), depths_m=None,
            left_out=0,
        )  # fmt: skip
        fit_of_pairs = fit_pose(paired, polish=window_px < 15.0)
        if fit_of_pairs is None:
            return None
        fit = fit_of(fit_of_pairs.T_camera_world, matches)
        moved, front = _project(fit_of_pairs.T_camera_world, points, camera)
    return fit


def _most_common_offset(first: Array, second: Array) -> Array:
    """Return the offset (pixels) from *first* to *second* that most pairs share."""
    some = first[:: max(1, len(first) // _VOTERS)]
    differences = (second[None] - some[:, None]).reshape(-1, 2)
    near = np.abs(differences).max(axis=1) < 160.0
    cells = np.floor(differences[near] / _BIN_PX).astype(np.int64) + 20
    if not len(cells):
        return np.zeros(2)
    votes = np.bincount(cells[:, 0] * 64 + cells[:, 1], minlength=64 * 64).reshape(64, 64).astype(np.float64)
    blurred = votes + np.roll(votes, 1, 0) + np.roll(votes, 1, 1) + np.roll(np.roll(votes, 1, 0), 1, 1)
    u, v = np.unravel_index(int(blurred.argmax()), blurred.shape)
    offset: Array = (np.array([u, v], dtype=np.float64) - 20.0) * _BIN_PX
    return offset
