"""Compare how a camera moved with an odometry, a truth or an IMU: delay of stamps, scale, axes, mirrors.

What is compared are motions over short times, so that neither drift nor the choice of a world matters.  Where
a lens or its depth is wrong, give the poses that were adjusted for that.

Source:
    Rotation between two sets of vectors after Kabsch, Acta Cryst. A32, 1976; the equation A X = X B of a
    mounted camera after Tsai and Lenz, IEEE Trans. Robotics and Automation 5, 1989.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from client_sdk.check.findings import CannotTell, FaultKind, Finding
from client_sdk.imu.checks import RateCheck, check_rates, find_sample_trouble
from client_sdk.imu.history import ImuHistory
from client_sdk.source_facts import stamps_in_seconds
from client_sdk.trajectory import Trajectory, read_trajectory
from rse_pf.errors import UsageError
from rse_pf.geometry import Array, from_quaternion, inverse, log_se3, rotation_angle_deg, to_quaternion

__all__ = [
    "FEWEST_ADJUSTED",
    "CameraMotion",
    "MotionReference",
    "check_imu",
    "check_motion",
    "nothing_to_compare",
]

_LEAST_STEP_S, _LONGEST_STEP_S = 0.45, 1.0
_MOST_PAIRS, _FEWEST_PAIRS, _BLOCKS = 600, 20, 10
_MOST_DELAY_S, _DELAY_STEP_S, _DELAY_FLOOR_S, _LEAST_DELAY_S, _VAGUE_S = 0.5, 0.02, 0.003, 0.01, 0.04
_OF_INTERVAL = 0.1
"""How the camera moves between its frames is not known: a delay is not known better than this share."""
_EXPLAINED = 0.5
"""Motions that fit leave less of their mean square than this share."""
_BETTER, _ALIKE, _DEVIATIONS = 0.5, 1.2, 3.0
_FITS_WELL = 0.15
"""Axes are judged where a rotation, or a mirror, leaves less than this share."""
_TURNED_DEG, _NEAR_AXES_DEG = 20.0, 15.0
_SEGMENT_M, _SEGMENT_S, _FEWEST_SEGMENTS = 0.25, 6.0, 12
FEWEST_ADJUSTED = 16
"""Fewer adjusted keyframes do not tell metres, nor by how much a lens bends them."""
_ARM_M, _CAMERA_ARM_M = 0.5, 0.02
_LEAST_SCALE = 0.01
_OUTLIER = 4.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MotionReference:
    """What the motion of a camera is compared with.

    Attributes:
        path: Poses, metres, of the camera or of what it is mounted on.
        name: For people, such as ``odometry``.
        is_camera: Whether they are poses of the camera itself, its z along the optical axis.
        scale_deviation: How well its metres are known, relative.
    """

    path: Trajectory
    name: str = "odometry"
    is_camera: bool = True
    scale_deviation: float = 0.004

    @classmethod
    def of_truth(
        cls, path: Trajectory | None, kind: str, *, is_camera: bool = True
    ) -> MotionReference | None:
        """Return the true poses of a recording as a reference; None where there are none."""
        if path is None or len(path) < 2:
            return None
        name = "the truth" if kind == "ground truth" else "the reference poses"
        return cls(path=path, name=name, is_camera=is_camera)

    @classmethod
    def beside(cls, source: Path | str) -> MotionReference | None:
        """Return ``odometry.txt`` (TUM format) in the folder of a recording; None where there is none.

        Raises:
            UsageError: The file is broken, or holds fewer than two poses.
        """
        file = Path(source) / "odometry.txt"
        return cls.of_file(file) if file.is_file() else None

    @classmethod
    def of_file(cls, file: Path) -> MotionReference:
        """Return a path in TUM format, of what the camera is mounted on; raises as `beside`."""
        return cls(path=read_odometry(file), is_camera=False)


def read_odometry(file: Path) -> Trajectory:
    """Return a path in TUM format, its stamps in seconds; raises UsageError with fewer than two poses."""
    path = read_trajectory(file)
    if len(path) < 2:
        raise UsageError(f"{file} holds {len(path)} poses", hint="a motion needs 2 or more")
    return Trajectory(stamps_in_seconds(path.timestamps_s, str(file))[0], path.T_world_camera)


def nothing_to_compare(*, has_depth: bool) -> list[CannotTell]:
    """Return what a drive without odometry, truth and IMU cannot tell."""
    without = "no odometry, truth or IMU beside the images"
    untold = [
        CannotTell(FaultKind.STAMP_DELAY, f"{without}: there is no second clock"),
        CannotTell(FaultKind.MIRRORED, f"{without}: a mirrored drive looks like one in a mirrored world"),
        CannotTell(FaultKind.SWAPPED_AXES, f"{without}: there are no other axes"),
    ]
    if has_depth:
        untold.append(CannotTell(FaultKind.DEPTH_SCALE, f"{without}: nothing else knows a metre"))
    return untold


def check_imu(history: ImuHistory, stamps_s: Array, T_world_camera: Array) -> tuple[list[Finding], list[str]]:
    """Return what is wrong with an IMU beside ``(n, 4, 4)`` poses of the camera, and notes for people."""
    trouble = find_sample_trouble(history)
    if trouble:
        return [], [f"IMU: {trouble}"]
    check = check_rates(history, stamps_s, T_world_camera[:, :3, :3], 0.0) if len(stamps_s) > 1 else None
    if check is None:
        return [], ["IMU: the camera turns too little to compare it with the gyroscope"]
    return _imu_findings(check), [f"IMU: {check.trouble}"] if check.trouble and not check.fault else []


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraMotion:
    """How a camera moved.

    Attributes:
        stamps_s: ``(n,)``, ascending.
        T_world_camera: ``(n, 4, 4)``, as they were tracked.
        segments: ``(n,)``; poses of different segments are not compared.  None for one segment.
        metres: Where metres come from that can be wrong; ``none`` up to scale.
        adjusted: ``(k,)`` stamps and ``(k, 4, 4)`` poses of keyframes, adjusted with the calibration: metres
            are compared by them, since a wrong lens bends the others.
        metres_deviation: How well the calibration of *adjusted* tells metres, relative; of all poses where
            there are none.
    """

    stamps_s: Array
    T_world_camera: Array
    segments: Array | None = None
    metres: Literal["depth", "stereo", "none"] = "depth"
    adjusted: tuple[Array, Array] | None = None
    metres_deviation: float = 0.0


def check_motion(motion: CameraMotion, reference: MotionReference) -> tuple[list[Finding], list[CannotTell]]:
    """Return what is wrong with the motion of a camera beside *reference*, and what cannot be told."""
    stamps_s, T_world_camera, segments = motion.stamps_s, motion.T_world_camera, motion.segments
    pairs = _pairs(stamps_s, segments)
    least_s, most_s = reference.path.timestamps_s.min(), reference.path.timestamps_s.max()
    covered = (stamps_s[pairs[:, 0]] - _MOST_DELAY_S >= least_s) & (
        stamps_s[pairs[:, 1]] + _MOST_DELAY_S <= most_s
    )
    pairs = pairs[covered]
    if len(pairs) < _FEWEST_PAIRS:
        reason = f"{reference.name} and camera have {len(pairs)} motions in common"
        return [], [CannotTell(FaultKind.STAMP_DELAY, reason), CannotTell(FaultKind.MIRRORED, reason)]
    seen = _twists(T_world_camera[pairs[:, 0]], T_world_camera[pairs[:, 1]], *stamps_s[pairs.T])
    fits = _fits(seen, stamps_s[pairs], reference)
    best = min(range(len(fits)), key=lambda row: fits[row].cost)
    left = fits[best].left
    if left > _WELL_EXPLAINED and _explains_reordered(seen, stamps_s[pairs], reference, left):
        return [_quaternion_finding(reference)], []
    if fits[best].left > _EXPLAINED:
        reason = f"the camera does not move as {reference.name} says, at any delay within 0.5 s"
        return [], [CannotTell(FaultKind.STAMP_DELAY, reason), CannotTell(FaultKind.DEPTH_SCALE, reason)]
    findings, untold = _delay(fits, seen, reference, float(np.median(np.diff(stamps_s))))
    axes, vague = _axes(fits[best], reference)
    findings += axes
    untold += vague
    if motion.metres != "none" and not any(each.kind is FaultKind.MIRRORED for each in axes):
        moved_s, poses, doubt = stamps_s, T_world_camera, 0.0 if motion.adjusted else motion.metres_deviation
        if motion.adjusted is not None and len(motion.adjusted[0]) >= FEWEST_ADJUSTED:
            (moved_s, poses), segments, doubt = motion.adjusted, None, motion.metres_deviation
        by_metres = CameraMotion(
            stamps_s=moved_s - _DELAYS_S[best],
            T_world_camera=poses,
            segments=segments,
            metres=motion.metres,
            metres_deviation=doubt,
        )
        scale, vague = _scale(by_metres, reference, fits[best].rotation)
        findings += scale
        untold += vague
    return findings, untold


def _explains_reordered(seen: Array, stamps_s: Array, reference: MotionReference, left: float) -> bool:
    """Return whether a reference explains what it *left* once w of its quaternions changes its place."""
    quaternions = np.array([to_quaternion(pose[:3, :3]) for pose in reference.path.T_world_camera])
    for order in _QUATERNION_ORDERS:
        poses = reference.path.T_world_camera.copy()
        poses[:, :3, :3] = [from_quaternion(each) for each in quaternions[:, order]]
        other = replace(reference, path=Trajectory(reference.path.timestamps_s, poses))
        if min(fit.left for fit in _fits(seen, stamps_s, other)) <= min(_EXPLAINED, left / 2.0):
            return True
    return False


def _quaternion_finding(reference: MotionReference) -> Finding:
    return Finding(
        kind=FaultKind.SWAPPED_AXES, value=1.0, deviation=0.0, unit="", cost_m=None,
        sentence=f"the quaternions of {reference.name} have w at the wrong end of the four numbers",
        fix="write qx qy qz qw in a file in TUM format, and qw qx qy qz in one of EuRoC",
    )  # fmt: skip


# --- motions ----------------------------------------------------------------------------------------------

_WELL_EXPLAINED = 0.1
"""Share of the motions that a right reference leaves at most, with the noise of a tracker."""
_QUATERNION_ORDERS = [1, 2, 3, 0], [3, 0, 1, 2]
"""How to read x, y, z, w of quaternions that were written with w first, or with w last and read as first."""
_DELAYS_S: Array = np.arange(-_MOST_DELAY_S, _MOST_DELAY_S + 1e-9, _DELAY_STEP_S)


def _pairs(stamps_s: Array, segments: Array | None) -> npt.NDArray[np.int64]:
    """Return ``(m, 2)`` rows of poses that are a short time apart, spread over the drive."""
    later = np.searchsorted(stamps_s, stamps_s + _LEAST_STEP_S)
    rows = np.arange(len(stamps_s))
    usable = later < len(stamps_s)
    rows, later = rows[usable], later[usable]
    usable = stamps_s[later] - stamps_s[rows] <= _LONGEST_STEP_S
    if segments is not None:
        usable &= segments[rows] == segments[later]
    pairs = np.stack([rows[usable], later[usable]], axis=1)
    return np.asarray(pairs[:: max(1, -(-len(pairs) // _MOST_PAIRS))], dtype=np.int64)


def _twists(begins: Array, ends: Array, begins_s: Array, ends_s: Array) -> Array:
    """Return the mean velocities ``(m, 6)`` of the motions from *begins* to *ends*: m/s, then rad/s."""
    twists: Array = log_se3(inverse(begins) @ ends) / (ends_s - begins_s)[:, None]
    return twists


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Fit:
    """How the motions of the camera fit those of a reference at one delay.

    ``squares`` ``(m,)`` are of the residuals, in units of the noise, with the best ``rotation``
    ``R_camera_reference``; ``plain`` the same for equal axes, ``mirrored`` for the best ``mirror``: left and
    right of a camera's own axes, or any of other axes.  ``power`` is the square of the motions.
    """

    power: float
    rotation: Array
    mirror: Array
    squares: Array
    mirrored: Array
    plain: Array

    @property
    def best(self) -> Array:
        """The squares ``(m,)`` of what explains the motions better, rotation or mirror."""
        return self.mirrored if self.mirrored.sum() < _BETTER * self.squares.sum() else self.squares

    @property
    def cost(self) -> float:
        """The sum of the best squares."""
        return float(self.best.sum())

    @property
    def left(self) -> float:
        """The share of the motions that neither a rotation nor a mirror explains."""
        return self.cost / max(self.power, 1e-12)


def _fits(seen: Array, stamps_s: Array, reference: MotionReference) -> list[_Fit]:
    """Return the fits at all of `_DELAYS_S`."""
    measured, path = [], reference.path
    for delay_s in _DELAYS_S.tolist():
        begins_s, ends_s = stamps_s[:, 0] - delay_s, stamps_s[:, 1] - delay_s
        measured.append(_twists(path.at(begins_s), path.at(ends_s), begins_s, ends_s))
    noise = np.array([1.0, 1.0])
    kept = np.ones(len(seen), dtype=bool)
    fits: list[_Fit] = []
    for _ in range(3):
        fits = [_fit(seen, each, noise, kept, is_camera=reference.is_camera) for each in measured]
        best = min(range(len(fits)), key=lambda row: fits[row].cost)
        parts = _residuals(seen, measured[best], fits[best])
        size = np.linalg.norm(parts.reshape(-1, 2, 3), axis=2)
        typical = np.maximum(np.median(size[kept], axis=0), 1e-6)
        kept = (size <= _OUTLIER * typical).all(axis=1)
        noise = typical
    return fits


def _fit(seen: Array, measured: Array, noise: Array, kept: Array, *, is_camera: bool) -> _Fit:
    weights = np.repeat(1.0 / noise, 3) * kept[:, None]
    one, other = seen * weights, measured * weights
    other[:, :3] *= _ratio(seen[kept, :3], measured[kept, :3])
    # Translations are vectors; a mirror turns rates the other way than it turns vectors.
    U, _, Vt = np.linalg.svd(one[:, :3].T @ other[:, :3] + one[:, 3:].T @ other[:, 3:])
    rotation = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    V, _, Wt = np.linalg.svd(one[:, :3].T @ other[:, :3] - one[:, 3:].T @ other[:, 3:])
    mirror = V @ np.diag([1.0, 1.0, -np.linalg.det(V @ Wt)]) @ Wt
    mirror = np.diag([-1.0, 1.0, 1.0]) if is_camera else mirror
    return _Fit(
        power=float(np.square(one).sum()), rotation=rotation, mirror=mirror,
        squares=_squares(one, other, rotation), mirrored=_squares(one, other, mirror),
        plain=_squares(one, other, np.eye(3)),
    )  # fmt: skip


def _squares(one: Array, other: Array, axes: Array) -> Array:
    squares: Array = np.square(one - _turned(other, axes)).sum(axis=1)
    return squares


def _turned(twists: Array, axes: Array) -> Array:
    """Return velocities ``(m, 6)`` in other *axes* ``(3, 3)``, a rotation or a mirror."""
    sign = np.sign(np.linalg.det(axes))
    return np.concatenate([twists[:, :3] @ axes.T, sign * twists[:, 3:] @ axes.T], axis=1)


def _residuals(seen: Array, measured: Array, fit: _Fit) -> Array:
    scaled = measured.copy()
    scaled[:, :3] *= _ratio(seen[:, :3], measured[:, :3])
    left: Array = seen - _turned(scaled, fit.mirror if fit.best is fit.mirrored else fit.rotation)
    return left


def _ratio(one: Array, other: Array) -> float:
    return float(np.sqrt(np.square(one).sum() / max(np.square(other).sum(), 1e-12)))


# --- what they say ----------------------------------------------------------------------------------------


def _delay(
    fits: list[_Fit], seen: Array, reference: MotionReference, interval_s: float
) -> tuple[list[Finding], list[CannotTell]]:
    """Return by how much the stamps of images are late."""
    squares = np.array([fit.best for fit in fits])
    blocks = np.arange(squares.shape[1]) * _BLOCKS // squares.shape[1]
    total = squares.sum(axis=1)
    without = [total - squares[:, blocks == block].sum(axis=1) for block in range(_BLOCKS)]
    delay_s, deviation_s = _jackknife(_lowest(total), np.array([_lowest(each) for each in without]))
    deviation_s = math.hypot(deviation_s, _DELAY_FLOOR_S, _OF_INTERVAL * interval_s)
    is_large = abs(delay_s) >= max(_LEAST_DELAY_S, _DEVIATIONS * deviation_s)
    # On wheels at one speed a wrong delay may fit a little better in some parts of the drive.
    is_chance = is_large and not _explains(squares[int(np.argmin(total))], squares[len(fits) // 2])
    if deviation_s > _VAGUE_S or is_chance:
        reason = f"neither speed nor turn changes enough beside {reference.name}: delay within "
        within_s = _DEVIATIONS * deviation_s + (abs(delay_s) if is_chance else 0.0)
        return [], [CannotTell(FaultKind.STAMP_DELAY, f"{reason}{1e3 * within_s:.0f} ms", within_s)]
    if not is_large:
        return [], []
    speed_m_s = float(np.sqrt(np.square(seen[:, :3]).sum(axis=1).mean()))
    finding = Finding(
        kind=FaultKind.STAMP_DELAY, value=delay_s, deviation=deviation_s, unit="s",
        cost_m=abs(delay_s) * speed_m_s,
        sentence=f"the time stamps of the images are {1e3 * abs(delay_s):.0f} +- {1e3 * deviation_s:.0f} ms "
        f"{'later' if delay_s > 0 else 'earlier'} than those of {reference.name}",
        fix=f"{'subtract' if delay_s > 0 else 'add'} {1e3 * abs(delay_s):.0f} ms, or take the time of the "
        "exposure for both",
    )  # fmt: skip
    return [finding], []


def _lowest(costs: Array) -> float:
    """Return the delay of the lowest cost, between the steps by a parabola."""
    at = int(np.argmin(costs))
    if not 0 < at < len(costs) - 1:
        return float(_DELAYS_S[at])
    before, here, after = costs[at - 1 : at + 2]
    bend = before - 2.0 * here + after
    return float(_DELAYS_S[at] + (0.5 * _DELAY_STEP_S * (before - after) / bend if bend > 0 else 0.0))


def _jackknife(whole: float, parts: Array) -> tuple[float, float]:
    """Return a value and its deviation, from the values without each of the blocks."""
    n = len(parts)
    return whole, float(np.sqrt((n - 1) / n * np.square(parts - parts.mean()).sum()))


def _is_better(one: Array, other: Array) -> bool:
    """Return whether squares *one* are clearly below *other*, in most parts of the drive."""
    return bool(one.sum() < _BETTER * other.sum() and _is_certain(one, other))


def _explains(one: Array, other: Array) -> bool:
    """Return whether squares *one* are below *other* by far, or by little in most parts of the drive."""
    return bool(one.sum() < _BETTER * other.sum() or _is_certain(one, other))


def _is_certain(one: Array, other: Array) -> bool:
    blocks = np.arange(len(one)) * _BLOCKS // len(one)
    gains = np.array([(other - one)[blocks == block].sum() for block in range(_BLOCKS)])
    return bool(gains.sum() > _DEVIATIONS * float(gains.std(ddof=1)) * math.sqrt(_BLOCKS))


def _axes(fit: _Fit, reference: MotionReference) -> tuple[list[Finding], list[CannotTell]]:
    """Return whether the images are mirrored, or the axes of camera and reference differ."""
    if fit.left > _FITS_WELL:
        return [], [CannotTell(FaultKind.MIRRORED, f"the camera moves only roughly as {reference.name} says")]
    own = fit.plain if reference.is_camera else fit.squares
    if _is_better(fit.mirrored, own) and fit.mirrored.sum() < _ALIKE * fit.squares.sum():
        finding = Finding(
            kind=FaultKind.MIRRORED, value=1.0, deviation=0.0, unit="", cost_m=None,
            sentence=f"the images are mirrored: beside {reference.name} the camera turns the other way than "
            "it moves",
            fix="switch off the mirror of the camera or driver, and record again",
        )  # fmt: skip
        return [finding], []
    untold: list[CannotTell] = []
    if not _is_better(own, fit.mirrored):
        plane = f"beside {reference.name} the camera moves and turns in one plane: a mirror changes nothing"
        untold.append(CannotTell(FaultKind.MIRRORED, plane))
    if not reference.is_camera:
        reason = f"how the camera is mounted in the frame of {reference.name} is not known"
        return [], [*untold, CannotTell(FaultKind.SWAPPED_AXES, reason)]
    angle = rotation_angle_deg(fit.rotation)
    if angle < _TURNED_DEG or not _is_better(fit.squares, fit.plain):
        return [], untold
    named = _named_axes(fit.rotation)
    finding = Finding(
        kind=FaultKind.SWAPPED_AXES, value=1.0, deviation=0.0, unit="", cost_m=None,
        sentence=f"the axes of {reference.name} are turned by {angle:.0f} degrees from those of the camera"
        + (f": its {named} are the camera's x, y, z" if named else ""),
        fix="give poses of the camera, with x right, y down and z ahead, or correct the mounting",
    )  # fmt: skip
    return [finding], untold


def _named_axes(rotation: Array) -> str:
    """Return which axes of the reference are the camera's x, y, z, such as ``-y, -z, x``; empty if none."""
    rows = np.abs(rotation).argmax(axis=1)
    named = np.zeros((3, 3))
    named[range(3), rows] = np.sign(rotation[range(3), rows])
    is_whole = sorted(rows.tolist()) == [0, 1, 2]
    if not is_whole or rotation_angle_deg(named.T @ rotation) > _NEAR_AXES_DEG:
        return ""
    return ", ".join(("-" if rotation[row, at] < 0 else "") + "xyz"[at] for row, at in enumerate(rows))


