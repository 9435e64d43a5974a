"""The rules by which a pose is called weak or refused, each with its measured value and its limit.

The solver asks them in their order and stops at the first one that refuses; the replay of a recording shows
them all.  The native core has the same limits in ``native/src/solve.hpp``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt

from rse_pf.errors import DegenerateGeometry, NoConsensus, PnpError, TooFewCorrespondences
from rse_pf.geometry import Array, Camera
from rse_pf.pnp import evidence
from rse_pf.pnp.options import WeakLimits
from rse_pf.pnp.planar_ambiguity import second_planar_pose

__all__ = [
    "COLLINEAR",
    "MAX_LOG10_FALSE_ALARMS",
    "NEARLY_COLLINEAR",
    "NOISE_FLOOR_PX2",
    "SAME_FIT",
    "SIMILAR_FIT",
    "WEAK_PERSPECTIVE",
    "AskedRule",
    "PoseJudgement",
    "Rule",
    "too_few_matches",
]

MAX_LOG10_FALSE_ALARMS = -5.0
"""log10 of the false alarms at which chance is ruled out."""
COLLINEAR = 0.02
"""Width over length of matches below which no pose is given."""
NEARLY_COLLINEAR = 0.1
"""Width over length of matches below which a pose is weak."""
WEAK_PERSPECTIVE = 0.08
"""Variation of 1/z below which a plane may have two poses."""
SAME_FIT = 9.0
"""Difference of squared errors, in units of the noise, below which two poses are not told apart."""
SIMILAR_FIT = 40.0
"""Difference of squared errors, in units of the noise, below which two poses are hardly told apart."""
NOISE_FLOOR_PX2 = 0.01
"""Smallest variance of a pixel."""

_MATCHES_OF_A_POSE = 4
_MATCH_EVERYWHERE = "match points all over the image, or skip this frame"


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


class AskedRule(NamedTuple):
    """A rule, and what makes the error for a pose that breaks it; None if such a pose is only weak."""

    rule: Rule
    refusal: Callable[[], PnpError] | None = None


class PoseJudgement:
    """Judges one proposed pose: `ask` yields its rules and measures what they need on the way.

    Attributes:
        inliers: Sorted row numbers of the matches that agree with the pose.
        squares_px2: Sum of the squared errors of the inliers.
        covariance: ``(6, 6)`` of the twist left of the pose, see `PnpSolution`.
    """

    inliers: npt.NDArray[np.intp]
    squares_px2: float
    covariance: Array

    def __init__(
        self,
        T_camera_world: Array | None,
        points_world: Array,
        pixels: Array,
        camera: Camera,
        *,
        inlier_px: float,
        weak: WeakLimits,
    ) -> None:
        """Measure nothing yet.

        Args:
            T_camera_world: ``(4, 4)``; None where no engine proposes a pose.
            points_world: ``(n, 3)``, metres.
            pixels: ``(n, 2)``.
            camera: Intrinsics.
            inlier_px: Largest error of an inlier.
            weak: Where a pose stops being ``ok``.
        """
        self._T_camera_world = T_camera_world
        self._points_world = points_world
        self._pixels = pixels
        self._camera = camera
        self._inlier_px = inlier_px
        self._weak = weak
        self.inliers = np.empty(0, np.intp)

    def ask(self) -> Iterator[AskedRule]:
        """Yield the rules in their order; after the last one all attributes are set."""
        n = len(self._pixels)
        yield AskedRule(
            Rule(
                name="too-few", about="matches", measured=float(n), limit=float(_MATCHES_OF_A_POSE),
                refuses=True,
            ),
            lambda: too_few_matches(n),
        )  # fmt: skip
        if n < _MATCHES_OF_A_POSE:
            return
        view = self._inlier_view()
        count = len(self.inliers)
        yield AskedRule(
            Rule(
                name="no-consensus", about="inliers", measured=float(count),
                limit=float(_MATCHES_OF_A_POSE), refuses=True,
            ),
            self._no_consensus,
        )  # fmt: skip
        if view is None or count < _MATCHES_OF_A_POSE:
            width = min(evidence.width_to_length(self._points_world), evidence.width_to_length(self._pixels))
            yield AskedRule(_collinear_rule("width over length of all matches", width), self._no_consensus)
            return
        error2 = view[evidence.ERROR2]
        independent = evidence.independent_inliers(view, self._camera)
        yield self._ask_chance(independent, float(error2.max()))
        shape = evidence.Shape(view, self._camera)
        yield from self._ask_shape(shape)
        yield from self._ask_strength(independent, shape)
        self.squares_px2 = float(np.add.reduce(error2))
        variance_px2 = max(self.squares_px2 / max(1, 2 * count - 6), NOISE_FLOOR_PX2)
        yield from self._ask_constraint(shape, variance_px2)
        if shape.depth_variation < WEAK_PERSPECTIVE:
            yield from self._ask_ambiguity(variance_px2)

    def _inlier_view(self) -> Array | None:
        """Find the inliers and return their ``(5, k)`` view; None without a pose."""
        if self._T_camera_world is None:
            return None
        view = evidence.view_of(self._T_camera_world, self._points_world, self._pixels, self._camera)
        self.inliers = (view[evidence.ERROR2] <= self._inlier_px**2).nonzero()[0]
        return view.take(self.inliers, axis=1)

    def _ask_chance(self, independent: int, largest_error2_px2: float) -> AskedRule:
        n, count = len(self._pixels), len(self.inliers)

        def refusal() -> PnpError:
            chance = evidence.log10_false_alarms(n, count, largest_error2_px2, self._camera)
            if chance > MAX_LOG10_FALSE_ALARMS:
                return self._no_consensus()
            return DegenerateGeometry(
                f"the {count} correspondences that agree lie in {independent} places of the image, "
                "and may be copies of each other",
                hint=_MATCH_EVERYWHERE,
            )

        chance = evidence.log10_false_alarms(
            n - (count - independent), independent, largest_error2_px2, self._camera
        )
        return AskedRule(
            Rule(
                name="no-consensus", about="log10 of the poses that chance would give", measured=chance,
                limit=MAX_LOG10_FALSE_ALARMS, at_least=False, refuses=True,
            ),
            refusal,
        )  # fmt: skip

    def _ask_shape(self, shape: evidence.Shape) -> Iterator[AskedRule]:
        """Yield the rules that refuse inliers on a line or in one place of the image."""
        yield AskedRule(
            _collinear_rule("width over length of the inliers", shape.thinness),
            lambda: _collinear(shape.thinness),
        )
        yield AskedRule(
            Rule(
                name="degenerate", about="distance of the inliers from their centre", unit="px",
                measured=shape.radius_px, limit=self._inlier_px, refuses=True,
            ),
            lambda: DegenerateGeometry(
                f"the pixels that agree lie {shape.radius_px:.1f} px (rms) from their centre, "
                f"less than {self._inlier_px:g} px",
                hint=_MATCH_EVERYWHERE,
            ),
        )  # fmt: skip

    def _ask_strength(self, independent: int, shape: evidence.Shape) -> Iterator[AskedRule]:
        """Yield the rules about the number and the distribution of the inliers of a weak pose."""
        weak, count = self._weak, len(self.inliers)
        yield AskedRule(
            Rule(name="few-inliers", about="inliers", measured=float(count), limit=float(weak.inliers))
        )
        yield AskedRule(
            Rule(
                name="low-inlier-ratio", about="share of the matches that agree",
                measured=count / len(self._pixels), limit=weak.inlier_ratio,
            )
        )  # fmt: skip
        yield AskedRule(
            Rule(
                name="nearly-collinear", about="width over length of the inliers", measured=shape.thinness,
                limit=NEARLY_COLLINEAR,
            )
        )  # fmt: skip
        yield AskedRule(
            Rule(
                name="clustered", about="inliers in places of their own", measured=float(independent),
                limit=weak.inliers / 2,
            )
        )  # fmt: skip

    def _ask_constraint(self, shape: evidence.Shape, variance_px2: float) -> Iterator[AskedRule]:
        """Yield the rules about how well the inliers fix the pose, and set its covariance."""
        try:
            self.covariance, variances = evidence.inverse_of_information(shape.information, variance_px2)
        except ZeroDivisionError:
            variances = [-1.0]
        if not all(value > 0.0 for value in variances):
            yield AskedRule(
                Rule(
                    name="degenerate", about="motions of the camera that the matches fix", measured=5.0,
                    limit=6.0, refuses=True,
                ),
                lambda: DegenerateGeometry(
                    "the correspondences do not constrain some motion of the camera",
                    hint="match more of the scene",
                ),
            )  # fmt: skip
            return
        yield AskedRule(
            Rule(
                name="poorly-constrained", about="standard deviation of the position", unit="m",
                at_least=False, measured=math.sqrt(sum(variances[:3])), limit=self._weak.translation_m,
            )
        )  # fmt: skip
        yield AskedRule(
            Rule(
                name="poorly-constrained", about="standard deviation of the rotation", unit="deg",
                at_least=False, measured=math.degrees(math.sqrt(sum(variances[3:]))),
                limit=math.degrees(self._weak.rotation_rad),
            )
        )  # fmt: skip

    def _ask_ambiguity(self, variance_px2: float) -> Iterator[AskedRule]:
        """Yield the rules that compare the pose with the second pose of a plane by a likelihood ratio."""
        assert self._T_camera_world is not None
        points_world, pixels = self._points_world[self.inliers], self._pixels[self.inliers]
        second = second_planar_pose(self._T_camera_world, points_world, pixels, self._camera)
        if second is None:
            return
        other_px2 = second[1]
        difference = (other_px2 - self.squares_px2) / variance_px2
        about = "how much worse the second pose of a plane fits, in units of the noise"

        def refusal() -> PnpError:
            rmse, other = (math.sqrt(squares / len(pixels)) for squares in (self.squares_px2, other_px2))
            return DegenerateGeometry(
                f"two poses fit alike ({rmse:.2f} and {other:.2f} px)",
                hint="match points that do not lie in one far plane",
            )

        yield AskedRule(
            Rule(name="degenerate", about=about, measured=difference, limit=SAME_FIT, refuses=True), refusal
        )
        yield AskedRule(Rule(name="ambiguous", about=about, measured=difference, limit=SIMILAR_FIT))

    def _no_consensus(self) -> PnpError:
        """Return the most specific error: degenerate input says more than "no consensus"."""
        for rows in (self._points_world, self._pixels):
            thinness = evidence.width_to_length(rows)
            if thinness < COLLINEAR:
                return _collinear(thinness)
        return NoConsensus(
            f"the best pose agrees with {len(self.inliers)} of {len(self._pixels)} correspondences within "
            f"{self._inlier_px:g} px, no more than chance would give",
            hint="tighten the matcher, or skip this frame",
        )


def too_few_matches(n: int) -> TooFewCorrespondences:
    """Return the error of *n* matches that are less than a pose needs."""
    return TooFewCorrespondences(
        f"got {n} correspondences, a pose needs at least {_MATCHES_OF_A_POSE}",
        hint="loosen the matcher, or skip this frame",
    )


def _collinear_rule(about: str, measured: float) -> Rule:
    return Rule(name="degenerate", about=about, measured=measured, limit=COLLINEAR, refuses=True)


def _collinear(thinness: float) -> DegenerateGeometry:
    return DegenerateGeometry(
        f"the points that agree lie on one line or coincide (width/length {thinness:.3f} is below "
        f"{COLLINEAR})",
        hint=_MATCH_EVERYWHERE,
    )
