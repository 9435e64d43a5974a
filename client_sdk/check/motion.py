"""Compare the motion of a camera with odometry, ground truth or an IMU: stamp delay, scale, axes, mirroring.

Motions over short times are compared, so that neither drift nor the choice of the world frame matters.  If
the calibration is wrong, pass the poses of keyframes that were adjusted together with it.

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
from client_sdk.datasets import Dataset
from client_sdk.imu.checks import RateCheck, check_rates, find_sample_trouble
from client_sdk.imu.history import ImuHistory
from client_sdk.trajectory import Trajectory, read_odometry
from rse_pf.geometry import Array, from_quaternion, inverse, log_se3, rotation_angle_deg, to_quaternion

__all__ = [
    "MIN_ADJUSTED_KEYFRAMES",
    "CameraMotion",
    "MotionReference",
    "check_imu",
    "check_motion",
    "nothing_to_compare",
]

_MIN_STEP_S = 0.45  # shortest time, seconds, over which a motion is compared: over less, noise prevails
_MAX_STEP_S = 1.0  # longest time, seconds, over which a motion is compared
_MAX_PAIRS = 600  # approximate largest number of motions that are compared: bounds the time
_MIN_PAIRS = 20  # fewest motions during which both camera and reference have poses
# Number of consecutive parts of a drive from whose differences standard deviations are computed (jackknife).
_JACKKNIFE_BLOCKS = 10
_MAX_DELAY_S = 0.5  # largest delay of the stamps, in seconds, that is tried in both directions
_DELAY_STEP_S = 0.02  # difference, in seconds, of successive delays that are tried
_DELAY_MODEL_ERROR_S = 0.003  # standard deviation of the stamps' delay that remains in every drive, seconds
_MIN_DELAY_S = 0.01  # smallest delay of the stamps that is reported, seconds
_MAX_DELAY_DEVIATION_S = 0.04  # largest standard deviation, in seconds, of a delay that a drive determines
_DELAY_ERROR_SHARE = 0.1
"""Standard deviation of the stamps' delay as a share of the interval between frames: the motion between two
frames is not known."""
_MAX_RESIDUAL_SHARE = 0.5
"""Largest share of the motions' sum of squares that remains as residuals if camera and reference move
alike."""
# A rotation or mirror fits better than another if its sum of squared residuals is below this share of the
# other sum.
_MAX_BETTER_RATIO = 0.5
# Images are mirrored only if the best mirror leaves at most this many times the sum of squared residuals of
# the best rotation.
_MAX_MIRROR_RATIO = 1.2
_CERTAIN_SIGMAS = 3.0  # a difference is certain if it exceeds this many of its standard deviations
_MAX_AXES_RESIDUAL_SHARE = 0.15
"""Axes and mirroring are checked only if the best rotation or mirror leaves at most this share of the
motions' sum of squares."""
_MIN_AXES_ANGLE_DEG = 20.0  # smallest rotation between the axes of reference and camera that is a fault
# Largest rotation, degrees, between the estimated axes and an exact exchange of axes that a message names.
_MAX_NAMED_AXES_ERROR_DEG = 15.0
# Smallest straight distance, metres, between the ends of a part of the reference's path; the scale is
# computed from such parts, which may overlap.
_SCALE_PART_M = 0.25
# Longest duration, seconds, of a part of a path whose scale is compared: drift bounds it.
_MAX_SCALE_PART_S = 6.0
_MIN_SCALE_PARTS = 12  # fewest parts of a path from whose lengths the scale is computed
MIN_ADJUSTED_KEYFRAMES = 16
"""Fewest adjusted keyframes from which the scale is computed; with fewer ones the tracked poses are used."""
_ODOMETRY_ARM_M = 0.5  # typical distance, metres, of a camera from the frame of an odometry: a prior
# Typical distance, metres, between the camera and a reference that has the poses of the camera itself: a
# prior.
_CAMERA_ARM_M = 0.02
_MIN_SCALE_ERROR = 0.01  # smallest relative error of the scale that is reported
_MAX_RESIDUAL_RATIO = 4.0  # a residual above this many times the median residual is an outlier


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MotionReference:
    """A path with which the motion of a camera is compared.

    Attributes:
        path: Poses, in metres, of the camera or of the body on which it is mounted.
        name: Name of the path in messages, such as ``odometry``.
        is_camera: Whether these are poses of the camera itself, with z along the optical axis.
        scale_deviation: Relative standard deviation of the metric scale of the path.
    """

    path: Trajectory
    name: str = "odometry"
    is_camera: bool = True
    scale_deviation: float = 0.004

    @classmethod
    def of_truth(cls, recording: Dataset) -> MotionReference | None:
        """Return the truth of a recording as a reference; None if it has fewer than two poses."""
        truth = recording.truth
        if truth is None or len(truth) < 2:
            return None
        name = "the truth" if recording.truth_kind == "ground truth" else "the reference poses"
        return cls(path=truth, name=name, is_camera=recording.has_camera_truth)

    @classmethod
    def of_folder(cls, source: Path | str) -> MotionReference | None:
        """Read ``odometry.txt`` (TUM format) in the folder of a recording; None if there is no such file.

        Raises:
            UsageError: The file is broken, or holds fewer than two poses.
        """
        file = Path(source) / "odometry.txt"
        return cls.of_file(file) if file.is_file() else None

    @classmethod
    def of_file(cls, file: Path) -> MotionReference:
        """Read a path in TUM format, of the body on which the camera is mounted.

        Raises:
            UsageError: The file is broken, or holds fewer than two poses.
        """
        return cls(path=read_odometry(file), is_camera=False)


