"""Classify what went wrong with the commands of a recording."""

from __future__ import annotations

import statistics
from collections import deque

import msgspec
import numpy as np

from rse_pf.errors import RsePfError
from rse_pf.extensions.recording.reader import RecordedCommand
from rse_pf.extensions.recording.replay.solving import pnp_reply, solver_codes
from rse_pf.geometry import Array, inverse, pose_difference
from rse_pf.wire import Failure
from rse_pf.wire.arrays import decode_hook

__all__ = ["KINDS", "LATE_MS", "RobotHistory", "Trouble"]

LATE_MS = 200.0
"""Largest round trip, ms, of a command without a deadline that is not late: at five frames a second the robot
sends the next frame then."""

KINDS = ("failed", "jump", "unanswered", "expired", "weak", "refused", "late")
"""What can go wrong with a command, worst first: an error of the solver; a pose that the camera cannot have
reached; no recorded answer; an answer that was no longer needed; a weak pose; a refusal before solving; an
answer after the deadline."""

# Codes of failures that mean that the answer was no longer needed, with the kind of trouble.
_EXPIRED_CODES = {"expired": "expired", "stale": "expired", "cancelled": "expired"}
# Fewest world points that two commands must have in common: fewer show that their world frames may differ.
_MIN_COMMON_POINTS = 8
_PERIOD_COMMANDS = 10  # number of the newest commands of a robot from whose times its period is computed
_MAX_SPEED_M_S = 3.0  # largest speed of a robot that is no jump, m/s
_MAX_ROTATION_DEG_S = 180.0  # largest angular rate of a robot that is no jump, degrees per second
_MIN_JUMP_M = 0.3  # smallest translation that is a jump, metres: noise is smaller
_MIN_JUMP_DEG = 15.0  # smallest rotation that is a jump, degrees: noise is smaller
# Largest difference from odometry that is no jump, as a share of the motion by odometry.
_MAX_ODOMETRY_DIFFERENCE = 0.3


class Trouble(msgspec.Struct, frozen=True, kw_only=True):
    """What went wrong with one command.

    Attributes:
        id: ``CONNECTION:ID`` of the command.
        robot: Pseudonym of the robot.
        sent_s: Unix time at which the command was recorded.
        kind: One of `KINDS`.
        what: Phrase for the user, with numbers.
        size: Severity among troubles of the same kind, without a unit; larger is worse.
    """

    id: str
    robot: str
    sent_s: float
    kind: str
    what: str
    size: float = 0.0

    @property
    def order(self) -> tuple[int, float, float]:
        """Sort key: the worst trouble comes first."""
        return KINDS.index(self.kind), -self.size, self.sent_s


class _Answered(msgspec.Struct, frozen=True):
    sent_s: float
    T_camera_world: Array
    points: frozenset[bytes]
    T_odom_camera: Array | None


class RobotHistory:
    """The last commands of one robot, with which its next command is classified."""

    def __init__(self) -> None:
        self._last: _Answered | None = None
        self._sent_s: deque[float] = deque(maxlen=_PERIOD_COMMANDS)

    def classify(self, command: RecordedCommand) -> Trouble | None:
        """Return what went wrong with *command*, None if nothing did; commands are passed in their order."""
        self._sent_s.append(command.sent_s)
        try:
            verdict = self._find_trouble(command)
        except RsePfError as error:
            verdict = "failed", f"its bytes cannot be read: {error.message}", 0.0
        if verdict is None:
            return None
        kind, what, size = verdict
        return Trouble(
            id=command.id, robot=command.robot, sent_s=command.sent_s, kind=kind, what=what, size=size
        )

    @property
    def period_s(self) -> float | None:
        """Median time between two of the last ten commands, seconds; None before the third command."""
        gaps = np.diff(np.array(self._sent_s))
        return float(statistics.median(gaps)) if len(gaps) > 1 else None

    def _find_trouble(self, command: RecordedCommand) -> tuple[str, str, float] | None:
        reply = command.reply
        if reply is None:
            return "unanswered", "no answer was recorded", 0.0
        took_ms = command.round_trip_ms or 0.0
        if isinstance(reply, Failure):
            sentence = f"{reply.code}: {reply.message}"
            if reply.code in solver_codes():
                return "failed", sentence, 0.0
            return _EXPIRED_CODES.get(reply.code, "refused"), sentence, 0.0
        pose = pnp_reply(reply)
        if pose is not None:
            jump = self._jump(command, pose.solution().T_camera_world)
            if jump is not None:
                return jump
            if pose.verdict != "ok":
                inliers = pose.inliers.size
                return "weak", f"{pose.reason}: {inliers} inliers, {pose.rmse_px:.2f} px", 1.0 / (1 + inliers)
        allowed_ms = command.command.deadline_ms or LATE_MS
        if took_ms > allowed_ms:
            return (
                "late",
                f"answered after {took_ms:.0f} ms, {allowed_ms:.0f} ms are allowed",
                took_ms / allowed_ms,
            )
        return None

    def _jump(self, command: RecordedCommand, T_camera_world: Array) -> tuple[str, str, float] | None:
        """Return the trouble if the camera cannot have reached the pose since the last answer, else None.

        The motion is compared with odometry if both commands have it, else with the largest speed of a robot.
        Commands with fewer than 8 world points in common are not compared.
        """
        odometry = None if command.odometry is None else command.odometry.T_odom_camera
        now = _Answered(command.sent_s, T_camera_world, _points(command), odometry)
        last, self._last = self._last, now
        if last is None or len(last.points & now.points) < _MIN_COMMON_POINTS:
            return None  # the poses may have different world frames, such as those of two keyframes
        moved = last.T_camera_world @ inverse(T_camera_world)
        seconds = max(1e-3, now.sent_s - last.sent_s)
        if odometry is not None and last.T_odom_camera is not None:
            expected = inverse(last.T_odom_camera) @ odometry
            metres, degrees = pose_difference(moved, expected)
            way_m, way_deg = pose_difference(expected, np.eye(4))
            most_m = max(_MIN_JUMP_M, _MAX_ODOMETRY_DIFFERENCE * way_m)
            most_deg = max(_MIN_JUMP_DEG, _MAX_ODOMETRY_DIFFERENCE * way_deg)
            against = "against odometry"
        else:
            metres, degrees = pose_difference(moved, np.eye(4))
            most_m = max(_MIN_JUMP_M, _MAX_SPEED_M_S * seconds)
            most_deg = max(_MIN_JUMP_DEG, _MAX_ROTATION_DEG_S * seconds)
            against = f"in {seconds:.2f} s"
        size = max(metres / most_m, degrees / most_deg)
        if size <= 1.0:
            return None
        return "jump", f"the pose jumped by {metres:.2f} m and {degrees:.0f} deg {against}", size


def _points(command: RecordedCommand) -> frozenset[bytes]:
    """Return the world points of a `pnp` command as a set of bytes; empty if it has none."""
    payload = command.command.payload
    if not isinstance(payload, dict):
        return frozenset()
    try:
        flat = decode_hook(np.ndarray, payload.get("points_world"))
    except RsePfError:
        return frozenset()
    rows = flat[: flat.size // 3 * 3].reshape(-1, 3)
    return frozenset(row.tobytes() for row in rows)