def _scale(
    motion: CameraMotion, reference: MotionReference, rotation: Array
) -> tuple[list[Finding], list[CannotTell]]:
    """Return by how much metres of the camera differ from those of the reference."""
    stamps_s, T_world_camera, segments = motion.stamps_s, motion.T_world_camera, motion.segments
    path = reference.path
    kind = FaultKind.BASELINE if motion.metres == "stereo" else FaultKind.DEPTH_SCALE
    inside = (stamps_s >= path.timestamps_s.min()) & (stamps_s <= path.timestamps_s.max())
    rows = _segments(stamps_s, path.at(stamps_s)[:, :3, 3], segments, inside)
    if len(rows) < _FEWEST_SEGMENTS:
        reason = f"{len(rows)} parts of the path are {_SEGMENT_M:g} m long beside {reference.name}"
        return [], [CannotTell(kind, reason)]
    A = inverse(path.at(stamps_s[rows[:, 0]])) @ path.at(stamps_s[rows[:, 1]])
    B = inverse(T_world_camera[rows[:, 0]]) @ T_world_camera[rows[:, 1]]
    arm_m = _CAMERA_ARM_M if reference.is_camera else _ARM_M
    kept = np.ones(len(rows), dtype=bool)
    for _ in range(4):
        scale, left = _solved(A, B, rotation, arm_m, kept)
        kept = left <= _OUTLIER * max(float(np.median(left[kept])), 1e-6)
    blocks = np.arange(len(rows)) * _BLOCKS // len(rows)
    without = np.array(
        [_solved(A, B, rotation, arm_m, kept & (blocks != each))[0] for each in range(_BLOCKS)]
    )
    scale, deviation = _jackknife(_solved(A, B, rotation, arm_m, kept)[0], without)
    if not 1e-3 < scale < 1e3:
        return [], [CannotTell(kind, f"paths of camera and {reference.name} do not fit")]
    deviation = math.hypot(deviation, reference.scale_deviation * scale, motion.metres_deviation * scale)
    value = scale - 1.0
    if abs(value) < max(_LEAST_SCALE, _DEVIATIONS * deviation):
        vague = _DEVIATIONS * deviation
        what = kind.value.replace("_", " ")
        why = f"parts of the path differ from {reference.name}"
        if motion.metres_deviation > 0.7 * deviation / scale:
            why = "what the calibration leaves in doubt bends metres as well"
        reason = f"{why}: {what} within {100 * vague:.0f} %"
        return [], [CannotTell(kind, reason, vague)] if vague > 0.05 else []
    positions = path.at(stamps_s[inside])[:, :3, 3]
    reach_m = float(np.sqrt(np.square(positions - positions.mean(axis=0)).sum(axis=1).mean()))
    cost_m = abs(1.0 / scale - 1.0) * reach_m
    if motion.metres == "stereo":
        # Metres of a pair grow with its baseline, those of a depth image shrink with its scale.
        sentence = f"the baseline is set {_times(1.0 / scale, deviation / scale**2)} beside {reference.name}"
        finding = Finding(
            kind=FaultKind.BASELINE, value=1.0 / scale - 1.0, deviation=deviation / scale**2, unit="relative",
            cost_m=cost_m, sentence=sentence, fix=f"multiply the baseline of the rig by {scale:.4g}",
        )  # fmt: skip
        return [finding], []
    finding = Finding(
        kind=FaultKind.DEPTH_SCALE, value=value, deviation=deviation, unit="relative", cost_m=cost_m,
        sentence=f"the depth scale is set {_times(scale, deviation)}: depths are {1.0 / scale:.3g} times "
        f"what {reference.name} says",
        fix=f"divide depth_scale in intrinsics.json by {scale:.4g}; 1000 is for mm, 5000 for TUM",
    )  # fmt: skip
    return [finding], []


