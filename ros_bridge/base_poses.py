"""Compute the poses of a robot's base in the map and in the odometry frame, and the transform between them.

The transform from map to odometry frame is ``T_map_base inverse(T_odom_base)``, both at the time of an image.
``T_odom_base`` is that of the robot's own odometry, interpolated; without one it is the visual odometry.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from client_sdk.frontend import TrackedFrame
from ros_bridge.robot_frames import RobotFrames
from rse_pf.geometry import Array, exp_se3, inverse, log_se3, planar_pose, skew

__all__ = ["BasePose", "BasePoses", "project_to_plane", "with_alignment"]

# Covariance (6, 6) of a pose without one: so large that filters give the pose no weight.
_UNKNOWN = np.diag(np.full(6, 1e6))
# Largest number of poses that wait for odometry of a later time: 3 s at 30 Hz.
_MAX_WAITING = 100
# Rows of height, roll and pitch in the covariance of a pose: 0 for a planar robot, as AMCL publishes them.
_NOT_PLANAR = [2, 3, 4]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BasePose:
    """The pose of the base at the time of an image, ``(4, 4)``, with its covariances ``(6, 6)``.

    Attributes:
        T_world_base: In the world of the mapper.
        T_map_base: In the map; None while the pose of the world in the map is not known.
        map_covariance: Of position and rotation about the axes of the map.
        T_odom_base: By visual odometry in the odometry frame; None before the robot's own odometry is known,
            and while that odometry carries the pose.
        odom_covariance: Of position and rotation about the axes of the odometry frame.
    """

    T_world_base: Array
    T_map_base: Array | None
    map_covariance: Array
    T_odom_base: Array | None
    odom_covariance: Array


def project_to_plane(T: Array) -> Array:
    """Return the pose ``(4, 4)`` in the plane z = 0 with x, y and yaw of *T*."""
    return planar_pose(T[0, 3], T[1, 3], math.atan2(T[1, 0], T[0, 0]))


def with_alignment(covariance: Array, T_map_base: Array, alignment: Array) -> Array:
    """Return the covariance ``(6, 6)`` of a pose in the map: that of the pose plus that of the alignment.

    Args:
        covariance: ``(6, 6)``, of position and rotation in the map if the alignment were exact.
        T_map_base: ``(4, 4)``, the pose in the map.
        alignment: ``(6, 6)``, of the twist (metres, radians) on the left of ``T_map_world``.
    """
    lever = np.eye(6)
    lever[:3, 3:] = -skew(T_map_base[:3, 3])
    moved: Array = covariance + lever @ alignment @ lever.T
    return moved


class BasePoses:
    """The poses of one robot's base.  Any thread may call `map_to_odom`."""

    def __init__(self, frames: RobotFrames, max_correction_m_s: float) -> None:
        self._frames, self._max_correction_m_s = frames, max_correction_m_s
        self._waiting: deque[tuple[int, BasePose]] = deque(maxlen=_MAX_WAITING)
        self._T_odom_world: Array | None = None
        self._T_odom_base: Array | None = None
        self._newest: Array | None = None
        self._published: Array | None = None
        self._was_foreign = False
        self._lock = threading.Lock()

    def add(
        self, tracked: TrackedFrame, stamp_ns: int, T_map_world: Array | None, alignment: Array | None = None
    ) -> BasePose | None:
        """Return the pose of the base at the time of a frame; None for a frame without a pose.

        Args:
            tracked: The result of the mapper.
            stamp_ns: Time stamp of the frame's images.
            T_map_world: ``(4, 4)``, pose of the mapper's world in the map; None if it is not known.
            alignment: ``(6, 6)``, covariance of *T_map_world*; None if it is unknown or zero.
        """
        with self._lock:
            is_foreign = self._follow_odometry()
            if T_map_world is None and not is_foreign:
                self._newest = self._published = None  # the visual odometry does not bridge a loss
            T_world_base, covariance = self._of_base(tracked)
            if T_world_base is None:
                return None
            if tracked.T_new_old is not None and self._T_odom_world is not None:
                self._T_odom_world = self._T_odom_world @ inverse(tracked.T_new_old)
            pose = self._pose(T_world_base, covariance, T_map_world, alignment)
            if tracked.pose_source == "odometry":
                pose = replace(pose, T_odom_base=None)
            else:
                self._waiting.append((stamp_ns, pose))
            self._correct()
            return pose

    def restart_clock(self) -> None:
        """Forget the poses that wait for odometry, because the time stamps begin anew."""
        with self._lock:
            self._waiting.clear()

    @property
    def is_odom_known(self) -> bool:
        """Whether the pose of the odometry frame in the map is known."""
        with self._lock:
            return self._newest is not None

    def map_to_odom(self, elapsed_s: float) -> Array | None:
        """Return the pose ``(4, 4)`` of the odometry frame in the map to publish; None if it is not known.

        Args:
            elapsed_s: Time since the last call, which limits how far a correction may move the base.
        """
        with self._lock:
            self._follow_odometry()
            self._correct()
            if self._newest is None or self._T_odom_base is None:
                return None
            before = self._published
            self._published = self._newest
            if before is not None and self._max_correction_m_s > 0:
                # Move the base, not the odometry frame, which may be far from the robot, on a screw motion.
                T_before, T_after = before @ self._T_odom_base, self._newest @ self._T_odom_base
                twist = log_se3((inverse(T_before) @ T_after)[None])[0]
                step_m = max(float(np.linalg.norm(twist[:3])), float(np.linalg.norm(twist[3:])))
                largest_m = self._max_correction_m_s * elapsed_s
                if step_m > largest_m:
                    T_now = T_before @ exp_se3(largest_m / step_m * twist)
                    self._published = T_now @ inverse(self._T_odom_base)
            return self._published

    def _follow_odometry(self) -> bool:
        """Forget what was computed with other odometry; return whether the robot has odometry of its own."""
        is_foreign = self._frames.is_odometry_foreign
        if is_foreign != self._was_foreign:
            self._was_foreign = is_foreign
            self._T_odom_world = self._T_odom_base = self._newest = self._published = None
            self._waiting.clear()
        return is_foreign

    def _of_base(self, tracked: TrackedFrame) -> tuple[Array | None, Array | None]:
        """Return pose and covariance of the base, which may be the camera, in the mapper's world."""
        if self._frames.T_base_camera is not None:
            return tracked.T_world_base, tracked.pose_covariance
        pose, covariance = tracked.T_world_camera, tracked.covariance
        if pose is None or covariance is None:
            return pose, None
        # exp(xi) T_camera_world has the inverse T_world_camera exp(-xi): both parts turn into the world.
        return pose, _rotated(covariance, pose)

    def _pose(
        self,
        T_world_base: Array,
        covariance: Array | None,
        T_map_world: Array | None,
        alignment: Array | None,
    ) -> BasePose:
        T_map_base, map_covariance = None, _UNKNOWN
        if T_map_world is not None:
            T_map_base = T_map_world @ T_world_base
            if covariance is not None:
                map_covariance = _rotated(covariance, T_map_world)
                if alignment is not None:
                    map_covariance = with_alignment(map_covariance, T_map_base, alignment)
        T_odom_world = self._T_odom_world if self._was_foreign else np.eye(4)
        T_odom_base, odom_covariance = None, _UNKNOWN
        if T_odom_world is not None:
            T_odom_base = T_odom_world @ T_world_base
            if covariance is not None:
                odom_covariance = _rotated(covariance, T_odom_world)
        if self._frames.is_planar:
            T_map_base = None if T_map_base is None else project_to_plane(T_map_base)
            T_odom_base = None if T_odom_base is None else project_to_plane(T_odom_base)
            map_covariance, odom_covariance = _planar(map_covariance), _planar(odom_covariance)
        return BasePose(
            T_world_base=T_world_base, T_map_base=T_map_base, map_covariance=map_covariance,
            T_odom_base=T_odom_base, odom_covariance=odom_covariance,
        )  # fmt: skip

    def _correct(self) -> None:
        """Compute the transform from map to odometry frame with the newest pose whose odometry is known."""
        for row in reversed(range(len(self._waiting))):
            stamp_ns, pose = self._waiting[row]
            T_odom_base = self._frames.T_odom_base(stamp_ns) if self._was_foreign else pose.T_odom_base
            if T_odom_base is None:
                continue
            for _ in range(row + 1):
                self._waiting.popleft()
            self._T_odom_base = T_odom_base
            if self._T_odom_world is None:
                self._T_odom_world = T_odom_base @ inverse(pose.T_world_base)
            if pose.T_map_base is not None:
                self._newest = pose.T_map_base @ inverse(T_odom_base)
            return


def _rotated(covariance: Array, T_new_old: Array) -> Array:
    """Return a covariance ``(6, 6)`` of position and rotation, m and rad, about the axes of the new frame.

    Only the rotation of ``T_new_old`` is used.
    """
    rotation = np.zeros((6, 6))
    rotation[:3, :3] = rotation[3:, 3:] = T_new_old[:3, :3]
    rotated: Array = rotation @ covariance @ rotation.T
    return rotated


def _planar(covariance: Array) -> Array:
    planar: Array = covariance.copy()
    planar[_NOT_PLANAR] = 0.0
    planar[:, _NOT_PLANAR] = 0.0
    return planar
