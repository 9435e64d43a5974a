"""Values for the result of a check: faults of a drive, and faults that the drive cannot show."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

from client_sdk.source_facts import Doubt
from rse_pf.errors import UsageError

__all__ = ["CannotTell", "CheckReport", "FaultKind", "Finding", "matters", "order"]

_CERTAIN_SIGMAS = 3.0  # a finding is certain if its value exceeds this many of its standard deviations
_MIN_COST_M = 0.002  # a fault matters only if it bends the path by more than this, in metres
# A fault matters only if it bends the path by more than this many times the uncertainty of the path.
_MIN_COST_NOISES = 1.2


class FaultKind(str, Enum):
    """Kinds of faults of a drive, as reports name them.

    The kind determines the meaning of `Finding.value`:

    - ``focal_length``, ``depth_scale``, ``baseline``: relative error of the setting
    - ``principal_point``: error of cx or cy, whichever is larger in its standard deviations, px
    - ``distortion``: coefficient ``k1`` of the distortion that the images still have
    - ``depth_offset``: metres by which depths are too large
    - ``depth_delay``: seconds by which the depth of a frame is older than its colour image
    - ``stamp_delay``: seconds by which the stamps of the images are later than those of odometry, ground
      truth or IMU
    - ``disparity_offset``: pixels by which disparities are too small
    - ``blur``, ``dark``, ``repeated``, ``missing``: share of the frames, 0..1
    - ``jitter``: standard deviation of the interval between frames, relative to the interval
    - ``two_cameras``, ``moving_focal_length``: relative difference of the focal lengths
    - ``mirrored``, ``swapped_axes``: 1, since these faults have no size
    - ``swapped_cameras``, and a ``baseline`` or ``stamp_delay`` that was found by comparing the two images of
      stereo pairs: the value of `client_sdk.rigs.stereo_pair_checks.PairFault`
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


_DOMINANT_KINDS = (
    FaultKind.SWAPPED_CAMERAS, FaultKind.MIRRORED, FaultKind.SWAPPED_AXES, FaultKind.TWO_CAMERAS,
)  # fmt: skip
"""Faults that are listed first: while a drive has one of them, other findings may be its consequences."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """One fault of a drive.

    Attributes:
        kind: Kind of the fault.
        value: Size of the fault in *unit*, see `FaultKind`.  For a relative error, +0.1 means that a setting
            is 10 % too large, and 4.0 that it is five times what it should be.
        deviation: Standard deviation of *value*, in *unit*; 0 if the value was counted exactly.
        unit: ``relative``, ``share``, ``px``, ``m``, ``s`` or empty.
        cost_m: How far the fault bends the trajectory, metres; None if unknown.
        sentence: What is wrong and by how much, with the deviation.
        fix: What the user should do.
        correction: Keys of ``intrinsics.json`` with their correct numbers; empty if that file does not cause
            the fault.

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
        """Whether the absolute value exceeds three standard deviations."""
        return abs(self.value) > _CERTAIN_SIGMAS * self.deviation

    def to_dict(self) -> dict[str, Any]:
        """Return the finding as an object for a JSON report; its ``cost`` is in metres, None if unknown."""
        return {
            "kind": self.kind.value, "value": self.value, "deviation": self.deviation, "unit": self.unit,
            "cost": self.cost_m, "sentence": self.sentence, "fix": self.fix,
            "correction": dict(self.correction),
        }  # fmt: skip


@dataclass(frozen=True, slots=True)
class CannotTell:
    """A fault that a drive may have although the check cannot find it in this drive.

    Attributes:
        kind: The kind of the fault.
        reason: What the drive lacks to determine the fault, such as "no turn about the vertical axis: focal
            length within 6 %".
        within: Bound of the absolute error that the drive does determine, in the unit of a finding of that
            kind; None if there is no bound.
    """

    kind: FaultKind
    reason: str
    within: float | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return the fault and the reason as an object for a JSON report."""
        return {"kind": self.kind.value, "reason": self.reason, "within": self.within}


@dataclass(frozen=True, slots=True, kw_only=True)
class CheckReport:
    """The result of checking a drive.

    Attributes:
        findings: Faults of the drive, worst first, see `order`.
        cannot_tell: Faults that the drive cannot show.
        frames: Number of frames that were checked.
        poses: Number of frames with a pose; None if unknown.
        notes: Sentences on what was not checked, and why.
        doubts: Unlikely facts about the source that the user has not accepted.  If there is one, the
            calibration was not checked, and there are no findings.
    """

    findings: tuple[Finding, ...] = ()
    cannot_tell: tuple[CannotTell, ...] = ()
    frames: int = 0
    poses: int | None = None
    notes: tuple[str, ...] = ()
    doubts: tuple[Doubt, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return the result as an object for ``report.json``; the doubts are its ``source``."""
        return {
            "frames": self.frames,
            "poses": self.poses,
            "findings": [each.to_dict() for each in self.findings],
            "cannot_tell": [each.to_dict() for each in self.cannot_tell],
            "notes": list(self.notes),
            "source": [each.to_dict() for each in self.doubts],
        }


def matters(cost_m: float, noise_m: float) -> bool:
    """Return whether a fault bends a path by more than 2 mm and more than 1.2 times the path's uncertainty.

    Args:
        cost_m: How far the fault moves the positions of the path after alignment, root mean square, metres.
        noise_m: Uncertainty of the positions of the path, root mean square, metres.
    """
    return cost_m > max(_MIN_COST_M, _MIN_COST_NOISES * noise_m)


def order(findings: Iterable[Finding], noise_m: float = 0.0) -> tuple[Finding, ...]:
    """Return the findings that are certain and matter, worst first, one of each kind.

    A finding whose cost is known and at most *noise_m* is left out.  Faults whose consequences may appear as
    other faults come first, then those with the largest cost, then those of unknown cost.  Of two findings of
    one kind the one with the smaller relative deviation is kept.

    Args:
        findings: Findings in any order.
        noise_m: Uncertainty of the trajectory, root mean square, metres.
    """
    kept: dict[FaultKind, Finding] = {}
    for each in findings:
        matters = each.cost_m is None or each.cost_m > noise_m
        other = kept.get(each.kind)
        if (
            each.is_certain
            and matters
            and (other is None or _relative_deviation(each) < _relative_deviation(other))
        ):
            kept[each.kind] = each
    return tuple(sorted(kept.values(), key=_sort_key))


def _relative_deviation(finding: Finding) -> float:
    return finding.deviation / max(abs(finding.value), 1e-12)


def _sort_key(finding: Finding) -> tuple[int, float, float]:
    rank = _DOMINANT_KINDS.index(finding.kind) if finding.kind in _DOMINANT_KINDS else len(_DOMINANT_KINDS)
    return rank, -(finding.cost_m or 0.0), _relative_deviation(finding)
