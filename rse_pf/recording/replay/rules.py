"""The rules by which a pose is called weak or refused, each with its measured value and its limit.

`rse_pf.pnp.solver` decides; this module repeats its rules one by one, so that a reader sees which of them
spoke, and by how much.  A test compares the limits.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np

from rse_pf.errors import RsePfError
from rse_pf.geometry import Array, Camera
from rse_pf.pnp import PnpOptions, WeakLimits, evidence
from rse_pf.pnp.engines import engine_for
from rse_pf.pnp.planar_ambiguity import second_planar_pose

__all__ = ["LIMITS", "Rule", "proposed_pose", "rules_of"]

LIMITS = {
    "MAX_LOG10_FALSE_ALARMS": -5.0,
    "COLLINEAR": 0.02,
    "NEARLY_COLLINEAR": 0.1,
    "WEAK_PERSPECTIVE": 0.08,
    "SAME_FIT": 9.0,
    "SIMILAR_FIT": 40.0,
    "NOISE_FLOOR_PX2": 0.01,
}
"""The solver's limits by their names there."""


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


def proposed_pose(
    points_world: Array, pixels: Array, camera: Camera, options: PnpOptions, engine: str
) -> Array | None:
    """Return the ``(4, 4)`` pose that *engine* proposes before any rule is asked, None if it has none."""
    try:
        pose = engine_for(engine)(points_world, pixels, camera, options)
    except RsePfError:
        return None
    if pose is None or not np.isfinite(pose).all():
        return None
    T_camera_world = np.eye(4)
    T_camera_world[:3] = pose
    return T_camera_world


def rules_of(
    T_camera_world: Array | None, points_world: Array, pixels: Array, camera: Camera, options: PnpOptions
) -> list[Rule]:
    """Return every rule that applies to a pose, in the order in which the solver asks them.

    Args:
        T_camera_world: ``(4, 4)``; None where no engine proposes a pose.
        points_world: ``(n, 3)``, metres.
        pixels: ``(n, 2)``.
        camera: Intrinsics.
        options: Of the command.
    """
    weak, n = WeakLimits(), len(pixels)
    found = [Rule(name="too-few", about="matches", measured=float(n), limit=4.0, refuses=True)]
    if n < 4:
        return found
    view = None
    if T_camera_world is not None:
        view = evidence.view_of(T_camera_world, points_world, pixels, camera)
        view = view.take((view[evidence.ERROR2] <= options.inlier_px**2).nonzero()[0], axis=1)
    count = 0 if view is None else view.shape[1]
    found.append(Rule(name="no-consensus", about="inliers", measured=float(count), limit=4.0, refuses=True))
    if view is None or count < 4:
        width = min(evidence.width_to_length(points_world), evidence.width_to_length(pixels))
        return [*found, _width("degenerate", "width over length of all matches", width, refuses=True)]
    error2 = view[evidence.ERROR2]
    independent = evidence.independent_inliers(view, camera)
    largest = min(options.inlier_px**2, float(error2.max()))
    chance = evidence.log10_false_alarms(n - (count - independent), independent, largest, camera)
    shape = evidence.Shape(view, camera)
    found += [
        Rule(
            name="no-consensus", about="log10 of the poses that chance would give", measured=chance,
            limit=LIMITS["MAX_LOG10_FALSE_ALARMS"], at_least=False, refuses=True,
        ),
        _width("degenerate", "width over length of the inliers", shape.thinness, refuses=True),
        Rule(
            name="degenerate", about="distance of the inliers from their centre", unit="px",
            measured=shape.radius_px, limit=options.inlier_px, refuses=True,
        ),
        Rule(name="few-inliers", about="inliers", measured=float(count), limit=float(weak.inliers)),
        Rule(
            name="low-inlier-ratio", about="share of the matches that agree", measured=count / n,
            limit=weak.inlier_ratio,
        ),
        _width("nearly-collinear", "width over length of the inliers", shape.thinness, refuses=False),
        Rule(
            name="clustered", about="inliers in places of their own", measured=float(independent),
            limit=weak.inliers / 2,
        ),
    ]  # fmt: skip
    squares = float(np.add.reduce(error2))
    variance = max(squares / max(1, 2 * count - 6), LIMITS["NOISE_FLOOR_PX2"])
    found += _constraint(shape, variance, weak)
    assert T_camera_world is not None
    if shape.depth_variation < LIMITS["WEAK_PERSPECTIVE"]:
        rows = np.flatnonzero(
            evidence.view_of(T_camera_world, points_world, pixels, camera)[evidence.ERROR2]
            <= options.inlier_px**2
        )
        second = second_planar_pose(T_camera_world, points_world[rows], pixels[rows], camera)
        if second is not None:
            found += _ambiguity((second[1] - squares) / variance)
    return found


def _width(name: str, about: str, measured: float, *, refuses: bool) -> Rule:
    limit = LIMITS["COLLINEAR" if refuses else "NEARLY_COLLINEAR"]
    return Rule(name=name, about=about, measured=measured, limit=limit, refuses=refuses)


def _constraint(shape: evidence.Shape, variance_px2: float, weak: WeakLimits) -> list[Rule]:
    """Return the rules about how well the inliers fix the pose."""
    try:
        _, variances = evidence.inverse_of_information(shape.information, variance_px2)
    except ZeroDivisionError:
        variances = [-1.0]
    if not all(value > 0.0 for value in variances):
        return [
            Rule(
                name="degenerate", about="motions of the camera that the matches fix", measured=5.0,
                limit=6.0, refuses=True,
            )
        ]  # fmt: skip
    return [
        Rule(
            name="poorly-constrained", about="standard deviation of the position", unit="m", at_least=False,
            measured=math.sqrt(sum(variances[:3])), limit=weak.translation_m,
        ),
        Rule(
            name="poorly-constrained", about="standard deviation of the rotation", unit="deg", at_least=False,
            measured=math.degrees(math.sqrt(sum(variances[3:]))), limit=math.degrees(weak.rotation_rad),
        ),
    ]  # fmt: skip


def _ambiguity(difference: float) -> list[Rule]:
    about = "how much worse the second pose of a plane fits, in units of the noise"
    return [
        Rule(name="degenerate", about=about, measured=difference, limit=LIMITS["SAME_FIT"], refuses=True),
        Rule(name="ambiguous", about=about, measured=difference, limit=LIMITS["SIMILAR_FIT"]),
    ]
