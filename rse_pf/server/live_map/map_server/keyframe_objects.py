"""Read and delete the points and images that robots store as objects together with their keyframes.

A keyframe refers to its objects by SHA-256 digest.  An object is read only under the name of the robot that
sent the keyframe, so a keyframe cannot refer to objects of other robots.  Objects that are missing, do not
match their digest, or hold no valid points are left out of the point cloud of the map.
"""

from __future__ import annotations

import contextlib
from collections import Counter, deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from rse_pf.errors import BadRequest, NotFound
from rse_pf.geometry import Array, Camera, transform
from rse_pf.live_map.versions import PointSource
from rse_pf.slam.cloud_deform import merge_clouds
from rse_pf.slam.keyframe_points import MAX_POINTS_BYTES, decode_points
from rse_pf.slam.ply import Colours, Points
from rse_pf.storage.object_store import ObjectStore, digest_of
from rse_pf.storage.quotas import TenantAccount

__all__ = ["KeyframeObjects", "PointCloud"]

_MAX_SOURCES = 4_000
"""Largest number of keyframes whose points are used in one point cloud, which bounds the time of a
publication; of more keyframes, `_select_evenly` selects this number."""
_MAX_POINTS = 3_000_000
"""Largest number of points of a cloud before it is thinned to one for each voxel: they take about 400 MB of
the map server's memory.  Each of n keyframes may contribute a part of 1/n of them; of a keyframe with more
points, every second, third, ... point is used."""
_MAX_CACHED_BYTES = 128 << 20
"""Largest total size in bytes of the encoded points that stay in memory after a cloud was built, so that they
need not be read from the object store for the next version; points beyond this size are read again."""
_MAX_DISTANCE_M = 100.0
"""Largest absolute value in metres of a coordinate of a point in the camera frame; points beyond it are left
out, because depths this large are wrong or very inexact."""
_DELETIONS = 2
"""Number of times that each object of a forgotten robot is deleted: its upload may end after the first
time."""
_CULLED_OBJECTS_DELAYED = 64
"""Number of objects of recently culled keyframes that are not deleted yet: their uploads may still arrive."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PointCloud:
    """The coloured point cloud of a version of a map.

    Attributes:
        points: ``(m, 3)`` float32 in metres, in the world frame of the version.
        colours: ``(m, 3)`` uint8, RGB.
        keyframes: Number of keyframes whose points are in the cloud.
        missing: Number of keyframes that were selected for the cloud, but whose points are missing or not
            valid.
    """

    points: Points
    colours: Colours
    keyframes: int
    missing: int


class KeyframeObjects:
    """The objects that belong to the keyframes of one live map.

    All methods block on the object store, and all but `read_points` are called by one thread at a time.
    """

    def __init__(self, store: ObjectStore, account: TenantAccount) -> None:
        """Use the object store *store* and the tenant's *account*, which is credited for deleted objects."""
        self._store = store
        self._account = account
        # Encoded points of the last cloud, keyed by object name; the cloud of the next version reuses them.
        self._cache: dict[str, bytes] = {}
        self._cached_bytes = 0
        self._culled: deque[tuple[str, str]] = deque()
        self._deletions: Counter[tuple[str, str]] = Counter()

    def build_cloud(self, sources: Sequence[PointSource]) -> PointCloud:
        """Build the point cloud of a version from the stored points of its keyframes.

        Of more than 4,000 keyframes, `_select_evenly` chooses 4,000.  The points are transformed by the
        optimised poses of their keyframes and thinned to one for each voxel of 1 cm.  Without any readable
        points the cloud is empty.

        Raises:
            StoreError: The store fails.
        """
        selected = _select_evenly(sources)
        old_cache, self._cache, self._cached_bytes = self._cache, {}, 0
        max_points = max(1, _MAX_POINTS // max(1, len(selected)))
        clouds: list[Array] = []
        colours: list[Colours] = []
        for source in selected:
            points_and_colours = self._read_points(source, old_cache)
            if points_and_colours is not None:
                points_camera, point_colours = points_and_colours
                stride = -(-len(points_camera) // max_points) or 1
                clouds.append(transform(source.T_world_camera, points_camera[::stride]).astype(np.float32))
                colours.append(point_colours[::stride])
        points, joined_colours = merge_clouds(clouds, colours)
        return PointCloud(
            points=points,
            colours=joined_colours,
            keyframes=len(clouds),
            missing=len(selected) - len(clouds),
        )

    def read_points(self, source: PointSource) -> Array | None:
        """Return the ``(n, 3)`` points (metres, camera frame) of one keyframe; any thread may call this.

        Return None if the object is missing, has another size or digest than the keyframe says, or holds no
        valid points.

        Raises:
            StoreError: The store fails.
        """
        data = self._read(source)
        decoded = None if data is None else _decode_near(data, source.camera)
        return None if decoded is None else decoded[0]

    def delete(self, objects: Iterable[tuple[str, str]]) -> None:
        """Delete objects, given as pairs of a robot's folder and a digest, and credit the tenant's account.

        Missing objects are skipped.

        Raises:
            StoreError: The store fails; the remaining objects are not deleted.
        """
        for folder, digest in objects:
            name = f"objects/{folder}/{digest}"
            self._cache.pop(name, None)
            with contextlib.suppress(NotFound):
                size_bytes = self._store.head(name).size
                self._store.delete(name)
                self._account.release(size_bytes)

    def delete_of_forgotten(self, objects: Iterable[tuple[str, str]]) -> None:
        """Delete the objects of forgotten robots, except those that two earlier calls have deleted.

        The second deletion removes an object whose upload ended after the first one.

        Raises:
            StoreError: The store fails; the next call deletes the remaining objects.
        """
        for folder_and_digest in objects:
            if self._deletions[folder_and_digest] < _DELETIONS:
                self.delete([folder_and_digest])
                self._deletions[folder_and_digest] += 1

    def delete_of_culled(self, objects: Iterable[tuple[str, str]]) -> None:
        """Queue the objects of culled keyframes, and delete all but the 64 that were queued last.

        The uploads of those 64 may still arrive; they are deleted by later calls.

        Raises:
            StoreError: The store fails; the object that was due is then deleted only when its robot is
                forgotten.
        """
        self._culled += objects
        while len(self._culled) > _CULLED_OBJECTS_DELAYED:
            self.delete([self._culled.popleft()])

    def _read_points(self, source: PointSource, old_cache: dict[str, bytes]) -> tuple[Array, Colours] | None:
        """Return the ``(n, 3)`` points (metres, camera frame) and ``(n, 3)`` colours of one keyframe.

        Points beyond `_MAX_DISTANCE_M` are left out.  Return None if the object is missing, has another size
        or digest than the keyframe says, or holds no valid points.  The encoded points are stored in the new
        cache up to `_MAX_CACHED_BYTES`; *old_cache*, by object name, has those of the last cloud.
        """
        name = f"objects/{source.robot}/{source.reference.digest}"
        data = old_cache.get(name)
        if data is None:
            data = self._read(source)
        if data is None:
            return None
        if self._cached_bytes + len(data) <= _MAX_CACHED_BYTES:
            self._cache[name] = data
            self._cached_bytes += len(data)
        return _decode_near(data, source.camera)

    def _read(self, source: PointSource) -> bytes | None:
        digest, size_bytes = source.reference.digest, source.reference.size
        name = f"objects/{source.robot}/{digest}"
        try:
            if not 0 < size_bytes <= MAX_POINTS_BYTES or self._store.head(name).size != size_bytes:
                return None
            data = self._store.get(name)
        except NotFound:
            return None
        return data if digest_of(data) == digest else None


def _decode_near(data: bytes, camera: Camera) -> tuple[Array, Colours] | None:
    """Return the points and colours of an object within `_MAX_DISTANCE_M`; None if it is not valid."""
    try:
        points, colours = decode_points(data, camera)
    except BadRequest:
        return None
    is_near = (np.abs(points) <= _MAX_DISTANCE_M).all(axis=1)
    return points[is_near], colours[is_near]


def _select_evenly(sources: Sequence[PointSource]) -> list[PointSource]:
    """Select at most 4,000 keyframes, spread evenly over the trajectory of each robot, in the given order.

    Each robot gets the same number; what a robot with fewer keyframes does not need goes to the others.
    """
    rows_by_robot: dict[str, list[int]] = {}
    for row, source in enumerate(sources):
        rows_by_robot.setdefault(source.robot, []).append(row)
    selected: list[int] = []
    robots_left = len(rows_by_robot)
    # Robots with the fewest keyframes come first, so that the others divide the number that these leave.
    for rows in sorted(rows_by_robot.values(), key=len):
        max_keyframes = (_MAX_SOURCES - len(selected)) // robots_left
        picks = np.linspace(0, len(rows) - 1, min(max_keyframes, len(rows))).astype(np.int64)
        selected += [rows[pick] for pick in picks]
        robots_left -= 1
    return [sources[row] for row in sorted(selected)]
