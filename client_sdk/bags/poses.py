"""Compute the true path of the camera in a bag from a topic of poses, or from the transforms of tf."""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from client_sdk.trajectory import Trajectory
from rse_pf.geometry import Array, from_quaternion, inverse

__all__ = ["PoseTopic", "TransformTree"]

_MAX_GAP_NS = 200_000_000
"""Longest time, nanoseconds, between two transforms between which a pose is interpolated."""
# Largest number of transforms from a frame to its root; ends the search in a cycle.
_MAX_TRANSFORMS_TO_ROOT = 64


@dataclass(slots=True)
class _Edge:
    """The poses of a child frame in its parent frame, in the order of the bag.

    ``values`` has 7 numbers for each pose: position x, y, z (metres) and quaternion x, y, z, w.  A static
    edge holds one pose, which is valid at all times.  ``ordered`` caches them by time.
    """

    parent: str
    is_static: bool
    stamps_ns: array[int] = field(default_factory=lambda: array("q"))
    values: array[float] = field(default_factory=lambda: array("d"))
    ordered: tuple[npt.NDArray[np.int64], Array] | None = None

    def add(self, stamp_ns: int, place: Any, turn: Any) -> None:
        numbers = (place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w)
        norm = sum(number * number for number in numbers[3:])
        if not np.isfinite(numbers).all() or not 0.5 < norm < 2.0:
            return
        if self.is_static:  # a later static transform replaces an earlier one
            del self.stamps_ns[:]
            del self.values[:]
        self.stamps_ns.append(stamp_ns)
        self.values.extend(numbers)

    def at(self, stamp_ns: int) -> Array | None:
        """Return ``T_parent_child`` at a time, interpolated between the transforms before and after it.

        A static transform holds at all times.  Others are known at their own time stamps, and between two
        that are at most 0.2 s apart.  The result is None at other times, or without transforms.
        """
        if not self.stamps_ns:
            return None
        if self.ordered is None:
            unique, rows = np.unique(np.array(self.stamps_ns, dtype=np.int64), return_index=True)
            self.ordered = (unique, np.array(self.values, dtype=np.float64).reshape(-1, 7)[rows])
        stamps, values = self.ordered
        if self.is_static:
            return _pose(values[0])
        after = int(np.searchsorted(stamps, stamp_ns))
        if after < len(stamps) and stamps[after] == stamp_ns:
            return _pose(values[after])
        if after in (0, len(stamps)) or stamps[after] - stamps[after - 1] > _MAX_GAP_NS:
            return None
        share = float(stamp_ns - stamps[after - 1]) / float(stamps[after] - stamps[after - 1])
        return _pose(_between(values[after - 1], values[after], share))


