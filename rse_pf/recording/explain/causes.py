"""What may be wrong with a pose, and the values that go into and come out of an explanation.

Nothing is decided here.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy.typing as npt

from rse_pf.geometry import Array, Camera
from rse_pf.pnp import PnpOptions

__all__ = ["Cause", "MatchesLike", "PastCommand", "PoseExplanation", "ReplyLike", "Timing"]


class Cause(str, enum.Enum):
    """Why a pose is bad; `NONE` means that nothing is wrong, `UNKNOWN` that nothing known explains it."""

    MIRRORED = "mirrored"
    INTRINSICS = "intrinsics"
    ROW_ORDER = "row_order"
    OUTLIERS = "outliers"
    DUPLICATES = "duplicates"
    PLANE = "plane"
    BLUR = "blur"
    DEPTH_SCALE = "depth_scale"
    STALE_MAP = "stale_map"
    LATE = "late"
    UNKNOWN = "unknown"
    NONE = "none"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PoseExplanation:
    """One cause with what speaks for it.

    Attributes:
        cause: What is wrong.
        confidence: 0..1; it orders explanations and is no probability.
        sentence: The finding in words, with its numbers.
        evidence: Those numbers by name, with their unit in it.
        missing: What was not recorded and would have told more.
    """

    cause: Cause
    confidence: float
    sentence: str
    evidence: Mapping[str, float] = field(default_factory=dict)
    missing: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PastCommand:
    """What an earlier command of the same robot gave.

    Attributes:
        sent_s: When it was sent, seconds, on the clock of `Timing.sent_s`.
        T_camera_world: ``(4, 4)``, its pose; None where it failed.
        T_odom_camera: ``(4, 4)``, the robot's own odometry at its frame; None where there is none.
        matches: How many correspondences it had.
        inliers: How many of them agreed.
        thumbnail: A small picture of its frame, JPEG or PNG; None where the robot allows none.
    """

    sent_s: float
    T_camera_world: Array | None = None
    T_odom_camera: Array | None = None
    matches: int = 0
    inliers: int = 0
    thumbnail: bytes | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Timing:
    """When a command and its answer were where, in seconds; None where it was not recorded.

    Attributes:
        frame_s: The stamp of the frame, on the robot's clock.
        sent_s: Sending, on the robot's clock.
        answered_s: Arrival of the answer, on the robot's clock.
        received_s: Arrival of the command, on the server's clock.
        replied_s: Sending of the answer, on the server's clock.
        deadline_s: Time that the command allowed for its answer.
        period_s: Time between two frames.
    """

    frame_s: float | None = None
    sent_s: float | None = None
    answered_s: float | None = None
    received_s: float | None = None
    replied_s: float | None = None
    deadline_s: float | None = None
    period_s: float | None = None


class MatchesLike(Protocol):
    """The matches of one command; a ``PnpRequest`` is one."""

    @property
    def points_world(self) -> npt.NDArray[Any]:
        """``(n, 3)`` or ``3n`` metres, world frame."""

    @property
    def pixels(self) -> npt.NDArray[Any]:
        """``(n, 2)`` or ``2n`` pixels."""

    @property
    def camera(self) -> Camera:
        """Intrinsics that the command named."""

    @property
    def options(self) -> PnpOptions | None:
        """Options that the command named."""

    @property
    def depths_m(self) -> Any:
        """``n`` depths at the pixels, or nothing."""


class ReplyLike(Protocol):
    """The answer of one command; a ``PnpReply`` or a `PnpSolution` is one."""

    @property
    def T_camera_world(self) -> npt.NDArray[Any]:
        """``(4, 4)`` or 16 numbers."""

    @property
    def inliers(self) -> npt.NDArray[Any]:
        """Rows that agree."""

    @property
    def rmse_px(self) -> float:
        """Root mean square error of them."""

    @property
    def verdict(self) -> str:
        """``ok`` or ``weak``."""

    @property
    def reason(self) -> str:
        """Why it is weak."""
