"""The rules by which the native core calls a pose weak or refuses it, with measured values and limits.

``native/src/solve.hpp`` applies them in this order, and the first rule that refuses gives the error; the
replay of a recording shows them all.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np

from rse_pf.native import COLLINEAR, Evidence
from rse_pf.pnp.options import WeakLimits

__all__ = ["MATCHES_OF_A_POSE", "Rule", "rules_of"]

MATCHES_OF_A_POSE = 4  # a pose of three matches has no witness
_MAX_LOG10_FALSE_ALARMS = -5.0  # log10 of the false alarms at which chance is ruled out
_NEARLY_COLLINEAR = 0.1  # width over length of matches below which a pose is weak
_SAME_FIT = 9.0  # difference of squared errors, in units of the noise, below which two poses fit alike
_SIMILAR_FIT = (
    40.0  # difference of squared errors, in units of the noise, below which two poses nearly fit alike
)
_NOISE_FLOOR_PX2 = 0.01  # smallest variance of a pixel


class Rule(msgspec.Struct, frozen=True, kw_only=True):
    """One rule about a pose.

    Attributes:
        name: The reason or the code that it gives.
        about: What is measured, in words.
        measured: Its value.
        limit: The value that is still good.
        unit: Of both.
        at_least: Whether the value has to reach the limit, or must not exceed it.
        refuses: Whether a pose that breaks it is refused, or called weak.
    """

    name: str
    about: str
    measured: float
    limit: float
    unit: str = ""
    at_least: bool = True
    refuses: bool = False

    @property
    def is_kept(self) -> bool:
        """Whether the pose keeps the rule."""
        return self.measured >= self.limit if self.at_least else self.measured <= self.limit

    @property
    def margin(self) -> float:
        """How many times better than the limit the value is; below 1 the rule is broken."""
        if self.measured == self.limit:
            return 1.0
        good, bad = (self.measured, self.limit) if self.at_least else (self.limit, self.measured)
        if self.limit < 0:
            good, bad = -bad, -good
        return math.inf if bad == 0 else max(0.0, good / bad)


def rules_of(matches: int, found: Evidence | None, *, inlier_px: float, weak: WeakLimits) -> tuple[Rule, ...]:
    """Return the rules about a pose in their order.

    Args:
        matches: How many were given.
        found: The pose with its evidence; None for fewer matches than a pose needs.
        inlier_px: Largest error of an inlier.
        weak: Where a pose stops being ``ok``.
    """
    too_few = _refusing("too-few", "matches", matches, MATCHES_OF_A_POSE)
    if found is None:
        return (too_few,)
    count = len(found.inliers)
    consensus = _refusing("no-consensus", "inliers", count, MATCHES_OF_A_POSE)
    if count < MATCHES_OF_A_POSE:
        return (
            too_few,
            consensus,
            _refusing("degenerate", "width over length of all matches", found.thinness, COLLINEAR),
        )
    return (
        too_few,
        consensus,
        Rule(
            name="no-consensus", about="log10 of the poses that chance would give",
            measured=found.log10_false_alarms, limit=_MAX_LOG10_FALSE_ALARMS, at_least=False, refuses=True,
        ),
        _refusing("degenerate", "width over length of the inliers", found.inlier_thinness, COLLINEAR),
        _refusing(
            "degenerate", "distance of the inliers from their centre", found.radius_px, inlier_px, unit="px"
        ),
        _weak("few-inliers", "inliers", count, weak.inliers),
        _weak("low-inlier-ratio", "share of the matches that agree", count / matches, weak.inlier_ratio),
        _weak(
            "nearly-collinear", "width over length of the inliers", found.inlier_thinness, _NEARLY_COLLINEAR
        ),
        _weak("clustered", "inliers in places of their own", found.independent, weak.inliers / 2),
        *_constraint_rules(found, weak),
        *_ambiguity_rules(found),
    )  # fmt: skip


def _constraint_rules(found: Evidence, weak: WeakLimits) -> tuple[Rule, ...]:
    """Return the rules about how well the inliers fix the pose."""
    variances = found.covariance.diagonal()
    if not (np.isfinite(found.covariance).all() and (variances > 0.0).all()):
        return (_refusing("degenerate", "motions of the camera that the matches fix", 5, 6),)
    return (
        Rule(
            name="poorly-constrained", about="standard deviation of the position", unit="m", at_least=False,
            measured=math.sqrt(variances[:3].sum()), limit=weak.translation_m,
        ),
        Rule(
            name="poorly-constrained", about="standard deviation of the rotation", unit="deg", at_least=False,
            measured=math.degrees(math.sqrt(variances[3:].sum())), limit=math.degrees(weak.rotation_rad),
        ),
    )  # fmt: skip


def _ambiguity_rules(found: Evidence) -> tuple[Rule, ...]:
    """Return the rules that compare the pose with the second pose of a plane by a likelihood ratio."""
    if not found.other_rmse_px:
        return ()
    count = len(found.inliers)
    squares_px2 = count * found.rmse_px**2
    variance_px2 = max(squares_px2 / max(1, 2 * count - 6), _NOISE_FLOOR_PX2)
    difference = (count * found.other_rmse_px**2 - squares_px2) / variance_px2
    about = "how much worse the second pose of a plane fits, in units of the noise"
    return (
        _refusing("degenerate", about, difference, _SAME_FIT),
        _weak("ambiguous", about, difference, _SIMILAR_FIT),
    )


def _refusing(name: str, about: str, measured: float, limit: float, *, unit: str = "") -> Rule:
    return Rule(name=name, about=about, measured=float(measured), limit=float(limit), unit=unit, refuses=True)


def _weak(name: str, about: str, measured: float, limit: float) -> Rule:
    return Rule(name=name, about=about, measured=float(measured), limit=float(limit))
