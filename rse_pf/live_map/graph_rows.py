"""Rows of the tables of a live map's pose graph: keyframes, segments, and loop closures.

These are values without rules.  `MapGraph` in `graph` holds the tables and alone changes their rows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from rse_pf.geometry import Array
from rse_pf.slam.consistency import evidence_weight

__all__ = ["NO_LOOP_CLOSURE_YET", "UP_TO_SCALE", "EdgeState", "LiveKeyframe", "LoopEdge", "Segment"]

EdgeState = Literal["pending", "accepted", "rejected"]
"""State of a loop closure: *pending* ones wait for other loop closures that support them, *accepted* ones are
edges of the pose graph, *rejected* ones were taken out as outliers or as the oldest of too many pending
ones."""

UP_TO_SCALE = "up to scale: no robot with metres has seen what it sees"
NO_LOOP_CLOSURE_YET = "no loop closure between its keyframes and the map is accepted yet"

DEFAULT_COVARIANCE: Array = np.diag([0.02**2] * 3 + [math.radians(0.7) ** 2] * 3)
"""``(6, 6)``: covariance of a segment's alignment until smoothing has computed one, square metres and square
radians: 2 cm along and 0.7 degrees around each axis, the least noise of one measured relative pose."""


@dataclass(slots=True, eq=False)
class LiveKeyframe:
    """A keyframe of one robot in the graph.

    ``segment`` and ``number`` are those of its `KeyframeAdded`; of a keyframe of the version that the map
    started from, -1 and its position in the version.  ``data`` holds the encoded keyframe; it is None after
    its features were dropped or its robot was forgotten.  ``objects`` are the digests of the objects (points,
    image) that the robot stored with it; they stay when the features are dropped, and are empty after the
    robot was forgotten.
    """

    robot: str
    segment: int
    number: int
    timestamp_s: float
    data: bytes | None
    objects: tuple[str, ...] = ()


@dataclass(slots=True, eq=False)
class Segment:
    """The keyframes that one robot made in one odometry frame, by id, oldest first.

    ``robot`` and ``number`` are those of its `KeyframeAdded` events; "" and -1 in the segment that holds the
    keyframes of the version that the map started from.
    """

    robot: str
    number: int
    keyframes: list[int] = field(default_factory=list)
    component: int = 0
    """Lowest row of the segments of the component that this segment belongs to."""
    reported_T_map_odom: Array | None = None
    """``(4, 4)``: the alignment with the map that the robot was last sent, None while it has none."""
    covariance: Array = field(default_factory=lambda: DEFAULT_COVARIANCE.copy())
    """``(6, 6)``: covariance of the reported alignment, of a twist on its left (m^2, rad^2)."""
    reason: str = NO_LOOP_CLOSURE_YET
    """Why the segment has no alignment with the map, empty if it has one; shown to operators and robots."""
    is_from_version: bool = False
    """Whether the keyframes come from the stored version that the map started from."""
    contradictions: int = 0
    """Whether each of the segment's newest 32 recorded keyframes contradicted the map (1) or not (0), as
    bits, the newest one lowest; a keyframe with a wrong metric scale has two bits."""
    is_excluded: bool = False
    """Whether loop closures of the segment are ignored, because it kept contradicting the map."""
    is_metric: bool = True
    """Whether odometry and depths of the segment are in metres; those of a monocular camera are not."""
    scale: float = 1.0
    """Length of the segment's unit in the unit of its component, which is a metre in a metric component."""
    reported_scale: float = 1.0
    """The scale at the last report of the alignment; reports to a robot with metric odometry leave it out."""


@dataclass(slots=True, eq=False)
class LoopEdge:
    """A loop closure: the measured relative pose of keyframes ``a`` and ``b``, of one robot or of two.

    ``a`` is the keyframe that was compared with older ones when it arrived.  ``T_a_b`` ``(4, 4)`` maps points
    of the camera of *b* to that of *a*.  ``information`` ``(6, 6)`` is the inverse covariance of the twist on
    its right, ``variances`` ``(6,)`` are the diagonal of the covariance (squares of lengths, square radians).
    Lengths are metres if *a* or *b* is in a metric segment, else in the unit of the segment of *a*.
    ``scale`` is None between two metric segments; otherwise it holds the logarithm of the length of the unit
    of *b* in the unit of *a*, and the variance of this logarithm.
    ``is_fixed`` marks an edge of the version that the map started from, which is never rejected.
    ``inliers`` of the ``matches`` between both images fit the pose.  ``misfits`` counts the last smoothings
    in a row after which the accepted loop closure did not fit the graph.
    """

    a: int
    b: int
    T_a_b: Array
    information: Array
    inliers: int
    matches: int
    is_fixed: bool = False
    state: EdgeState = "pending"
    misfits: int = 0
    scale: tuple[float, float] | None = None
    variances: Array = field(init=False)

    def __post_init__(self) -> None:
        self.variances = np.diagonal(np.linalg.inv(self.information))

    @property
    def weight(self) -> float:
        """Weight of the evidence, above 0 to 1, by `evidence_weight`; *full weight* is 1.

        A loop closure has full weight with at least 30 inliers that are at least half of its matches; an edge
        of a stored version has it always.
        """
        return 1.0 if self.is_fixed else evidence_weight(self.inliers, self.matches)
