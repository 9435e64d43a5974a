"""Turn tracked frames into ROS messages, with the time stamps of the frames.

The platform states the covariance of a twist that is multiplied on the left of ``T_camera_world``.  ROS
expects the covariance of the camera's position, and of its rotation about the fixed axes of the parent frame.
`ros_covariance` and `with_alignment` convert them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from client_sdk.bags.message_maker import MessageMaker
from client_sdk.bags.message_types import (
    DIAGNOSTICS,
    ODOMETRY,
    PATH,
    POINT_CLOUD,
    POSE_WITH_COVARIANCE,
    TF,
)
from client_sdk.frontend import TrackedFrame
from ros_bridge.options import BridgeOptions
from rse_pf.geometry import Array

__all__ = ["Message", "OutgoingMessages", "advertised", "ros_covariance", "with_alignment"]

# Covariance (6, 6) of a pose without one: so large that filters give the pose no weight.
_UNKNOWN = np.diag(np.full(6, 1e6))
# Levels of ``diagnostic_msgs/DiagnosticStatus``.
_OK, _WARNING, _ERROR = 0, 1, 2


@dataclass(frozen=True, slots=True)
class Message:
    """An encoded message: the name of its topic, its type as ROS 2 names it, and its bytes."""

    topic: str
    kind: str
    data: bytes


def ros_covariance(covariance: Array, T_world_camera: Array) -> Array:
    """Return the covariance ``(6, 6)`` of the camera's position and rotation in the world frame.

    Args:
        covariance: ``(6, 6)``, of the twist (metres, radians) on the left of ``T_camera_world``.
        T_world_camera: ``(4, 4)``, the pose of the camera.
    """
    # exp(xi) T_camera_world has the inverse T_world_camera exp(-xi): both parts are rotated into the world.
    rotation = np.zeros((6, 6))
    rotation[:3, :3] = rotation[3:, 3:] = T_world_camera[:3, :3]
    rotated: Array = rotation @ covariance @ rotation.T
    return rotated


def with_alignment(covariance: Array, T_map_camera: Array, alignment: Array) -> Array:
    """Return the covariance ``(6, 6)`` of a pose in the map: that of the pose plus that of the alignment.

    Args:
        covariance: ``(6, 6)``, of position and rotation in the map if the alignment were exact.
        T_map_camera: ``(4, 4)``, the pose of the camera in the map.
        alignment: ``(6, 6)``, of the twist (metres, radians) on the left of ``T_map_odom``.
    """
    x, y, z = T_map_camera[:3, 3]
    lever = np.eye(6)
    lever[:3, 3:] = -np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    moved: Array = covariance + lever @ alignment @ lever.T
    return moved


def advertised(options: BridgeOptions) -> list[tuple[str, str, bool]]:
    """Return name, type and latching of each topic that a bridge publishes.

    Subscribers of a latched topic receive the last message when they subscribe.
    """
    topics = (
        ("rse_pf/pose", POSE_WITH_COVARIANCE, False),
        ("rse_pf/odometry", ODOMETRY, False),
        ("rse_pf/path", PATH, False),
        ("rse_pf/cloud", POINT_CLOUD, True),
        ("/tf", TF, False),
        ("/diagnostics", DIAGNOSTICS, False),
        *((("/tf_static", TF, True),) if options.imu and options.publish_odom else ()),
    )
    return [(options.named(topic), kind, latched) for topic, kind, latched in topics]


class OutgoingMessages:
    """Makes the ROS messages of one robot, and stores the robot's path for them."""

    def __init__(self, maker: MessageMaker, options: BridgeOptions) -> None:
        self._maker, self._options = maker, options
        self._path: list[tuple[int, Array, Any]] = []
        self._every = 1
        self._counted = 0

    def of_frame(
        self,
        tracked: TrackedFrame,
        stamp_ns: int,
        camera_frame: str,
        *,
        T_map_odom: Array | None,
        alignment: Array | None = None,
    ) -> list[Message]:
        """Return the messages with pose, odometry and transforms of a frame; none for a lost frame.

        The pose is in the map if *T_map_odom* is known, else in the odometry frame.

        Args:
            tracked: The result of the mapper.
            stamp_ns: Time stamp of the frame's images.
            camera_frame: Name of the camera's frame.
            T_map_odom: ``(4, 4)``, pose of the odometry frame in the map; None if it is unknown.
            alignment: ``(6, 6)``, covariance of *T_map_odom*; None if it is unknown or zero.
        """
        T_odom_camera = tracked.T_world_camera
        if T_odom_camera is None:
            return []
        options, odom = self._options, self._options.own_odom_frame
        if tracked.T_new_old is not None:
            self._move_path(tracked.T_new_old)
        covariance, own = _UNKNOWN, _UNKNOWN
        is_in_map = T_map_odom is not None
        pose = T_map_odom @ T_odom_camera if T_map_odom is not None else T_odom_camera
        if tracked.covariance is not None:
            own = ros_covariance(tracked.covariance, T_odom_camera)
            covariance = ros_covariance(tracked.covariance, pose)
            if is_in_map and alignment is not None:
                covariance = with_alignment(covariance, pose, alignment)
        frame = options.map_frame if is_in_map else odom
        moved = []
        if T_map_odom is not None:
            moved.append(self._maker.transform(stamp_ns, options.map_frame, odom, T_map_odom))
        if options.publish_odom:
            moved.append(self._maker.transform(stamp_ns, odom, camera_frame, T_odom_camera))
        made = self._maker.pose_with_covariance(stamp_ns, frame, pose, covariance)
        odometry = self._maker.odometry(stamp_ns, (odom, camera_frame), T_odom_camera, own)
        messages = [
            self._message("rse_pf/pose", POSE_WITH_COVARIANCE, made),
            self._message("rse_pf/odometry", ODOMETRY, odometry),
        ]
        if moved:
            messages.append(self._message("/tf", TF, self._maker.transforms(moved)))
        self._extend_path(stamp_ns, T_odom_camera)
        return messages

    def path(self) -> list[Message]:
        """Return the message with the path in the odometry frame; none before the first pose.

        The transform from map to odometry frame moves the whole path when the map is corrected.
        """
        if not self._path:
            return []
        frame = self._options.own_odom_frame
        made = self._maker.path_of(self._path[-1][0], frame, [pose for _, _, pose in self._path])
        return [self._message("rse_pf/path", PATH, made)]

    def imu_place(self, stamp_ns: int, camera_frame: str, imu_frame: str, T_camera_imu: Array) -> Message:
        """Return the static transform *T_camera_imu* ``(4, 4)``, the pose of the IMU in the camera frame."""
        moved = self._maker.transform(stamp_ns, camera_frame, imu_frame, T_camera_imu)
        return self._message("/tf_static", TF, self._maker.transforms([moved]))

    def cloud(
        self, stamp_ns: int, points: npt.NDArray[np.float32], colours: npt.NDArray[np.uint8]
    ) -> list[Message]:
        """Return the cloud message in the odometry frame: *points* ``(n, 3)`` (m), RGB ``(n, 3)``."""
        made = self._maker.cloud(stamp_ns, self._options.own_odom_frame, points, colours)
        return [self._message("rse_pf/cloud", POINT_CLOUD, made)]

    def diagnostics(
        self, stamp_ns: int, *, trouble: str, is_working: bool, values: dict[str, str]
    ) -> Message:
        """Return the status message of the bridge.

        Its level is error unless *is_working*, else warning if *trouble* is not empty, else OK; its text is
        *trouble*, and *values* are its key-value pairs.
        """
        level = _ERROR if not is_working else _WARNING if trouble else _OK
        name = f"rse_pf: {self._options.namespace.strip('/') or 'robot'}"
        made = self._maker.diagnostics(stamp_ns, name, level, trouble or "poses are given", values)
        return self._message("/diagnostics", DIAGNOSTICS, made)

    def _message(self, topic: str, kind: str, message: Any) -> Message:
        return Message(self._options.named(topic), kind, self._maker.encode(kind, message))

    def _extend_path(self, stamp_ns: int, T_odom_camera: Array) -> None:
        """Add a pose to the path.

        If the path has more than ``path_poses`` poses, drop every second one, and add later ones half as
        often.
        """
        self._counted += 1
        if self._counted % self._every:
            return
        frame = self._options.own_odom_frame
        self._path.append((stamp_ns, T_odom_camera, self._maker.pose(stamp_ns, frame, T_odom_camera)))
        if len(self._path) > self._options.path_poses:
            self._path = self._path[::2]
            self._every *= 2

    def _move_path(self, T_new_old: Array) -> None:
        """Transform the path into the new odometry frame by *T_new_old* ``(4, 4)``."""
        frame = self._options.own_odom_frame
        moved = ((stamp_ns, T_new_old @ T) for stamp_ns, T, _ in self._path)
        self._path = [(stamp_ns, T, self._maker.pose(stamp_ns, frame, T)) for stamp_ns, T in moved]
