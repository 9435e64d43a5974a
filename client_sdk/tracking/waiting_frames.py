"""Keep the frames of a camera without depth that wait for the start of a segment, and find that start."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from client_sdk.monocular.two_view import TwoViewStart, share_in_third_view, start_from_two_views
from client_sdk.tracking.landmark_map import MonocularView
from client_sdk.tracking.monocular_segment import MonocularSegment
from rse_pf.geometry import Array, Camera
from rse_pf.slam.descriptors import match_all

__all__ = ["MIN_START_MATCHES", "Start", "WaitingFrames"]

Rows = npt.NDArray[np.int64]

_MAX_WAITING_FRAMES = 30
"""Largest number of frames that are kept as possible first views of a new segment; then the oldest is
dropped: bounds memory."""
MIN_START_MATCHES = 100
"""Fewest features of a frame, and fewest matches between two frames, with which a segment can begin."""
_MANY_START_MATCHES = 200
"""Number of matches with a waiting view from which newer ones are not tried: they have less parallax.  A
street at 4.8 frames a second has 279 matches with the frame before and 129 with the one before that."""
_MIN_THIRD_VIEW_SHARE = 0.7
"""Smallest share of the points of a start with which a third view must agree: 0.8 to 1.0 where the camera
moves, 0.6 to 0.7 where it nearly only turns and the points are wrong."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Start:
    """Two views that begin a segment.

    Attributes:
        views: Relative pose and points of the two views.
        first: Number of the waiting frame that is the first view; the present frame is the second one.
        rows: Features of the first view that match, to which the rows of *views* refer.
        columns: Features of the second view that match them.
    """

    views: TwoViewStart
    first: int
    rows: Rows
    columns: Rows


class WaitingFrames:
    """Frames without a pose, each of which may become the first view of a new segment; oldest first."""

    def __init__(self, min_parallax_deg: float) -> None:
        """Begin without frames.

        Args:
            min_parallax_deg: Smallest median parallax of two views that begin a segment, see
                `start_from_two_views`.
        """
        self._min_parallax_deg = min_parallax_deg
        self._frames: list[tuple[float, MonocularView]] = []

    def add(self, timestamp_s: float, view: MonocularView) -> None:
        """Let a frame wait."""
        self._frames.append((timestamp_s, view))

    def clear(self) -> None:
        """Drop all frames: they can no longer begin a segment."""
        self._frames = []

    def frame(self, number: int) -> tuple[float, MonocularView]:
        """Return time and image of a waiting frame; the oldest has number 0."""
        return self._frames[number]

    def find_start(self, view: MonocularView, camera: Camera) -> tuple[Start | None, str]:
        """Find a waiting view that begins a segment together with the present one.

        The oldest waiting view is tried first, as its parallax is the largest.  Where it has few matches, as
        after a fast drive forward, the view halfway between it and the present one is tried next, and so on.

        Args:
            view: The present frame.
            camera: Intrinsics of all frames.

        Returns:
            The start, or None and why there is none.
        """
        if len(self._frames) == _MAX_WAITING_FRAMES:
            self._frames.pop(0)
        number, reason = 0, "the first frame"
        while number < len(self._frames):
            first = self._frames[number][1]
            rows, columns = match_all(first.features.descriptors, view.features.descriptors)
            if len(rows) < MIN_START_MATCHES:
                reason = f"only {len(rows)} matches with the frames before"
            else:
                views = start_from_two_views(
                    first.features.pixels[rows],
                    view.features.pixels[columns],
                    camera,
                    min_parallax_deg=self._min_parallax_deg,
                )
                reason = views.reason or self._refute(views, number, rows, camera)
                if not reason:
                    return Start(views=views, first=number, rows=rows, columns=columns), ""
                if views.is_still or len(rows) >= _MANY_START_MATCHES:
                    break
            number += max(1, (len(self._frames) - number) // 2)
        return None, reason

    def _refute(self, views: TwoViewStart, first: int, rows: Rows, camera: Camera) -> str:
        """Say why a third waiting view does not agree with a start; return an empty text if it does.

        The third view is that halfway between the two, or the one before the first if there is none between.

        Args:
            views: Pose and points of the waiting view *first* and the present one.
            first: Number of that waiting view.
            rows: Its features that match, to which the rows of *views* refer.
            camera: Intrinsics of all views.
        """
        between = (first + len(self._frames)) // 2
        number = between if between > first else first - 1
        if number < 0:
            return "a third view has not come yet"
        third = self._frames[number][1].features
        descriptors = self._frames[first][1].features.descriptors[rows]
        shown, columns = match_all(descriptors, third.descriptors)
        share = share_in_third_view(views, shown, third.pixels[columns], camera)
        if share < _MIN_THIRD_VIEW_SHARE:
            return f"a third view agrees with {100 * share:.0f} % of the points only"
        return ""

    def fit_poses(
        self,
        segment: MonocularSegment,
        first: int,
        T_second: Array,
        *,
        search_px: float,
        min_inliers: int,
    ) -> Array | None:
        """Fit the poses of the frames before the second view of a start.

        Frames after the first view are fitted from an interpolated guess, then those before it from a
        constant velocity, until one has no pose.  No frame waits any more afterwards.

        Args:
            segment: The new segment, whose origin is the first view.
            first: Number of the waiting frame that is the first view.
            T_second: ``(4, 4)``, ``T_camera_world`` of the second view.
            search_px: Radius, in pixels, around the predicted pixel of a landmark in which features are
                compared with the landmark.
            min_inliers: Fewest landmarks that must agree with a pose.

        Returns:
            ``T_camera_world`` of the frame just before the second view; None if that frame has no pose.
        """
        waiting, self._frames = self._frames, []
        count = len(waiting)
        pose, newest = np.eye(4), None if first < count - 1 else np.eye(4)
        step = -T_second[:3, 3] / (count - first)
        for number in range(first + 1, count):
            timestamp_s, view = waiting[number]
            guess = pose.copy()
            guess[:3, 3] += (T_second[:3, 3] - pose[:3, 3]) / (count - number + 1)
            posed = segment.fit(view, guess, search_px, min_inliers)
            newest = None
            if posed is not None:
                newest = pose = posed.T_camera_world
                segment.add_frame(timestamp_s, pose, 0)
        pose = np.eye(4)
        for timestamp_s, view in reversed(waiting[:first]):
            guess = pose.copy()
            guess[:3, 3] += step
            posed = segment.fit(view, guess, search_px, min_inliers)
            if posed is None:
                break
            step = posed.T_camera_world[:3, 3] - pose[:3, 3]
            pose = posed.T_camera_world
            segment.add_frame(timestamp_s, pose, 0)
        return newest
