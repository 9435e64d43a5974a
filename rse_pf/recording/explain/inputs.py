"""What was recorded, made safe to compute with: a case may come from a stranger and hold any number.

Nothing is refused here: what cannot be used counts as not recorded.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array, rigid
from rse_pf.pnp import PnpOptions
from rse_pf.recording.explain.causes import MatchesLike, PastCommand, ReplyLike, Timing
from rse_pf.recording.explain.fitting import Matches

__all__ = ["check_history", "check_matches", "check_pose", "check_reply", "check_timing"]

_TIGHT_PX = 3.0
_USUAL_WIDTH_PX = 640.0
_MAX_ROWS, _BLOCK_ROWS = 1000, 100
_MAX_ABS = 1e6
_MAX_HISTORY = 20
_MAX_S = 1e11
_LONGEST_S = 1e5


def check_matches(matches: MatchesLike) -> tuple[Matches, PnpOptions]:
    """Return the finite rows, a thousand of them at most, and the options."""
    points = _rows(matches.points_world, 3)
    pixels = _rows(matches.pixels, 2)
    n = min(len(points), len(pixels))
    points, pixels = points[:n], pixels[:n]
    depths = _depths(matches.depths_m, n)
    options = matches.options or PnpOptions()
    finite = (np.abs(points) <= _MAX_ABS).all(axis=1) & (np.abs(pixels) <= _MAX_ABS).all(axis=1)
    keep = _some(np.flatnonzero(finite))
    scale = max(1.0, matches.camera.width / _USUAL_WIDTH_PX)
    return Matches(
        points=points[keep], pixels=pixels[keep], camera=matches.camera, inlier_px=options.inlier_px,
        tight_px=min(options.inlier_px, _TIGHT_PX * scale), depths_m=None if depths is None else depths[keep],
        left_out=n - int(np.count_nonzero(finite)),
    ), options  # fmt: skip


def _some(rows: npt.NDArray[np.intp]) -> npt.NDArray[np.intp]:
    """Return a thousand of *rows*: blocks of neighbours, since the order of rows may be what is wrong."""
    if len(rows) <= _MAX_ROWS:
        return rows
    starts = np.linspace(0, len(rows) - _BLOCK_ROWS, _MAX_ROWS // _BLOCK_ROWS).astype(np.intp)
    chosen: npt.NDArray[np.intp] = rows[(starts[:, None] + np.arange(_BLOCK_ROWS)).ravel()]
    return chosen


def _rows(numbers: Any, columns: int) -> Array:
    flat = np.asarray(numbers, dtype=np.float64).ravel()
    return flat[: len(flat) // columns * columns].reshape(-1, columns)


def _depths(depths_m: Any, n: int) -> Array | None:
    if not isinstance(depths_m, np.ndarray) or depths_m.size != n:
        return None
    depths = np.asarray(depths_m, dtype=np.float64).ravel()
    known: Array = np.where((depths > 0.0) & (depths <= _MAX_ABS), depths, 0.0)
    return known


def check_pose(pose: Any) -> Array | None:
    """Return a ``(4, 4)`` rigid pose, None if *pose* is none."""
    if pose is None:
        return None
    T = np.asarray(pose, dtype=np.float64)
    return rigid(T.reshape(4, 4), _MAX_ABS) if T.size == 16 else None


def check_reply(reply: ReplyLike | None) -> ReplyLike | None:
    """Return *reply*, None where its pose is no pose or its error no number."""
    if reply is None or check_pose(reply.T_camera_world) is None:
        return None
    return reply if 0.0 <= reply.rmse_px <= _MAX_ABS else None


def check_history(history: Sequence[PastCommand] | None) -> tuple[PastCommand, ...]:
    """Return the last commands, each without what is no pose."""
    return tuple(
        replace(
            past,
            T_camera_world=check_pose(past.T_camera_world),
            T_odom_camera=check_pose(past.T_odom_camera),
        )
        for past in (history or ())[-_MAX_HISTORY:]
    )


def check_timing(timing: Timing | None) -> Timing | None:
    """Return *timing* without what is no time."""
    if timing is None:
        return None
    longest = {"deadline_s": _LONGEST_S, "period_s": _LONGEST_S}
    changed: dict[str, float | None] = {}
    for name in ("frame_s", "sent_s", "answered_s", "received_s", "replied_s", "deadline_s", "period_s"):
        value: float | None = getattr(timing, name)
        low, high = (1e-3, longest[name]) if name in longest else (-_MAX_S, _MAX_S)
        if value is not None and not (math.isfinite(value) and low <= value <= high):
            changed[name] = None
    return replace(timing, **changed)
