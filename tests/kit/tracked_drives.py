"""Frames through a tracker, whose queries are answered at once."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from client_sdk.frontend import Frame, PoseQuery, TrackedFrame
from client_sdk.tracking.monocular_tracker import MonocularTracker
from client_sdk.tracking.tracker import Tracker
from rse_pf.errors import PnpError
from rse_pf.geometry import Array
from tests.kit.fake_live_map import solved

__all__ = ["NO_ANSWER", "Answer", "run", "run_all", "solve"]

Answer = tuple[Array | None, int]
NO_ANSWER: Answer = (None, 0)


def solve(query: PoseQuery) -> Answer:
    """Return the pose and how many inliers it has."""
    try:
        solution = solved(query)
    except PnpError:
        return NO_ANSWER
    return solution.T_camera_world, len(solution.inliers)


def run(
    tracker: Tracker | MonocularTracker, shown: Frame, answer: Callable[[PoseQuery], Answer] = solve
) -> TrackedFrame:
    """Return what the tracker makes of one frame."""
    step = tracker.prepare(shown)
    while isinstance(step, PoseQuery):
        step = tracker.accept(step, *answer(step))
    return step


def run_all(tracker: Tracker | MonocularTracker, frames: Iterable[Frame]) -> list[TrackedFrame]:
    """Return what the tracker makes of the frames."""
    return [run(tracker, shown) for shown in frames]
