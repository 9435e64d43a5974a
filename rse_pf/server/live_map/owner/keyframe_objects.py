"""The objects that robots store beside keyframes of a live map: read for its cloud, deleted with their robot.

An object is looked for under the name of the robot that sent the keyframe: it can be nobody else's.  What is
missing, has other bytes than its digest says, or holds no points is left out of the cloud.
"""

from __future__ import annotations

import contextlib
from collections import Counter, deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from rse_pf.accounts import TenantAccount
from rse_pf.errors import BadRequest, NotFound
from rse_pf.geometry import Array, transform
from rse_pf.live_map.versions import PointSource
from rse_pf.object_store import ObjectStore, digest_of
from rse_pf.slam.cloud_deform import merge_clouds
from rse_pf.slam.keyframe_points import MAX_POINTS_BYTES, decode_points
from rse_pf.slam.ply import Colours, Points

__all__ = ["Cloud", "KeyframeObjects"]

_MAX_SOURCES = 4_000
_MAX_POINTS = 3_000_000
"""Before they are thinned: about 400 MB of the owner's memory.  Of many keyframes each gives fewer."""
_MAX_KEPT_BYTES = 128 << 20
"""Of objects that are kept for the next version; what is beyond is read again."""
_FARTHEST_M = 100.0
"""Points farther from their camera are left out: such a camera sees no metres."""
_TIMES = 2
_KEPT_CULLED = 64
"""Objects of so many of the last keyframes that were culled stay: they may still be on their way."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cloud:
    """``points`` ``(m, 3)`` in the world of the version, metres; how many keyframes gave some, or none."""

    points: Points
    colours: Colours
    keyframes: int
    missing: int


class KeyframeObjects:
    """The objects of one map's keyframes.  Blocking; for one thread at a time."""

    def __init__(self, store: ObjectStore, account: TenantAccount) -> None:
        """Read nothing yet; *account* is told what is deleted."""
        self._store, self._account = store, account
        self._read: dict[str, bytes] = {}
        self._read_bytes = 0
        self._culled: deque[tuple[str, str]] = deque()
        self._deleted: Counter[tuple[str, str]] = Counter()

    def cloud(self, sources: Sequence[PointSource]) -> Cloud:
        """Return the points of *sources*, each where its keyframe is now, one for each voxel of 1 cm.

        Of many keyframes an even choice is read, as many of each robot.

        Raises:
            StoreError: The store fails.
        """
        chosen = _even_share(sources)
        known, self._read, self._read_bytes = self._read, {}, 0
        most = max(1, _MAX_POINTS // max(1, len(chosen)))
        clouds: list[Array] = []
        colours: list[Colours] = []
        for source in chosen:
            found = self._points(source, known)
            if found is not None:
                each = -(-len(found[0]) // most) or 1
                clouds.append(transform(source.T_world_camera, found[0][::each]).astype(np.float32))
                colours.append(found[1][::each])
        points, joined = merge_clouds(clouds, colours)
        return Cloud(points=points, colours=joined, keyframes=len(clouds), missing=len(chosen) - len(clouds))

    def delete(self, objects: Iterable[tuple[str, str]]) -> None:
        """Remove *objects*, each the folder of a robot and a digest; raises StoreError."""
        for folder, digest in objects:
            name = f"objects/{folder}/{digest}"
            self._read.pop(name, None)
            with contextlib.suppress(NotFound):
                size = self._store.head(name).size
                self._store.delete(name)
                self._account.release(size)

    def delete_gone(self, objects: Iterable[tuple[str, str]]) -> None:
        """Remove the objects of forgotten robots, in two calls: the last may have been on its way.

        Raises:
            StoreError: The store fails; the rest is removed by the next call.
        """
        for each in objects:
            if self._deleted[each] < _TIMES:
                self.delete([each])
                self._deleted[each] += 1

    def cull(self, objects: Iterable[tuple[str, str]]) -> None:
        """Remove the objects of keyframes whose features were dropped, a little later; raises StoreError."""
        self._culled += objects
        while len(self._culled) > _KEPT_CULLED:
            self.delete([self._culled.popleft()])

    def _points(self, source: PointSource, known: dict[str, bytes]) -> tuple[Array, Colours] | None:
        """Return the points of one keyframe in its camera's frame; None if it has none."""
        digest, size = source.reference.digest, source.reference.size
        name = f"objects/{source.robot}/{digest}"
        data = known.get(name)
        if data is None:
            try:
                if not 0 < size <= MAX_POINTS_BYTES or self._store.head(name).size != size:
                    return None
                data = self._store.get(name)
            except NotFound:
                return None
            if digest_of(data) != digest:
                return None
        if self._read_bytes + len(data) <= _MAX_KEPT_BYTES:
            self._read[name] = data
            self._read_bytes += len(data)
        try:
            points, colours = decode_points(data, source.camera)
        except BadRequest:
            return None
        near = (np.abs(points) <= _FARTHEST_M).all(axis=1)
        return points[near], colours[near]


def _even_share(sources: Sequence[PointSource]) -> list[PointSource]:
    """Return at most 4,000 of *sources*, in their order: each robot has as many, spread over its drive."""
    rows_of: dict[str, list[int]] = {}
    for row, source in enumerate(sources):
        rows_of.setdefault(source.robot, []).append(row)
    kept: list[int] = []
    for left, rows in zip(
        range(len(rows_of), 0, -1), sorted(rows_of.values(), key=len), strict=True
    ):  # what a robot does not use is left to those that have more
        share = (_MAX_SOURCES - len(kept)) // left
        even = np.linspace(0, len(rows) - 1, min(share, len(rows))).astype(np.int64)
        kept += [rows[i] for i in even]
    return [sources[row] for row in sorted(kept)]
