"""The coordinate frames of one robot (REP 105): map, odometry frame, base, and who publishes what.

A frame has one parent.  The bridge therefore publishes a transform only if no other node gives its child a
parent, and leaves the transform from odometry frame to base to the robot's own odometry if there is one.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable
from typing import Any

import numpy as np

from ros_bridge.frame_tree import FrameTree, PoseHistory, Transform, pose_of, stamp_ns_of
from ros_bridge.options import BridgeOptions
from rse_pf.geometry import Array, inverse

__all__ = ["RobotFrames"]


class RobotFrames:
    """The frames of one robot.  Any thread may add messages.

    ``map`` and ``odom`` are names of frames; ``base`` is empty until `settle`.
    """

    def __init__(self, options: BridgeOptions) -> None:
        self.map, self.odom, self.base = options.map_frame, options.own_odom_frame, ""
        self.T_base_camera: Array | None = None
        self._options = options
        self._tree = FrameTree()
        self._odometry = PoseHistory()
        self._odometry_frames = ("", "")
        self._camera_frame = ""
        self._second_parents: dict[str, str] = {}
        self._lock = threading.Lock()

    def add_transforms(self, message: Any, *, is_static: bool) -> None:
        """Add a ``TFMessage`` of ``/tf``, or of ``/tf_static`` if *is_static*."""
        with self._lock:
            self._tree.add(message, is_static=is_static)

    def add_odometry(self, message: Any) -> None:
        """Add an ``Odometry``; one whose pose is no rigid motion is ignored."""
        T = pose_of(message.pose.pose.position, message.pose.pose.orientation)
        frames = message.header.frame_id.strip("/"), message.child_frame_id.strip("/")
        with self._lock:
            if T is None:
                return
            if frames != self._odometry_frames:
                self._odometry, self._odometry_frames = PoseHistory(), frames
            self._odometry.add(stamp_ns_of(message), T)

    def concerns(self, data: bytes | memoryview) -> bool:
        """Return whether a message of ``/tf`` may hold a frame of interest, without decoding it."""
        text = bytes(data)
        with self._lock:
            return any(name.encode() in text for name in self._names())

    def _names(self) -> set[str]:
        names = {self.odom}
        frame = self.base or self._options.own_base_frame
        while frame and frame not in names:
            names.add(frame)
            frame = self._tree.parent_of(frame)
        return names

    # --- The base, and the mount of the camera on it ---

    def mount(self, camera_frame: str) -> Array | None:
        """Return ``T_base_camera`` by the static transforms; None if they do not join the two frames."""
        base = self._options.own_base_frame
        with self._lock:
            return self._tree.static_pose(base, camera_frame) if base else None

    def settle(self, camera_frame: str, T_base_camera: Array | None) -> None:
        """Set the base for the rest of the run: the camera's frame if *T_base_camera* is None."""
        with self._lock:
            self._camera_frame, self.T_base_camera = camera_frame, T_base_camera
            self.base = camera_frame if T_base_camera is None else self._options.own_base_frame

    @property
    def missing_mount(self) -> str:
        """The sentence that says that the pose of the camera on the base is missing; empty if it is not."""
        wanted = self._options.own_base_frame
        if not self.base or not wanted or self.T_base_camera is not None or wanted == self.base:
            return ""
        if self.mount(self._camera_frame) is not None:
            return f"{wanted} -> {self.base} came on /tf_static after the start: start the bridge again"
        return f"no {wanted} -> {self.base} on /tf_static or in rig: poses are of {self.base}"

    @property
    def is_planar(self) -> bool:
        """Whether poses of the base are projected into the plane z = 0; never for a camera as base."""
        return self._options.planar and self.T_base_camera is not None

    # --- The odometry of the robot ---

    @property
    def is_odometry_foreign(self) -> bool:
        """Whether the transform from odometry frame to base is left to another node."""
        if self._options.odometry or not self._options.publish_odom:
            return True
        with self._lock:
            return self._tree.chain(self.odom, self.base) is not None

    def T_odom_base(self, stamp_ns: int) -> Array | None:
        """Return the pose of the base in the odometry frame by another node, interpolated; None if unknown.

        None also if the topic ``odometry`` is in another frame than the odometry frame.
        """
        with self._lock:
            if self._options.odometry and self._odometry_frames[0] != self.odom:
                return None
            return self._base_at(stamp_ns)

    def readings(self, after_ns: int, until_ns: int) -> list[tuple[int, Array]]:
        """Return time stamps and poses of the base after *after_ns*, up to the first not before *until_ns*.

        They are in the odometry frame, or in that of the messages of the topic ``odometry``.
        """
        with self._lock:
            history = self._history()
            stamps_ns = [] if history is None else history.stamps_between(after_ns, until_ns)
            poses = [(stamp_ns, self._base_at(stamp_ns)) for stamp_ns in stamps_ns]
        return [(stamp_ns, T) for stamp_ns, T in poses if T is not None]

    @property
    def newest_odometry_ns(self) -> int | None:
        """The newest time stamp of the odometry; None without odometry."""
        with self._lock:
            history = self._history()
            return None if history is None else history.newest_ns

    def _history(self) -> PoseHistory | None:
        return self._odometry if self._options.odometry else self._tree.history(self.odom, self.base)

    def _base_at(self, stamp_ns: int) -> Array | None:
        """Return the pose of the base by the topic ``odometry``, in its frame, or by ``/tf``."""
        if not self._options.odometry:
            return self._tree.pose(self.odom, self.base, stamp_ns)
        T_child_base = self._tree.static_pose(self._odometry_frames[1], self.base)
        T_odom_child = self._odometry.at(stamp_ns)
        return None if T_child_base is None or T_odom_child is None else T_odom_child @ T_child_base

    # --- What the bridge publishes ---

    def odom_transform(self, stamp_ns: int, T_odom_base: Array) -> Transform:
        """Return the transform from the odometry frame to the topmost frame that is fixed to the base.

        A driver or a URDF may have given the base a parent, such as ``base_footprint`` or ``camera_link``.
        """
        with self._lock:
            root, T_root_base = self._tree.static_root(self.base)
        if root in (self.map, self.odom):  # such a parent contradicts the bridge: `permitted` reports it
            root, T_root_base = self.base, np.eye(4)
        return Transform(
            parent=self.odom, child=root, stamp_ns=stamp_ns, T=T_odom_base @ inverse(T_root_base)
        )

    def static_transform(self, stamp_ns: int, parent: str, child: str, T: Array) -> Transform | None:
        """Return the transform from *parent* to the topmost frame that is fixed to *child*.

        None if other nodes have joined the two frames, or have given that topmost frame a parent.

        Args:
            stamp_ns: Time stamp of the transform.
            parent: Name of the parent.
            child: Name of the frame whose pose is known.
            T: ``(4, 4)``, pose of *child* in *parent*.
        """
        with self._lock:
            root, T_root_child = self._tree.static_root(child)
            if self._tree.parent_of(root) or root == self._tree.static_root(parent)[0]:
                return None
            made = Transform(parent=parent, child=root, stamp_ns=stamp_ns, T=T @ inverse(T_root_child))
            self._tree.remember(made)
        return made

    def permitted(self, transforms: Iterable[Transform]) -> list[Transform]:
        """Return those of *transforms* whose child has no parent by another node, to be published now."""
        kept = []
        with self._lock:
            for each in transforms:
                parent = self._tree.parent_of(each.child)
                if parent:
                    self._second_parents[each.child] = (
                        f"another node publishes {parent} -> {each.child}: the bridge does not publish "
                        f"{each.parent} -> {each.child}"
                    )
                    continue
                self._tree.remember(each)
                kept.append(each)
        return kept

    def troubles(self) -> list[str]:
        """Return a sentence for each frame with a second parent, and for odometry that cannot be used."""
        with self._lock:
            troubles = list(self._second_parents.values())
            frame, child = self._odometry_frames
            is_child_known = self._tree.static_pose(child, self.base) is not None
            has_chain = self._tree.chain(self.odom, self.base) is not None
        if not self.base or not self.is_odometry_foreign:
            return troubles
        missing = f"{self.map} -> {self.odom} is not published"
        topic = self._options.odometry and self._options.named(self._options.odometry)
        if topic and not frame:
            troubles.append(f"no message of {topic}: {missing}")
        elif topic and frame != self.odom:
            troubles.append(f"{topic} is in {frame}, and odom_frame is {self.odom}: {missing}")
        elif topic and not is_child_known:
            troubles.append(f"{topic} is of {child}, which no /tf_static joins to {self.base}: {missing}")
        elif not topic and not has_chain:
            troubles.append(
                f"publish_odom is false, and no node publishes {self.odom} -> {self.base}: {missing}"
            )
        return troubles
