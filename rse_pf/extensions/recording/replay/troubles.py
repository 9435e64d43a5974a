"""Say what went wrong with the commands of a recording, worst first."""

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
"""A robot that sends five frames a second has sent the next one by then."""

KINDS = ("failed", "jump", "unanswered", "expired", "weak", "refused", "late")
"""What can go wrong, worst first."""

_WITHOUT_WORK = {"expired": "expired", "stale": "expired", "cancelled": "expired"}
_SAME_POINTS = 8
_KEPT = 10
# A robot does not move faster, nor turn; at least so much more than noise.
_MAX_SPEED_M_S, _MAX_TURN_DEG_S, _LEAST_JUMP_M, _LEAST_JUMP_DEG = 3.0, 180.0, 0.3, 15.0
_ODOMETRY_SHARE = 0.3


class Trouble(msgspec.Struct, frozen=True, kw_only=True):
    """One command that went wrong.

    Attributes:
        id: ``CONNECTION:ID``.
        robot: Its pseudonym.
        sent_s: Unix time.
        kind: One of `KINDS`.
        what: In words, with numbers.
        size: Larger is worse, among those of one kind.
    """

    id: str
    robot: str
    sent_s: float
    kind: str
    what: str
    size: float = 0.0

    @property
    def order(self) -> tuple[int, float, float]:
        """Sorts the worst to the front."""
        return KINDS.index(self.kind), -self.size, self.sent_s


class _Past(msgspec.Struct, frozen=True):
    sent_s: float
    T_camera_world: Array
    points: frozenset[bytes]
    T_odom_camera: Array | None


class RobotHistory:
    """What one robot did last; judges its next command."""

    def __init__(self) -> None:
        self._last: _Past | None = None
        self._sent_s: deque[float] = deque(maxlen=_KEPT)

    def judge(self, command: RecordedCommand) -> Trouble | None:
        """Return the worst that went wrong with *command*, None if all is well."""
        self._sent_s.append(command.sent_s)
        try:
            verdict = self._judge(command)
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
        """The usual time between two commands, None before the third."""
        gaps = np.diff(np.array(self._sent_s))
        return float(statistics.median(gaps)) if len(gaps) > 1 else None

    def _judge(self, command: RecordedCommand) -> tuple[str, str, float] | None:
        reply = command.reply
        if reply is None:
            return "unanswered", "no answer was recorded", 0.0
        took_ms = command.round_trip_ms or 0.0
        if isinstance(reply, Failure):
            sentence = f"{reply.code}: {reply.message}"
            if reply.code in solver_codes():
                return "failed", sentence, 0.0
            return _WITHOUT_WORK.get(reply.code, "refused"), sentence, 0.0
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
        """Return how far the pose is from where the camera can be, None if it can be there."""
        odometry = None if command.odometry is None else command.odometry.T_odom_camera
        now = _Past(command.sent_s, T_camera_world, _points(command), odometry)
        last, self._last = self._last, now
        if last is None or len(last.points & now.points) < _SAME_POINTS:
            return None  # of another world frame, such as another keyframe
        moved = last.T_camera_world @ inverse(T_camera_world)
        seconds = max(1e-3, now.sent_s - last.sent_s)
        if odometry is not None and last.T_odom_camera is not None:
            expected = inverse(last.T_odom_camera) @ odometry
            metres, degrees = pose_difference(moved, expected)
            way_m, way_deg = pose_difference(expected, np.eye(4))
            most_m = max(_LEAST_JUMP_M, _ODOMETRY_SHARE * way_m)
            most_deg = max(_LEAST_JUMP_DEG, _ODOMETRY_SHARE * way_deg)
            against = "against odometry"
        else:
            metres, degrees = pose_difference(moved, np.eye(4))
            most_m = max(_LEAST_JUMP_M, _MAX_SPEED_M_S * seconds)
            most_deg = max(_LEAST_JUMP_DEG, _MAX_TURN_DEG_S * seconds)
            against = f"in {seconds:.2f} s"
        size = max(metres / most_m, degrees / most_deg)
        if size <= 1.0:
            return None
        return "jump", f"the pose jumped by {metres:.2f} m and {degrees:.0f} deg {against}", size


def _points(command: RecordedCommand) -> frozenset[bytes]:
    """Return the world points of a `pnp` command, as bytes that are equal for equal points."""
    payload = command.command.payload
    if not isinstance(payload, dict):
        return frozenset()
    try:
        flat = decode_hook(np.ndarray, payload.get("points_world"))
    except RsePfError:
        return frozenset()
    rows = flat[: flat.size // 3 * 3].reshape(-1, 3)
    return frozenset(row.tobytes() for row in rows)
