"""List the rules by which the native core refuses a pose or calls it weak, with measured values and limits.

``native/src/solve.hpp`` applies the rules; this module only lists them, for the replay of a recorded pose.
A violated rule either refuses the pose or makes it weak.  The first violated rule that refuses determines the
error, with one exception: where a rule ``no-consensus`` is violated, the error is ``degenerate`` if all 3-D
points or all pixels are collinear, or if the inliers may be copies of each other.  Without a violated rule
that refuses, the reason of a weak pose is ``ambiguous`` if that rule is violated, else the first violated
rule.  The core's test for mirrored points is not listed, because `Evidence` does not hold the number of
inliers of the mirrored points.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np

from rse_pf.pnp.native_solver import MIN_WIDTH_TO_LENGTH, Evidence
from rse_pf.pnp.options import MIN_CORRESPONDENCES, WeakLimits

__all__ = ["Rule", "evaluate_rules"]

# The constants of this block repeat constants of native/src/evidence.hpp and native/src/solve.hpp: change
# them together.

# Largest log10 of the expected number of random poses that fit as well as an accepted pose, 1e-5 poses; a
# pose above it is refused.
_MAX_LOG10_FALSE_ALARMS = -5.0
# Width over length of the inlier pixels (`MIN_WIDTH_TO_LENGTH`) below which a pose is weak, as
# ``nearly-collinear``.
_WEAK_WIDTH_TO_LENGTH = 0.1
# Smallest increase of the sum of squared reprojection errors from a pose to the second pose of a planar
# scene, in units of the pixel variance, with which the pose is accepted: 3 standard deviations, squared.
_EQUAL_FIT = 9.0
# Smallest increase of the sum of squared reprojection errors from a pose to the second pose of a planar
# scene, in units of the pixel variance, with which the pose is ok instead of weak.
_SIMILAR_FIT = 40.0
# Smallest pixel variance (px^2) by which this increase is divided.  The variance is estimated from the
# reprojection errors of the inliers; a smaller estimate is replaced by this value, because pixels in messages
# are rounded to 0.01 px, and four points may fit by luck.
_MIN_VARIANCE_PX2 = 0.01


class Rule(msgspec.Struct, frozen=True, kw_only=True):
    """One rule about a pose, with the measured value and its limit.

    Attributes:
        name: Error code of a rule that refuses poses, or reason of a weak pose; several rules may share one.
        about: The measured quantity, in words.
        measured: Measured value.
        limit: Last value that satisfies the rule.
        unit: Unit of both values; empty for a number without unit.
        at_least: Whether the limit is the smallest value that satisfies the rule; otherwise it is the
            largest.
        refuses: Whether a pose that violates the rule is refused; otherwise it is weak.
    """

    name: str
    about: str
    measured: float
    limit: float
    unit: str = ""
    at_least: bool = True
    refuses: bool = False

    @property
    def is_satisfied(self) -> bool:
        """Whether the measured value is at the limit or on the right side of it."""
        return self.measured >= self.limit if self.at_least else self.measured <= self.limit

    @property
    def margin(self) -> float:
        """By which factor the measured value is on the right side of its limit, from 0 to infinity.

        The margin is 1 at the limit, above 1 if the rule is satisfied, and below 1 if the rule is violated.
        It is ``measured / limit`` if the limit is a smallest value (``at_least``), and ``limit / measured``
        if it is a largest one.  If the limit is negative, such as that of a logarithm, the margin is the
        reciprocal of this ratio.  A negative ratio counts as 0.
        """
        if self.measured == self.limit:
            return 1.0
        larger, smaller = (self.measured, self.limit) if self.at_least else (self.limit, self.measured)
        if self.limit < 0:
            larger, smaller = -smaller, -larger
        return math.inf if smaller == 0 else max(0.0, larger / smaller)


def evaluate_rules(
    correspondences: int, evidence: Evidence | None, *, inlier_px: float, weak: WeakLimits
) -> tuple[Rule, ...]:
    """Return the rules about a pose, satisfied or not, with the values that *evidence* holds.

    With fewer than four correspondences only the rule ``too-few`` is returned.  With fewer than four inliers,
    three rules are returned: those about the number of correspondences, about the number of inliers, and
    about width over length of all correspondences.  The rules about the second pose of a planar scene are
    left out if there is no second pose.

    Args:
        correspondences: Number of correspondences of the request.
        evidence: The pose with its evidence; None for fewer correspondences than a pose needs.
        inlier_px: Largest reprojection error of an inlier, pixels.
        weak: Limits beyond which a pose is weak.
    """
    too_few = _refusing("too-few", "matches", correspondences, MIN_CORRESPONDENCES)
    if evidence is None:
        return (too_few,)
    inliers = len(evidence.inliers)
    consensus = _refusing("no-consensus", "inliers", inliers, MIN_CORRESPONDENCES)
    if inliers < MIN_CORRESPONDENCES:
        shape = _refusing(
            "degenerate", "width over length of all matches", evidence.width_to_length, MIN_WIDTH_TO_LENGTH
        )
        return (too_few, consensus, shape)
    width_to_length = evidence.inlier_width_to_length
    return (
        too_few,
        consensus,
        Rule(
            name="no-consensus",
            about="log10 of the expected random poses that fit as well",
            measured=evidence.log10_false_alarms,
            limit=_MAX_LOG10_FALSE_ALARMS,
            at_least=False,
            refuses=True,
        ),
        _refusing("degenerate", "width over length of the inliers", width_to_length, MIN_WIDTH_TO_LENGTH),
        _refusing(
            "degenerate",
            "rms distance of the inlier pixels from their centroid",
            evidence.radius_px,
            inlier_px,
            unit="px",
        ),
        _weak("few-inliers", "inliers", inliers, weak.inliers),
        _weak(
            "low-inlier-ratio",
            "share of the matches that are inliers",
            inliers / correspondences,
            weak.inlier_ratio,
        ),
        _weak("nearly-collinear", "width over length of the inliers", width_to_length, _WEAK_WIDTH_TO_LENGTH),
        _weak(
            "clustered", "inliers, neighbours counted once", evidence.independent_inliers, weak.inliers / 2
        ),
        *_constraint_rules(evidence, weak),
        *_ambiguity_rules(evidence),
    )


def _constraint_rules(evidence: Evidence, weak: WeakLimits) -> tuple[Rule, ...]:
    """Return the rules about the covariance of the pose.

    If the covariance is not finite or has a variance that is not positive, some motion of the camera is not
    constrained.  Then only one rule is returned, which is violated: the measured value 5 stands for any
    number below the required 6 motions.  Otherwise, two rules limit the standard deviations of position and
    rotation, each the root of the summed variances of its three axes.
    """
    variances = evidence.covariance.diagonal()
    if not (np.isfinite(evidence.covariance).all() and (variances > 0.0).all()):
        return (_refusing("degenerate", "motions of the camera that the inliers constrain", 5, 6),)
    return (
        Rule(
            name="poorly-constrained",
            about="standard deviation of the position",
            unit="m",
            at_least=False,
            measured=math.sqrt(variances[:3].sum()),
            limit=weak.translation_m,
        ),
        Rule(
            name="poorly-constrained",
            about="standard deviation of the rotation",
            unit="deg",
            at_least=False,
            measured=math.degrees(math.sqrt(variances[3:].sum())),
            limit=math.degrees(weak.rotation_rad),
        ),
    )


def _ambiguity_rules(evidence: Evidence) -> tuple[Rule, ...]:
    """Return the rules that compare the pose with the second pose of a planar scene by a likelihood ratio.

    The measured value is the increase of the sum of squared reprojection errors of the inliers from the pose
    to the second pose, divided by the pixel variance (at least `_MIN_VARIANCE_PX2`).  Without a second pose
    there is no rule.
    """
    if not evidence.second_pose_rmse_px:
        return ()
    inliers = len(evidence.inliers)
    squares_px2 = inliers * evidence.rmse_px**2
    variance_px2 = max(squares_px2 / max(1, 2 * inliers - 6), _MIN_VARIANCE_PX2)
    difference = (inliers * evidence.second_pose_rmse_px**2 - squares_px2) / variance_px2
    about = "increase of squared errors to a plane's second pose, in variances"
    return (
        _refusing("degenerate", about, difference, _EQUAL_FIT),
        _weak("ambiguous", about, difference, _SIMILAR_FIT),
    )


def _refusing(name: str, about: str, measured: float, limit: float, *, unit: str = "") -> Rule:
    return Rule(name=name, about=about, measured=float(measured), limit=float(limit), unit=unit, refuses=True)


def _weak(name: str, about: str, measured: float, limit: float) -> Rule:
    return Rule(name=name, about=about, measured=float(measured), limit=float(limit))
