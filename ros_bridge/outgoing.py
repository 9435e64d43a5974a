"""Turn poses of the robot's base into ROS messages, with the time stamps of the images."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from client_sdk.bags.message_maker import MessageMaker
from client_sdk.bags.message_types import (
    DIAGNOSTICS,
    OCCUPANCY_GRID,
    ODOMETRY,
    PATH,
    POINT_CLOUD,
    POSE_WITH_COVARIANCE,
    STRING,
    TF,
)
from ros_bridge.base_poses import BasePose, project_to_plane
from ros_bridge.frame_tree import Transform
from ros_bridge.options import BridgeOptions
from ros_bridge.robot_frames import RobotFrames
from rse_pf.geometry import Array, transform
from rse_pf.slam.occupancy import FREE, OCCUPIED, OccupancyGrid

__all__ = ["Message", "OutgoingMessages", "advertised"]


@dataclass(frozen=True, slots=True)
class Message:
    """An encoded message: the name of its topic, its type as ROS 2 names it, and its bytes."""

    topic: str
    kind: str
    data: bytes


def advertised(options: BridgeOptions) -> list[tuple[str, str, bool]]:
    """Return name, type and latching of each topic that a bridge publishes.

    Subscribers of a latched topic receive the last message when they subscribe.
    """
    topics = (
        ("rse_pf/pose", POSE_WITH_COVARIANCE, False),
        ("rse_pf/odometry", ODOMETRY, False),
        ("rse_pf/path", PATH, False),
        ("rse_pf/cloud", POINT_CLOUD, True),
        ("rse_pf/status", STRING, True),
        *((("rse_pf/floor_plan", OCCUPANCY_GRID, True),) if options.floor_plan_every_s else ()),
        ("/tf", TF, False),
        ("/diagnostics", DIAGNOSTICS, False),
        *((("/tf_static", TF, True),) if options.rig else ()),
    )
    return [(options.named(topic), kind, latched) for topic, kind, latched in topics]


class OutgoingMessages:
    """Makes the ROS messages of one robot, and stores the robot's path for them.

    One thread at a time may call `path`, also while another one calls other methods.
    """

    def __init__(self, maker: MessageMaker, options: BridgeOptions, frames: RobotFrames) -> None:
        self._maker, self._options, self._frames = maker, options, frames
        self._path: list[tuple[int, Array]] = []
        self._made_path: list[Any] = []
        self._made_for: tuple[object, Array] | None = None
        self._every = 1
        self._counted = 0

    def of_pose(self, pose: BasePose, stamp_ns: int) -> list[Message]:
        """Return the messages of a pose: in the map if it is known there, and in the odometry frame.

        *stamp_ns* is the time stamp of the frame's images.
        """
        messages = []
        if pose.T_map_base is not None:
            made = self._maker.pose_with_covariance(
                stamp_ns, self._frames.map, pose.T_map_base, pose.map_covariance
            )
            messages.append(self._message("rse_pf/pose", POSE_WITH_COVARIANCE, made))
        if pose.T_odom_base is not None:
            names = self._frames.odom, self._frames.base
            made = self._maker.odometry(stamp_ns, names, pose.T_odom_base, pose.odom_covariance)
            messages.append(self._message("rse_pf/odometry", ODOMETRY, made))
        return messages

    def transforms(self, transforms: Iterable[Transform], *, is_static: bool = False) -> list[Message]:
        """Return the message with *transforms*, of ``/tf_static`` if *is_static*; none without transforms."""
        made = [self._maker.transform(each.stamp_ns, each.parent, each.child, each.T) for each in transforms]
        topic = "/tf_static" if is_static else "/tf"
        return [self._message(topic, TF, self._maker.transforms(made))] if made else []

    def status(self, status: str) -> Message:
        """Return the message with the *status* of the pose: ``visual``, ``odometry`` or ``lost``."""
        return self._message("rse_pf/status", STRING, self._maker.make(STRING, data=status))

    def path(self, T_map_world: Array) -> list[Message]:
        """Return the message with the path in the map; none before the first pose.

        *T_map_world* ``(4, 4)`` is the pose of the mapper's world in the map: a correction moves the path.
        """
        path = self._path  # a list that only grows: a change of its poses makes another one
        poses = path[:]
        if not poses:
            return []
        made_for = self._made_for
        if made_for is None or made_for[0] is not path or not np.array_equal(made_for[1], T_map_world):
            self._made_for, self._made_path = (path, T_map_world), []
        for stamp_ns, T_world_base in poses[len(self._made_path) :]:
            pose = T_map_world @ T_world_base
            pose = project_to_plane(pose) if self._frames.is_planar else pose
            self._made_path.append(self._maker.pose(stamp_ns, self._frames.map, pose))
        made = self._maker.path_of(poses[-1][0], self._frames.map, self._made_path)
        return [self._message("rse_pf/path", PATH, made)]

    def extend_path(self, stamp_ns: int, T_world_base: Array) -> None:
        """Add a pose to the path.

        If the path has more than ``path_poses`` poses, drop every second one, and add later ones half as
        often.
        """
        self._counted += 1
        if self._counted % self._every:
            return
        self._path.append((stamp_ns, T_world_base))
        if len(self._path) > self._options.path_poses:
            self._path = self._path[::2]
            self._every *= 2

    def move_path(self, T_new_old: Array) -> None:
        """Transform the path into the mapper's new world by *T_new_old* ``(4, 4)``."""
        self._path = [(stamp_ns, T_new_old @ T) for stamp_ns, T in self._path]

    def cloud(
        self,
        stamp_ns: int,
        T_map_world: Array,
        points: npt.NDArray[np.float32],
        colours: npt.NDArray[np.uint8],
    ) -> list[Message]:
        """Return the cloud in the map: *points* ``(n, 3)`` (m) of the mapper's world, RGB ``(n, 3)``."""
        moved = transform(T_map_world, points.astype(np.float64)).astype(np.float32)
        made = self._maker.cloud(stamp_ns, self._frames.map, moved, colours)
        return [self._message("rse_pf/cloud", POINT_CLOUD, made)]

    def floor_plan(self, stamp_ns: int, plan: OccupancyGrid) -> list[Message]:
        """Return the message with the floor plan *plan*, whose grid must have the axes of the map."""
        cells = np.full(plan.cells.shape, -1, np.int8)
        cells[plan.cells == FREE] = 0
        cells[plan.cells == OCCUPIED] = 100
        T_map_corner: Array = np.eye(4)
        T_map_corner[:3, 3] = *plan.origin_m, plan.floor_m
        made = self._maker.occupancy_grid(stamp_ns, self._frames.map, cells, T_map_corner, plan.resolution_m)
        return [self._message("rse_pf/floor_plan", OCCUPANCY_GRID, made)]

    def diagnostics(self, stamp_ns: int, *, level: int, text: str, values: dict[str, str]) -> Message:
        """Return the status message of the bridge; *values* are its key-value pairs.

        *level* is 0 for OK, 1 for a warning, 2 for an error.
        """
        name = f"rse_pf: {self._options.namespace.strip('/') or 'robot'}"
        made = self._maker.diagnostics(stamp_ns, name, level, text, values)
        return self._message("/diagnostics", DIAGNOSTICS, made)

    def _message(self, topic: str, kind: str, message: Any) -> Message:
        return Message(self._options.named(topic), kind, self._maker.encode(kind, message))
