"""The tree of coordinate frames as other nodes publish it on ``/tf`` and ``/tf_static``, and odometry.

A bridge hears its own transforms, too: `FrameTree.remember` makes the tree ignore them.
"""

from __future__ import annotations

import bisect
from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rse_pf.geometry import Array, exp_se3, from_quaternion, inverse, log_se3

__all__ = ["FrameTree", "PoseHistory", "Transform"]

# Time for which poses are stored, in ns: longer than a frame waits for its pose.
_KEPT_NS = 30_000_000_000
# Largest number of stored poses of a frame: 30 s at 200 Hz.
_MAX_POSES = 6_000
# Longest time between two poses between which a pose is interpolated, in ns: wheels at 2 Hz are the slowest.
_MAX_GAP_NS = 500_000_000
# A time stamp this far before the previous one, in ns, means that the clock was set back.
_JUMP_NS = 1_000_000_000
# Largest number of transforms from a frame to its root: stops at cycles.
_MAX_DEPTH = 64
# Number of the bridge's own transforms that are recognised: more than it publishes in 10 s.
_OWN_TRANSFORMS = 1_000


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Transform:
    """The pose *T* ``(4, 4)``, metres, of the frame ``child`` in the frame ``parent`` at ``stamp_ns``."""

    parent: str
    child: str
    stamp_ns: int
    T: Array

    @property
    def key(self) -> tuple[Any, ...]:
        """What tells this transform from one of another node."""
        return (self.parent, self.child, self.stamp_ns, *self.T[:3, 3].tolist())


class PoseHistory:
    """The poses of a frame over the last 30 s, interpolated between their time stamps."""

    def __init__(self) -> None:
        self._stamps_ns: deque[int] = deque(maxlen=_MAX_POSES)
        self._poses: deque[Array] = deque(maxlen=_MAX_POSES)

    @property
    def newest_ns(self) -> int | None:
        """The newest time stamp; None without poses."""
        return self._stamps_ns[-1] if self._stamps_ns else None

    def add(self, stamp_ns: int, T: Array) -> None:
        """Add a pose; one that is not newer is ignored, and one that is 1 s older begins another history."""
        if self._stamps_ns and stamp_ns <= self._stamps_ns[-1]:
            if stamp_ns > self._stamps_ns[-1] - _JUMP_NS:
                return
            self._stamps_ns.clear()
            self._poses.clear()
        self._stamps_ns.append(stamp_ns)
        self._poses.append(T)
        while self._stamps_ns[0] < stamp_ns - _KEPT_NS:
            self._stamps_ns.popleft()
            self._poses.popleft()

    def at(self, stamp_ns: int) -> Array | None:
        """Return the pose at a time; None if it is not between two poses that are at most 0.5 s apart."""
        row = bisect.bisect_left(self._stamps_ns, stamp_ns)
        if row == len(self._stamps_ns):
            return None
        if self._stamps_ns[row] == stamp_ns:
            return self._poses[row]
        if row == 0 or self._stamps_ns[row] - self._stamps_ns[row - 1] > _MAX_GAP_NS:
            return None
        before_ns = self._stamps_ns[row - 1]
        share = (stamp_ns - before_ns) / (self._stamps_ns[row] - before_ns)
        return interpolate(self._poses[row - 1], self._poses[row], share)

    def stamps_between(self, after_ns: int, until_ns: int) -> list[int]:
        """Return the time stamps after *after_ns*, up to the first that is not before *until_ns*."""
        first = bisect.bisect_right(self._stamps_ns, after_ns)
        last = bisect.bisect_left(self._stamps_ns, until_ns) + 1
        return list(self._stamps_ns)[first:last]


@dataclass(slots=True)
class _Edge:
    """The poses of a frame in its parent; ``fixed`` is that of a static transform, else None."""

    parent: str
    fixed: Array | None = None
    history: PoseHistory = field(default_factory=PoseHistory)

    def at(self, stamp_ns: int) -> Array | None:
        return self.history.at(stamp_ns) if self.fixed is None else self.fixed