class TransformTree:
    """The tree of frames in tf, from which poses of frames are computed."""

    def __init__(self) -> None:
        self._edges: dict[str, _Edge] = {}

    def add(self, message: Any, *, is_static: bool) -> None:
        """Add the transforms of a ``TFMessage``; *is_static* for one of ``/tf_static``.

        If a frame gets another parent, its earlier transforms are dropped.
        """
        for transform in message.transforms:
            parent, child = transform.header.frame_id.strip("/"), transform.child_frame_id.strip("/")
            edge = self._edges.get(child)
            if edge is None or edge.parent != parent:
                edge = self._edges[child] = _Edge(parent=parent, is_static=is_static)
            stamp = transform.header.stamp
            stamp_ns = int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
            edge.add(stamp_ns, transform.transform.translation, transform.transform.rotation)

    def root_of(self, frame: str) -> tuple[str, bool]:
        """Return the root of the tree that contains *frame*, and whether *frame* can move relative to it."""
        frame, moves = frame.strip("/"), False
        for _ in range(_MAX_TRANSFORMS_TO_ROOT):
            edge = self._edges.get(frame)
            if edge is None:
                break
            moves = moves or not edge.is_static
            frame = edge.parent
        return frame, moves

    def pose(self, frame: str, stamp_ns: int) -> Array | None:
        """Return ``T_root_frame`` at a time, with the topmost frame of the tree of *frame* as the root.

        The result is None if a transform on the way is not known at that time.  A frame without a parent,
        also one that tf does not have, is its own root: the result is the identity.
        """
        T = np.eye(4)
        frame = frame.strip("/")
        for _ in range(_MAX_TRANSFORMS_TO_ROOT):
            edge = self._edges.get(frame)
            if edge is None:
                return T
            T_parent_child = edge.at(stamp_ns)
            if T_parent_child is None:
                return None
            T = T_parent_child @ T
            frame = edge.parent
        return None

    def between(self, frame: str, other: str) -> Array | None:
        """Return ``T_frame_other`` of two frames that static transforms connect; None if they do not."""
        if frame.strip("/") == other.strip("/"):
            return np.eye(4)
        ways = [self._walk_fixed(end) for end in (frame, other)]
        for common, T_common_frame in ways[0].items():
            if common in ways[1]:
                return inverse(T_common_frame) @ ways[1][common]
        return None

    def path(self, frame: str, stamps_ns: Sequence[int]) -> Trajectory | None:
        """Return the poses of *frame* in its root frame at those *stamps_ns* at which they are known.

        The result is None if fewer than two poses are known.
        """
        return _path((stamp_ns, self.pose(frame, stamp_ns)) for stamp_ns in stamps_ns)

    def _walk_fixed(self, frame: str) -> dict[str, Array]:
        frame = frame.strip("/")
        way = {frame: np.eye(4)}
        T = np.eye(4)
        for _ in range(_MAX_TRANSFORMS_TO_ROOT):
            edge = self._edges.get(frame)
            T_parent_child = edge.at(0) if edge is not None and edge.is_static else None
            if edge is None or T_parent_child is None:
                break
            T = T_parent_child @ T
            frame = edge.parent
            way[frame] = T
        return way


class PoseTopic:
    """The poses in a topic of ``PoseStamped``, ``PoseWithCovarianceStamped`` or ``Odometry``."""

    def __init__(self) -> None:
        self._edge = _Edge(parent="", is_static=False)

    def add(self, message: Any) -> None:
        """Add the pose of a message; a pose with numbers not finite or an invalid quaternion is left out."""
        pose = message.pose
        pose = getattr(pose, "pose", pose)
        stamp = message.header.stamp
        stamp_ns = int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
        self._edge.add(stamp_ns, pose.position, pose.orientation)

    def path(self, stamps_ns: Sequence[int]) -> Trajectory | None:
        """Return the interpolated poses of the topic at those *stamps_ns* at which they are known.

        The result is None if fewer than two poses are known.
        """
        return _path((stamp_ns, self._edge.at(stamp_ns)) for stamp_ns in stamps_ns)


def _path(poses: Iterable[tuple[int, Array | None]]) -> Trajectory | None:
    """Return the poses that are not None as a trajectory; None if they are fewer than two."""
    stamped_poses = [(stamp_ns / 1e9, T) for stamp_ns, T in poses if T is not None]
    if len(stamped_poses) < 2:
        return None
    return Trajectory(
        np.array([stamp_s for stamp_s, _ in stamped_poses]), np.stack([T for _, T in stamped_poses])
    )


def _pose(numbers: Array) -> Array:
    T = np.eye(4)
    T[:3, :3] = from_quaternion(numbers[3:])
    T[:3, 3] = numbers[:3]
    return T


def _between(one: Array, other: Array, share: float) -> Array:
    """Interpolate between two poses of 7 numbers: positions linearly, rotations on the shortest arc (slerp).

    *share* is 0 for *one* and 1 for *other*.
    """
    mixed = (1 - share) * one + share * other
    q0 = one[3:] / np.linalg.norm(one[3:])
    q1 = other[3:] / np.linalg.norm(other[3:])
    cosine = float(q0 @ q1)
    if cosine < 0:
        q1, cosine = -q1, -cosine
    angle = float(np.arccos(min(cosine, 1.0)))
    if angle < 1e-6:
        mixed[3:] = (1 - share) * q0 + share * q1
    else:
        mixed[3:] = (np.sin((1 - share) * angle) * q0 + np.sin(share * angle) * q1) / np.sin(angle)
    return mixed
