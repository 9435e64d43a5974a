"""Pose queries of a tracker: made of matches, answered elsewhere, one open at a time.

The steps of a frame are a generator that yields queries and is sent their answers.  The trackers decide what
is asked, and what follows from an answer.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from client_sdk.frontend import Correspondences, Frame, PoseQuery, TrackedFrame
from client_sdk.tracking.landmark_matching import Matches
from rse_pf.errors import UsageError
from rse_pf.geometry import Array, inverse, rigid, transform
from rse_pf.pnp import DepthNoise
from rse_pf.slam.tracking import Features

__all__ = ["CLEAR_INLIERS", "FrameSteps", "OpenQuery", "QueryAnswer", "make_query", "round_for_wire"]

CLEAR_INLIERS = 40
"""Fewest inliers of an answer that is accepted without further evidence, at a place that the camera did not
see just before."""
_CLEAR_RATIO = 0.5
"""Smallest share of inliers among the matches of an answer that is accepted without further evidence, at a
place that the camera did not see just before: perceptual aliases have fewer."""
_MIN_REFERENCE_DEPTH_M = 0.01
"""Depths are sent only if all points lie more than this, in metres, before the reference camera."""


@dataclass(frozen=True, slots=True)
class QueryAnswer:
    """The answer to a pose query.

    Attributes:
        T_camera_world: ``(4, 4)``, maps the world of the query, in which its points are, to the camera; None
            if there is no pose.
        inliers: Number of correspondences that agree with the pose.
        is_weak: Whether the solver calls the evidence for the pose weak.
        is_missing: Whether nobody has answered, so that it is not known whether there is a pose.
    """

    T_camera_world: Array | None
    inliers: int
    is_weak: bool
    is_missing: bool = False

    def accepted_pose(self, min_inliers: float) -> Array | None:
        """Return the pose as a rigid motion; None if it is none, or fewer than *min_inliers* agree."""
        if self.T_camera_world is None or self.inliers < min_inliers:
            return None
        return rigid(self.T_camera_world)

    def is_clear(self, match_count: int) -> bool:
        """Return whether the answer alone proves a place.

        At least 40 matches, and at least half of its *match_count* matches, must be inliers.
        """
        return not self.is_weak and self.inliers >= max(CLEAR_INLIERS, _CLEAR_RATIO * match_count)


FrameSteps = Generator[PoseQuery, QueryAnswer, TrackedFrame]


def make_query(
    frame: Frame,
    matches: Matches,
    image: Features,
    *,
    inlier_px: float,
    max_iterations: int,
    max_matches: int,
    against: Literal["map", "frame", "keyframe", "segment"],
    T_world_reference: Array | None = None,
    depth_noise: DepthNoise | None = None,
) -> PoseQuery:
    """Make the query for the pose of a frame from its matches.

    Args:
        frame: The frame whose pose is asked for.
        matches: Landmarks that the frame shows.
        image: Features of the frame.  A depth that is missing is sent as 0, and so are all depths if a point
            does not lie before the reference camera.
        inlier_px: Largest reprojection error of an inlier, in pixels.
        max_iterations: Largest number of RANSAC iterations.
        max_matches: Largest number of matches that are sent; an even sample is taken of more.
        against: The source of the landmarks, see `PoseQuery`.
        T_world_reference: ``(4, 4)``, pose of the reference camera, in whose frame points are sent: the
            predicted camera, the last one, or that of a keyframe.  None sends points in the frame of the map.
        depth_noise: Noise model of the depths; None for a Kinect's.
    """
    rows = np.arange(len(matches))
    if len(rows) > max_matches:
        rows = np.linspace(0, len(rows) - 1, max_matches).astype(np.int64)
    # From left to right: neighbours share digits, so that the message compresses better.
    rows = rows[np.argsort(image.pixels[matches.features[rows], 0], kind="stable")]
    features, points = matches.features[rows], matches.points[rows]
    if T_world_reference is not None:
        points = transform(inverse(T_world_reference), points)
    points, pixels = round_for_wire(points, image.pixels[features])
    sent_depths_m = np.zeros(len(points))
    # With depths, the solver also uses the depth of each point in the frame of the reference camera, which
    # must be above 0.
    if not (len(points) and points[:, 2].min() <= _MIN_REFERENCE_DEPTH_M):
        depths_m = image.points_camera[features, 2]
        sent_depths_m = np.nan_to_num(depths_m, posinf=0.0, neginf=0.0).round(3)
    return PoseQuery(
        timestamp_s=frame.timestamp_s,
        correspondences=Correspondences(points_world=points, pixels=pixels, depths_m=sent_depths_m),
        camera=frame.camera,
        inlier_px=inlier_px,
        max_iterations=max_iterations,
        against=against,
        depth_noise=depth_noise,
    )


def round_for_wire(points_world: Array, pixels: Array) -> tuple[Array, Array]:
    """Round points to 0.0001 (0.1 mm) and pixels to 0.01 px.

    A server and the solver on the robot then get the same numbers.  The rounding moves a pose by about 0.02
    mm and shrinks the message to a third.
    """
    return np.round(points_world, 4), np.round(pixels, 2)


class OpenQuery:
    """The generator of the present frame's steps, and the query whose answer it waits for, if there is
    one."""

    def __init__(self) -> None:
        self._steps: FrameSteps | None = None
        self._query: PoseQuery | None = None

    def refuse_open(self) -> None:
        """Raise UsageError if a query waits for its answer."""
        if self._query is not None:
            raise UsageError(
                f"the query of frame {self._query.timestamp_s:.3f} s is open",
                hint="call accept with its answer, or with None",
            )

    def begin(self, steps: FrameSteps) -> PoseQuery | TrackedFrame:
        """Run the steps of a frame up to the first query, which is returned; or return the frame's result."""
        self._steps = steps
        return self._advance(None)

    def answer(self, query: PoseQuery, answer: QueryAnswer) -> PoseQuery | TrackedFrame:
        """Run the steps with the answer to *query* up to the next query or the frame's result.

        Raises:
            UsageError: *query* is not the one that waits.
        """
        if query is not self._query:
            raise UsageError("this query is not the open one", hint="answer each query once, in order")
        self._query = None
        return self._advance(answer)

    def _advance(self, answer: QueryAnswer | None) -> PoseQuery | TrackedFrame:
        assert self._steps is not None
        try:
            self._query = next(self._steps) if answer is None else self._steps.send(answer)
        except StopIteration as end:
            self._steps = None
            result: TrackedFrame = end.value
            return result
        return self._query