class FrameTree:
    """The transforms that other nodes publish."""

    def __init__(self) -> None:
        self._edges: dict[str, _Edge] = {}
        self._own: deque[tuple[Any, ...]] = deque(maxlen=_OWN_TRANSFORMS)
        self._own_keys: set[tuple[Any, ...]] = set()

    def remember(self, transform: Transform) -> None:
        """Ignore *transform*, which this bridge publishes, when it is received."""
        if len(self._own) == self._own.maxlen:
            self._own_keys.discard(self._own[0])
        self._own.append(transform.key)
        self._own_keys.add(transform.key)

    def add(self, message: Any, *, is_static: bool) -> None:
        """Add the transforms of a ``TFMessage``; *is_static* for one of ``/tf_static``.

        A transform that is no rigid motion, or that the bridge itself has published, is ignored.  A frame
        that gets another parent loses the earlier one.
        """
        for each in message.transforms:
            T = pose_of(each.transform.translation, each.transform.rotation)
            if T is None:
                continue
            parent, child = each.header.frame_id.strip("/"), each.child_frame_id.strip("/")
            transform = Transform(parent=parent, child=child, stamp_ns=stamp_ns_of(each), T=T)
            if transform.key in self._own_keys:
                continue
            edge = self._edges.get(child)
            if edge is None or edge.parent != parent or (edge.fixed is not None) != is_static:
                edge = self._edges[child] = _Edge(parent)
            if is_static:
                edge.fixed = T
            else:
                edge.history.add(transform.stamp_ns, T)

    def parent_of(self, frame: str) -> str:
        """Return the parent of *frame*; empty if no other node publishes one."""
        edge = self._edges.get(frame)
        return "" if edge is None else edge.parent

    def static_root(self, frame: str) -> tuple[str, Array]:
        """Return the topmost frame above *frame* by static transforms, and the pose ``T_root_frame``."""
        T: Array = np.eye(4)
        for _ in range(_MAX_DEPTH):
            edge = self._edges.get(frame)
            if edge is None or edge.fixed is None:
                break
            frame, T = edge.parent, edge.fixed @ T
        return frame, T

    def static_pose(self, frame: str, other: str) -> Array | None:
        """Return ``T_frame_other`` of two frames that static transforms connect; None if none do."""
        (root, T_root_frame), (other_root, T_root_other) = self.static_root(frame), self.static_root(other)
        return inverse(T_root_frame) @ T_root_other if root == other_root else None

    def chain(self, ancestor: str, frame: str) -> list[str] | None:
        """Return the frames from *frame* up to the child of *ancestor*; None if *ancestor* is not above."""
        frames: list[str] = []
        while frame != ancestor:
            edge = self._edges.get(frame)
            if edge is None or len(frames) == _MAX_DEPTH:
                return None
            frames.append(frame)
            frame = edge.parent
        return frames

    def pose(self, ancestor: str, frame: str, stamp_ns: int) -> Array | None:
        """Return ``T_ancestor_frame`` at a time; None if it is not known then."""
        frames = self.chain(ancestor, frame)
        if frames is None:
            return None
        T: Array = np.eye(4)
        for each in frames:
            T_parent_child = self._edges[each].at(stamp_ns)
            if T_parent_child is None:
                return None
            T = T_parent_child @ T
        return T

    def history(self, ancestor: str, frame: str) -> PoseHistory | None:
        """Return the poses of the topmost frame that moves between *ancestor* and *frame*; None if none."""
        for each in reversed(self.chain(ancestor, frame) or []):
            if self._edges[each].fixed is None:
                return self._edges[each].history
        return None


def pose_of(position: Any, orientation: Any) -> Array | None:
    """Return the pose ``(4, 4)`` of the fields of a message; None if it is no rigid motion."""
    numbers = np.array([getattr(position, name) for name in "xyz"], dtype=np.float64)
    quaternion = np.array([getattr(orientation, name) for name in "xyzw"], dtype=np.float64)
    if not (np.isfinite(numbers).all() and 0.5 < float(quaternion @ quaternion) < 2.0):
        return None
    T: Array = np.eye(4)
    T[:3, :3] = from_quaternion(quaternion)
    T[:3, 3] = numbers
    return T


def stamp_ns_of(message: Any) -> int:
    """Return the time stamp of the header of *message* in nanoseconds."""
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def interpolate(T_a: Array, T_b: Array, share: float) -> Array:
    """Return the pose on the screw motion from *T_a* (*share* 0) to *T_b* (*share* 1), ``(4, 4)``."""
    pose: Array = T_a @ exp_se3(share * log_se3((inverse(T_a) @ T_b)[None])[0])
    return pose