def nothing_to_compare(*, has_depth: bool) -> list[CannotTell]:
    """Return the faults that cannot be found without odometry, ground truth and IMU, with the reasons.

    The last entry is the depth scale if the drive *has_depth*.
    """
    without = "there is no odometry, ground truth or IMU"
    undetermined = [
        CannotTell(FaultKind.STAMP_DELAY, f"{without} to compare the time stamps with"),
        CannotTell(FaultKind.MIRRORED, f"{without} to distinguish it from a drive in a mirrored world"),
        CannotTell(FaultKind.SWAPPED_AXES, f"{without} to compare the axes with"),
    ]
    if has_depth:
        undetermined.append(CannotTell(FaultKind.DEPTH_SCALE, f"{without} to compare the scale with"))
    return undetermined


def check_imu(history: ImuHistory, stamps_s: Array, T_world_camera: Array) -> tuple[list[Finding], list[str]]:
    """Compare the gyroscope with the rotation of the camera; return the findings, and notes for the user.

    A note says that the samples are unusable, that the camera rotates too little, or how the rates differ.

    Args:
        history: The samples of the IMU.
        stamps_s: ``(n,)``, time stamps of the poses.
        T_world_camera: ``(n, 4, 4)``, poses of the camera.
    """
    trouble = find_sample_trouble(history)
    if trouble:
        return [], [f"IMU: {trouble}"]
    check = check_rates(history, stamps_s, T_world_camera[:, :3, :3], 0.0) if len(stamps_s) > 1 else None
    if check is None:
        return [], ["IMU: the camera turns too little to compare it with the gyroscope"]
    return _imu_findings(check), [f"IMU: {check.trouble}"] if check.trouble and not check.fault else []


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraMotion:
    """The tracked motion of a camera.

    Attributes:
        stamps_s: ``(n,)``, ascending time stamps in seconds.
        T_world_camera: ``(n, 4, 4)``, tracked poses.
        segments: ``(n,)``, number of the segment of each pose; poses of different segments are not compared.
            None if there is one segment.
        scale_source: The sensor that determines the metric scale; ``none`` if the poses have no metric scale,
            which is then not compared.
        adjusted: Time stamps ``(k,)`` and poses ``(k, 4, 4)`` of keyframes that were adjusted together with
            the calibration.  The scale is computed from them if there are 16 or more, since a wrong lens
            deforms the tracked path.
        scale_deviation: Relative standard deviation of the metric scale that results from the calibration of
            *adjusted*, or of all poses if *adjusted* is None.
    """

    stamps_s: Array
    T_world_camera: Array
    segments: Array | None = None
    scale_source: Literal["depth", "stereo", "none"] = "depth"
    adjusted: tuple[Array, Array] | None = None
    scale_deviation: float = 0.0