def _times(scale: float, deviation: float) -> str:
    if 0.5 < scale < 2.0:
        return (
            f"{100 * abs(scale - 1):.1f} +- {100 * deviation:.1f} % too {'large' if scale > 1 else 'small'}"
        )
    return f"to {scale:.3g} +- {deviation:.2g} times what it should be"


def _segments(
    stamps_s: Array, positions: Array, segments: Array | None, inside: Array
) -> npt.NDArray[np.int64]:
    """Return ``(m, 2)`` rows between which the reference moves far enough."""
    pairs: list[tuple[int, int]] = []
    every = max(1, len(stamps_s) // _MOST_PAIRS)
    for begin in range(0, len(stamps_s), every):
        for end in itertools.count(begin + 1):
            if end >= len(stamps_s) or stamps_s[end] - stamps_s[begin] > _SEGMENT_S:
                break
            if segments is not None and segments[end] != segments[begin]:
                break
            if np.linalg.norm(positions[end] - positions[begin]) >= _SEGMENT_M:
                if inside[begin] and inside[end]:
                    pairs.append((begin, end))
                break
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def _solved(A: Array, B: Array, rotation: Array, arm_m: float, kept: Array) -> tuple[float, Array]:
    """Return metres of the reference in a metre of the camera, and the residuals ``(m,)``, metres.

    Solves ``(R_A - I) t + t_A = s R t_B`` for the arm ``t``, which is about *arm_m* long, and ``s``.
    """
    R_reference_camera = rotation.T
    moved = B[:, :3, 3] @ R_reference_camera.T
    rows = np.concatenate([np.eye(3) - A[:, :3, :3], moved[:, :, None]], axis=2)
    wanted = A[:, :3, 3]
    system, right = rows[kept].reshape(-1, 4), wanted[kept].reshape(-1)
    typical_m = 0.01
    prior = np.diag([typical_m / arm_m] * 3 + [0.0])
    found = np.linalg.lstsq(np.vstack([system, prior]), np.concatenate([right, np.zeros(4)]), rcond=None)[0]
    return float(found[3]), np.linalg.norm(rows @ found - wanted, axis=1)


# --- the IMU ----------------------------------------------------------------------------------------------


def _imu_findings(check: RateCheck) -> list[Finding]:
    """Return the findings of a comparison with a gyroscope."""
    if not check.fault:
        return []
    kind = FaultKind.STAMP_DELAY if check.fault == "offset" else FaultKind.SWAPPED_AXES
    is_late = check.fault == "offset"
    # An IMU whose clock is ahead has later stamps: those of the images are earlier.
    return [
        Finding(
            kind=kind, value=-check.offset_s if is_late else 1.0,
            deviation=_DELAY_FLOOR_S if is_late else 0.0, unit="s" if is_late else "",
            cost_m=None, sentence=check.trouble,
            fix="correct the time offset of the rig" if is_late
            else "correct T_imu_camera of the rig; mirrored images turn axes as well",
        )
    ]  # fmt: skip
