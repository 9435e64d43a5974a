"""What is wrong with a drive, worst first, and what the drive cannot tell."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

from client_sdk.source_facts import Doubt
from rse_pf.errors import UsageError

__all__ = ["CannotTell", "CheckReport", "FaultKind", "Finding", "matters", "order"]

_DEVIATIONS = 3.0
"""A finding is larger than so many of its deviations."""
_LEAST_COST_M, _COST_OF_NOISE = 0.002, 1.2


class FaultKind(str, Enum):
    """What can be wrong with a drive, and what the value of a finding of that kind is.

    Of ``focal_length``, ``depth_scale`` and ``baseline`` the relative error of the setting; of
    ``principal_point`` its error, px, the larger of both.  ``distortion`` is the ``k1`` that the images still
    have.  ``depth_offset`` says by how many metres depths are too large; ``depth_delay`` by how many seconds
    the depth of a frame is older than its colours; ``stamp_delay`` by how many seconds the stamps of images
    are later than those of odometry, truth or IMU; ``disparity_offset`` by how many pixels disparities are
    too small.  ``blur``, ``dark``, ``repeated`` and ``missing`` are
    shares of the frames; ``jitter`` is the deviation of the interval, relative.  ``two_cameras`` and
    ``moving_focal_length`` are by how much focal lengths differ, relative.  Others are 1.
    """

    FOCAL_LENGTH = "focal_length"
    PRINCIPAL_POINT = "principal_point"
    DISTORTION = "distortion"
    DEPTH_SCALE = "depth_scale"
    DEPTH_OFFSET = "depth_offset"
    DEPTH_DELAY = "depth_delay"
    STAMP_DELAY = "stamp_delay"
    BLUR = "blur"
    DARK = "dark"
    REPEATED = "repeated"
    MISSING = "missing"
    JITTER = "jitter"
    MIRRORED = "mirrored"
    SWAPPED_AXES = "swapped_axes"
    SWAPPED_CAMERAS = "swapped_cameras"
    BASELINE = "baseline"
    DISPARITY_OFFSET = "disparity_offset"
    TWO_CAMERAS = "two_cameras"
    MOVING_FOCAL_LENGTH = "moving_focal_length"


_FIRST = (
    FaultKind.SWAPPED_CAMERAS, FaultKind.MIRRORED, FaultKind.SWAPPED_AXES, FaultKind.TWO_CAMERAS,
)  # fmt: skip
"""While one of these is there, what else is measured describes it, and not a fault of its own."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """One fault of a drive.

    Attributes:
        kind: What is wrong.
        value: By how much, in *unit*.  Of a setting it is the relative error: +0.1 means that it is 10 % too
            large, 4.0 that it is five times what it should be.  Of a share it is within 0..1.
        deviation: Standard deviation of *value*, in *unit*; 0 of what is counted.
        unit: ``relative``, ``share``, ``px``, ``m``, ``s`` or empty.
        cost_m: By how much it bends the trajectory, metres; None if unknown.
        sentence: What is wrong, by how much, with the deviation.
        fix: What to do.
        correction: Keys of ``intrinsics.json`` and the numbers that they should have; empty if the fault is
            not in that file.  Distortion is ``k1``, ``k2``, ``p1``, ``p2``, ``k3``.

    Raises:
        UsageError: A number is not finite, or the deviation or the cost is below 0.
    """

    kind: FaultKind
    value: float
    deviation: float
    unit: str
    cost_m: float | None
    sentence: str
    fix: str
    correction: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        cost_m = 0.0 if self.cost_m is None else self.cost_m
        numbers = (self.value, self.deviation, cost_m, *self.correction.values())
        if not all(map(math.isfinite, numbers)) or self.deviation < 0.0 or cost_m < 0.0:
            raise UsageError(
                f"{self.kind.value}: {self.value} +- {self.deviation} at {self.cost_m} m is no finding",
                hint="give finite numbers, and neither deviation nor cost below 0",
            )

    @property
    def is_certain(self) -> bool:
        """Whether it is larger than three of its deviations."""
        return abs(self.value) > _DEVIATIONS * self.deviation

    def to_dict(self) -> dict[str, Any]:
        """Return what a report holds of it; ``cost`` is in metres."""
        return {
            "kind": self.kind.value, "value": self.value, "deviation": self.deviation, "unit": self.unit,
            "cost": self.cost_m, "sentence": self.sentence, "fix": self.fix,
            "correction": dict(self.correction),
        }  # fmt: skip


@dataclass(frozen=True, slots=True)
class CannotTell:
    """A fault that this drive could have without showing it.

    Attributes:
        kind: Of the fault.
        reason: Why, such as "no turn about the vertical axis: focal length within 6 %".
        within: The bound that the drive does give, in the unit of a finding of that kind; None without one.
    """

    kind: FaultKind
    reason: str
    within: float | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return what a report holds of it."""
        return {"kind": self.kind.value, "reason": self.reason, "within": self.within}


@dataclass(frozen=True, slots=True, kw_only=True)
class CheckReport:
    """What a check found in a drive.

    Attributes:
        findings: Worst first, see `order`.
        cannot_tell: What the drive cannot show.
        frames: So many were looked at.
        poses: So many of them got a pose; None if unknown.
        notes: Sentences on what was not looked at, and why.
        doubts: What is unlikely about the source; while there is a doubt, nothing is advised.
    """

    findings: tuple[Finding, ...] = ()
    cannot_tell: tuple[CannotTell, ...] = ()
    frames: int = 0
    poses: int | None = None
    notes: tuple[str, ...] = ()
    doubts: tuple[Doubt, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return what ``report.json`` holds."""
        return {
            "frames": self.frames,
            "poses": self.poses,
            "findings": [each.to_dict() for each in self.findings],
            "cannot_tell": [each.to_dict() for each in self.cannot_tell],
            "notes": list(self.notes),
            "source": [each.to_dict() for each in self.doubts],
        }


def matters(cost_m: float, noise_m: float) -> bool:
    """Say whether a fault bends a path by more than the path is known: by its noise, and by 2 mm."""
    return cost_m > max(_LEAST_COST_M, _COST_OF_NOISE * noise_m)


def order(findings: Iterable[Finding], noise_m: float = 0.0) -> tuple[Finding, ...]:
    """Return the findings that are certain and matter, worst first, one of each kind.

    A finding whose cost is known to be below the noise of the drive does not matter.  Faults that change what
    all others mean come first, then those that cost most, then those of unknown cost.  Of two findings of one
    kind the one that is known better is kept.

    Args:
        findings: In any order.
        noise_m: How well this drive tells its trajectory, metres.
    """
    kept: dict[FaultKind, Finding] = {}
    for each in findings:
        matters = each.cost_m is None or each.cost_m > noise_m
        other = kept.get(each.kind)
        if each.is_certain and matters and (other is None or _doubt(each) < _doubt(other)):
            kept[each.kind] = each
    return tuple(sorted(kept.values(), key=_place))


def _doubt(finding: Finding) -> float:
    return finding.deviation / max(abs(finding.value), 1e-12)


def _place(finding: Finding) -> tuple[int, float, float]:
    rank = _FIRST.index(finding.kind) if finding.kind in _FIRST else len(_FIRST)
    return rank, -(finding.cost_m or 0.0), _doubt(finding)