def check_motion(motion: CameraMotion, reference: MotionReference) -> tuple[list[Finding], list[CannotTell]]:
    """Compare the motion of a camera with *reference*; return the faults, and the undetermined faults.

    If only another order of the numbers in the reference's quaternions explains the motions, or if nothing
    explains them, only this fault is returned.
    """
    stamps_s, T_world_camera, segments = motion.stamps_s, motion.T_world_camera, motion.segments
    pairs = _pairs(stamps_s, segments)
    least_s, most_s = reference.path.timestamps_s.min(), reference.path.timestamps_s.max()
    covered = (stamps_s[pairs[:, 0]] - _MAX_DELAY_S >= least_s) & (
        stamps_s[pairs[:, 1]] + _MAX_DELAY_S <= most_s
    )
    pairs = pairs[covered]
    if len(pairs) < _MIN_PAIRS:
        reason = f"{reference.name} and camera have {len(pairs)} motions in common, fewer than {_MIN_PAIRS}"
        return [], [CannotTell(FaultKind.STAMP_DELAY, reason), CannotTell(FaultKind.MIRRORED, reason)]
    seen = _twists(T_world_camera[pairs[:, 0]], T_world_camera[pairs[:, 1]], *stamps_s[pairs.T])
    fits = _fits(seen, stamps_s[pairs], reference)
    best = min(range(len(fits)), key=lambda row: fits[row].cost)
    left = fits[best].left
    if left > _MAX_GOOD_RESIDUAL_SHARE and _explains_reordered(seen, stamps_s[pairs], reference, left):
        return [_quaternion_finding(reference)], []
    if fits[best].left > _MAX_RESIDUAL_SHARE:
        reason = f"the camera does not move as {reference.name} says, at any delay within 0.5 s"
        return [], [CannotTell(FaultKind.STAMP_DELAY, reason), CannotTell(FaultKind.DEPTH_SCALE, reason)]
    findings, undetermined = _delay(fits, seen, reference, float(np.median(np.diff(stamps_s))))
    axes, vague = _axes(fits[best], reference)
    findings += axes
    undetermined += vague
    if motion.scale_source != "none" and not any(each.kind is FaultKind.MIRRORED for each in axes):
        moved_s, poses, doubt = stamps_s, T_world_camera, 0.0 if motion.adjusted else motion.scale_deviation
        if motion.adjusted is not None and len(motion.adjusted[0]) >= MIN_ADJUSTED_KEYFRAMES:
            (moved_s, poses), segments, doubt = motion.adjusted, None, motion.scale_deviation
        by_metres = CameraMotion(
            stamps_s=moved_s - _DELAYS_S[best],
            T_world_camera=poses,
            segments=segments,
            scale_source=motion.scale_source,
            scale_deviation=doubt,
        )
        scale, vague = _scale(by_metres, reference, fits[best].rotation)
        findings += scale
        undetermined += vague
    return findings, undetermined


def _explains_reordered(seen: Array, stamps_s: Array, reference: MotionReference, left: float) -> bool:
    """Return whether the reference fits clearly better if its quaternions have w first instead of last.

    *left* is the residual share (`_Fit.left`) of the best fit with the quaternions as they are.
    """
    quaternions = np.array([to_quaternion(pose[:3, :3]) for pose in reference.path.T_world_camera])
    for order in _QUATERNION_ORDERS:
        poses = reference.path.T_world_camera.copy()
        poses[:, :3, :3] = [from_quaternion(each) for each in quaternions[:, order]]
        other = replace(reference, path=Trajectory(reference.path.timestamps_s, poses))
        if min(fit.left for fit in _fits(seen, stamps_s, other)) <= min(_MAX_RESIDUAL_SHARE, left / 2.0):
            return True
    return False


def _quaternion_finding(reference: MotionReference) -> Finding:
    return Finding(
        kind=FaultKind.SWAPPED_AXES, value=1.0, deviation=0.0, unit="", cost_m=None,
        sentence=f"the quaternions of {reference.name} have w at the wrong end of the four numbers",
        fix="write qx qy qz qw in a file in TUM format, and qw qx qy qz in one of EuRoC",
    )  # fmt: skip


# --- fitting the motions of the camera to those of the reference ---

_MAX_GOOD_RESIDUAL_SHARE = 0.1
"""Largest residual share (`_Fit.left`) of a correct reference, with the noise of a tracker; above it other
orders of the quaternions' numbers are tried."""
_QUATERNION_ORDERS = [1, 2, 3, 0], [3, 0, 1, 2]
"""Indices of x, y, z, w in quaternions whose numbers are in a wrong order: w was written first, and read as
x; or w was written last, and the file was read with w first."""
# Delays of the image stamps that are tried, seconds.
_DELAYS_S: Array = np.arange(-_MAX_DELAY_S, _MAX_DELAY_S + 1e-9, _DELAY_STEP_S)


def _pairs(stamps_s: Array, segments: Array | None) -> npt.NDArray[np.int64]:
    """Return index pairs ``(m, 2)`` of poses 0.45 to 1 s apart in one segment, spread over the drive."""
    later = np.searchsorted(stamps_s, stamps_s + _MIN_STEP_S)
    rows = np.arange(len(stamps_s))
    usable = later < len(stamps_s)
    rows, later = rows[usable], later[usable]
    usable = stamps_s[later] - stamps_s[rows] <= _MAX_STEP_S
    if segments is not None:
        usable &= segments[rows] == segments[later]
    pairs = np.stack([rows[usable], later[usable]], axis=1)
    return np.asarray(pairs[:: max(1, -(-len(pairs) // _MAX_PAIRS))], dtype=np.int64)


def _twists(begins: Array, ends: Array, begins_s: Array, ends_s: Array) -> Array:
    """Return the mean velocities ``(m, 6)`` of the motions between poses: translation m/s, rotation rad/s.

    *begins* and *ends* ``(m, 4, 4)`` are the poses at the times *begins_s* and *ends_s*.
    """
    twists: Array = log_se3(inverse(begins) @ ends) / (ends_s - begins_s)[:, None]
    return twists


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Fit:
    """How the *m* motions of the camera fit those of the reference at one delay, in units of the noise.

    Attributes:
        power: Sum of the squares of the camera's motions.
        rotation: ``(3, 3)``, ``R_camera_reference`` that fits best.
        mirror: ``(3, 3)``, reflection that fits best; that of left and right if the reference has the poses
            of the camera itself.
        squares: ``(m,)``, squared residuals with *rotation*.
        mirrored: ``(m,)``, squared residuals with *mirror*.
        plain: ``(m,)``, squared residuals with equal axes of camera and reference.
    """

    power: float
    rotation: Array
    mirror: Array
    squares: Array
    mirrored: Array
    plain: Array

    @property
    def best(self) -> Array:
        """The squared residuals ``(m,)`` of the mirror if this fits clearly better, else of the rotation."""
        return self.mirrored if self.mirrored.sum() < _MAX_BETTER_RATIO * self.squares.sum() else self.squares

    @property
    def cost(self) -> float:
        """The sum of the squared residuals of rotation or mirror, whichever `best` selects."""
        return float(self.best.sum())

    @property
    def left(self) -> float:
        """The share of the motions' sum of squares that remains as residuals; 0..1 for a usable fit."""
        return self.cost / max(self.power, 1e-12)


def _fits(seen: Array, stamps_s: Array, reference: MotionReference) -> list[_Fit]:
    """Return the fit of camera and reference at each of `_DELAYS_S`, with outliers of the best fit rejected.

    *seen* ``(m, 6)`` are the velocities of the camera (m/s, then rad/s); *stamps_s* ``(m, 2)`` are begin and
    end of each motion, seconds.
    """
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
        kept = (size <= _MAX_RESIDUAL_RATIO * typical).all(axis=1)
        noise = typical
    return fits


def _fit(seen: Array, measured: Array, noise: Array, kept: Array, *, is_camera: bool) -> _Fit:
    weights = np.repeat(1.0 / noise, 3) * kept[:, None]
    one, other = seen * weights, measured * weights
    other[:, :3] *= _ratio(seen[kept, :3], measured[kept, :3])
    # Translations are vectors, but angular rates are pseudovectors: a reflection also changes their sign.
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
    squares: Array = np.square(one - _rotate_twists(other, axes)).sum(axis=1)
    return squares


def _rotate_twists(twists: Array, axes: Array) -> Array:
    """Transform velocities ``(m, 6)`` by *axes* ``(3, 3)``, a rotation or a reflection."""
    sign = np.sign(np.linalg.det(axes))
    return np.concatenate([twists[:, :3] @ axes.T, sign * twists[:, 3:] @ axes.T], axis=1)


def _residuals(seen: Array, measured: Array, fit: _Fit) -> Array:
    scaled = measured.copy()
    scaled[:, :3] *= _ratio(seen[:, :3], measured[:, :3])
    left: Array = seen - _rotate_twists(scaled, fit.mirror if fit.best is fit.mirrored else fit.rotation)
    return left


def _ratio(one: Array, other: Array) -> float:
    return float(np.sqrt(np.square(one).sum() / max(np.square(other).sum(), 1e-12)))


# --- findings from the fitted motions: delay, axes, scale ---


def _delay(
    fits: list[_Fit], seen: Array, reference: MotionReference, interval_s: float
) -> tuple[list[Finding], list[CannotTell]]:
    """Return the finding on the delay of the image stamps, or why the drive does not determine it.

    *interval_s* is the interval between frames; no result if the delay is too small to matter.
    """
    squares = np.array([fit.best for fit in fits])
    blocks = np.arange(squares.shape[1]) * _JACKKNIFE_BLOCKS // squares.shape[1]
    total = squares.sum(axis=1)
    without = [total - squares[:, blocks == block].sum(axis=1) for block in range(_JACKKNIFE_BLOCKS)]
    delay_s, deviation_s = _jackknife(_lowest(total), np.array([_lowest(each) for each in without]))
    deviation_s = math.hypot(deviation_s, _DELAY_MODEL_ERROR_S, _DELAY_ERROR_SHARE * interval_s)
    is_large = abs(delay_s) >= max(_MIN_DELAY_S, _CERTAIN_SIGMAS * deviation_s)
    # A delay that fits only slightly better, in some parts of the drive, is chance: a robot on wheels at
    # constant speed moves nearly the same at every delay.
    is_chance = is_large and not _explains(squares[int(np.argmin(total))], squares[len(fits) // 2])
    if deviation_s > _MAX_DELAY_DEVIATION_S or is_chance:
        reason = f"neither speed nor rotation changes enough for {reference.name}: delay within "
        within_s = _CERTAIN_SIGMAS * deviation_s + (abs(delay_s) if is_chance else 0.0)
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
    """Return the delay with the lowest cost, seconds, refined between the steps by a parabola.

    *costs* has one entry for each of `_DELAYS_S`.
    """
    at = int(np.argmin(costs))
    if not 0 < at < len(costs) - 1:
        return float(_DELAYS_S[at])
    before, here, after = costs[at - 1 : at + 2]
    bend = before - 2.0 * here + after
    return float(_DELAYS_S[at] + (0.5 * _DELAY_STEP_S * (before - after) / bend if bend > 0 else 0.0))


def _jackknife(whole: float, parts: Array) -> tuple[float, float]:
    """Return the value *whole*, and its standard deviation by the jackknife.

    *parts* ``(n,)`` are the values that result if one of *n* blocks of the drive is left out.
    """
    n = len(parts)
    return whole, float(np.sqrt((n - 1) / n * np.square(parts - parts.mean()).sum()))


def _is_better(one: Array, other: Array) -> bool:
    """Return whether the squares *one* sum to less than half of *other*, consistently over the drive."""
    return bool(one.sum() < _MAX_BETTER_RATIO * other.sum() and _is_certain(one, other))


def _explains(one: Array, other: Array) -> bool:
    """Return whether the squares *one* sum to less than half of *other*, or are consistently lower."""
    return bool(one.sum() < _MAX_BETTER_RATIO * other.sum() or _is_certain(one, other))


def _is_certain(one: Array, other: Array) -> bool:
    """Return whether the squares *one* ``(m,)`` sum to less than *other* with three standard deviations.

    The deviation is computed from the differences in ten consecutive blocks of the drive.
    """
    blocks = np.arange(len(one)) * _JACKKNIFE_BLOCKS // len(one)
    gains = np.array([(other - one)[blocks == block].sum() for block in range(_JACKKNIFE_BLOCKS)])
    return bool(gains.sum() > _CERTAIN_SIGMAS * float(gains.std(ddof=1)) * math.sqrt(_JACKKNIFE_BLOCKS))


def _axes(fit: _Fit, reference: MotionReference) -> tuple[list[Finding], list[CannotTell]]:
    """Return the finding on mirrored images or different axes, or why the drive does not determine it."""
    if fit.left > _MAX_AXES_RESIDUAL_SHARE:
        return [], [CannotTell(FaultKind.MIRRORED, f"the camera moves only roughly as {reference.name} says")]
    own = fit.plain if reference.is_camera else fit.squares
    if _is_better(fit.mirrored, own) and fit.mirrored.sum() < _MAX_MIRROR_RATIO * fit.squares.sum():
        finding = Finding(
            kind=FaultKind.MIRRORED, value=1.0, deviation=0.0, unit="", cost_m=None,
            sentence=f"the images are mirrored: compared with {reference.name} the camera rotates against "
            "the direction of its motion",
            fix="switch off the mirror of the camera or driver, and record again",
        )  # fmt: skip
        return [finding], []
    undetermined: list[CannotTell] = []
    if not _is_better(own, fit.mirrored):
        plane = f"the camera of {reference.name} moves and rotates in one plane: a mirror changes nothing"
        undetermined.append(CannotTell(FaultKind.MIRRORED, plane))
    if not reference.is_camera:
        reason = f"how the camera is mounted in the frame of {reference.name} is not known"
        return [], [*undetermined, CannotTell(FaultKind.SWAPPED_AXES, reason)]
    angle = rotation_angle_deg(fit.rotation)
    if angle < _MIN_AXES_ANGLE_DEG or not _is_better(fit.squares, fit.plain):
        return [], undetermined
    named = _named_axes(fit.rotation)
    finding = Finding(
        kind=FaultKind.SWAPPED_AXES, value=1.0, deviation=0.0, unit="", cost_m=None,
        sentence=f"the axes of {reference.name} are turned by {angle:.0f} degrees from those of the camera"
        + (f": its {named} are the camera's x, y, z" if named else ""),
        fix="give poses of the camera, with x right, y down and z ahead, or correct the mounting",
    )  # fmt: skip
    return [finding], undetermined


def _named_axes(rotation: Array) -> str:
    """Name the axes of the reference that are the camera's x, y and z, such as ``-y, -z, x``.

    Empty if *rotation* is more than 15 degrees from every exchange of axes.
    """
    rows = np.abs(rotation).argmax(axis=1)
    named = np.zeros((3, 3))
    named[range(3), rows] = np.sign(rotation[range(3), rows])
    is_whole = sorted(rows.tolist()) == [0, 1, 2]
    if not is_whole or rotation_angle_deg(named.T @ rotation) > _MAX_NAMED_AXES_ERROR_DEG:
        return ""
    return ", ".join(("-" if rotation[row, at] < 0 else "") + "xyz"[at] for row, at in enumerate(rows))


def _scale(
    motion: CameraMotion, reference: MotionReference, rotation: Array
) -> tuple[list[Finding], list[CannotTell]]:
    """Return the finding on the metric scale of the camera, or why the drive does not determine it.

    *rotation* is ``R_camera_reference``.
    """
    stamps_s, T_world_camera, segments = motion.stamps_s, motion.T_world_camera, motion.segments
    path = reference.path
    kind = FaultKind.BASELINE if motion.scale_source == "stereo" else FaultKind.DEPTH_SCALE
    inside = (stamps_s >= path.timestamps_s.min()) & (stamps_s <= path.timestamps_s.max())
    rows = _segments(stamps_s, path.at(stamps_s)[:, :3, 3], segments, inside)
    if len(rows) < _MIN_SCALE_PARTS:
        reason = f"{len(rows)} parts of the path of {reference.name} are {_SCALE_PART_M:g} m long"
        return [], [CannotTell(kind, reason)]
    A = inverse(path.at(stamps_s[rows[:, 0]])) @ path.at(stamps_s[rows[:, 1]])
    B = inverse(T_world_camera[rows[:, 0]]) @ T_world_camera[rows[:, 1]]
    arm_m = _CAMERA_ARM_M if reference.is_camera else _ODOMETRY_ARM_M
    kept = np.ones(len(rows), dtype=bool)
    for _ in range(4):
        scale, left = _solve_scale(A, B, rotation, arm_m, kept)
        kept = left <= _MAX_RESIDUAL_RATIO * max(float(np.median(left[kept])), 1e-6)
    blocks = np.arange(len(rows)) * _JACKKNIFE_BLOCKS // len(rows)
    without = np.array(
        [_solve_scale(A, B, rotation, arm_m, kept & (blocks != each))[0] for each in range(_JACKKNIFE_BLOCKS)]
    )
    scale, deviation = _jackknife(_solve_scale(A, B, rotation, arm_m, kept)[0], without)
    if not 1e-3 < scale < 1e3:
        return [], [CannotTell(kind, f"paths of camera and {reference.name} do not fit")]
    deviation = math.hypot(deviation, reference.scale_deviation * scale, motion.scale_deviation * scale)
    value = scale - 1.0
    if abs(value) < max(_MIN_SCALE_ERROR, _CERTAIN_SIGMAS * deviation):
        vague = _CERTAIN_SIGMAS * deviation
        what = kind.value.replace("_", " ")
        why = f"parts of the path differ from {reference.name}"
        if motion.scale_deviation > 0.7 * deviation / scale:
            why = "the uncertainty of the calibration changes the scale as well"
        reason = f"{why}: {what} within {100 * vague:.0f} %"
        return [], [CannotTell(kind, reason, vague)] if vague > 0.05 else []
    positions = path.at(stamps_s[inside])[:, :3, 3]
    reach_m = float(np.sqrt(np.square(positions - positions.mean(axis=0)).sum(axis=1).mean()))
    cost_m = abs(1.0 / scale - 1.0) * reach_m
    if motion.scale_source == "stereo":
        # The scale of a stereo path grows with the baseline; that of a depth camera shrinks with depth_scale.
        factor = _times(1.0 / scale, deviation / scale**2)
        sentence = f"the baseline is set {factor} compared with {reference.name}"
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
    """Return the factor *scale* by which a setting is wrong as a phrase that follows the words "is set"."""
    if 0.5 < scale < 2.0:
        return (
            f"{100 * abs(scale - 1):.1f} +- {100 * deviation:.1f} % too {'large' if scale > 1 else 'small'}"
        )
    return f"to {scale:.3g} +- {deviation:.2g} times what it should be"


def _segments(
    stamps_s: Array, positions: Array, segments: Array | None, inside: Array
) -> npt.NDArray[np.int64]:
    """Return index pairs ``(m, 2)`` of poses within 6 s between which the reference moves 0.25 m or more.

    Args:
        stamps_s: ``(n,)``, times of the poses.
        positions: ``(n, 3)``, positions of the reference at these times, metres.
        segments: ``(n,)``, numbers of the segments of the poses; None if there is one segment.
        inside: ``(n,)``, whether the reference covers these times.
    """
    pairs: list[tuple[int, int]] = []
    every = max(1, len(stamps_s) // _MAX_PAIRS)
    for begin in range(0, len(stamps_s), every):
        for end in itertools.count(begin + 1):
            if end >= len(stamps_s) or stamps_s[end] - stamps_s[begin] > _MAX_SCALE_PART_S:
                break
            if segments is not None and segments[end] != segments[begin]:
                break
            if np.linalg.norm(positions[end] - positions[begin]) >= _SCALE_PART_M:
                if inside[begin] and inside[end]:
                    pairs.append((begin, end))
                break
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def _solve_scale(A: Array, B: Array, rotation: Array, arm_m: float, kept: Array) -> tuple[float, Array]:
    """Return the scale: metres of the reference per metre of the camera; and the residuals ``(m,)``, metres.

    Solves ``(R_A - I) t + t_A = s R t_B`` for the scale ``s`` and for the position ``t`` of the camera in the
    frame of the reference.  ``R`` is the inverse of *rotation*, which is ``R_camera_reference``.  A prior on
    ``t`` has the mean 0 and the standard deviation *arm_m*.  *A* and *B* ``(m, 4, 4)`` are the motions of
    reference and camera, and *kept* ``(m,)`` says whose equations are solved; residuals are those of all.
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


def _imu_findings(check: RateCheck) -> list[Finding]:
    """Return the fault of a comparison with the gyroscope as a finding; an empty list without a fault."""
    if not check.fault:
        return []
    kind = FaultKind.STAMP_DELAY if check.fault == "offset" else FaultKind.SWAPPED_AXES
    is_late = check.fault == "offset"
    # A positive offset means that the IMU stamps are later, so the image stamps are earlier: negative value.
    return [
        Finding(
            kind=kind, value=-check.offset_s if is_late else 1.0,
            deviation=_DELAY_MODEL_ERROR_S if is_late else 0.0, unit="s" if is_late else "",
            cost_m=None, sentence=check.trouble,
            fix="correct the time offset of the rig" if is_late
            else "correct T_imu_camera of the rig; mirrored images turn axes as well",
        )
    ]  # fmt: skip
