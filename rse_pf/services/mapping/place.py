"""The place service: find the keyframes of a map that show the same place as a view.

The same request has the same answer.  A prior only narrows the search; recently used maps are cached.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import msgspec
import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest, LimitExceeded
from rse_pf.geometry import Camera
from rse_pf.maps.descriptors import (
    ORB,
    DescriptorKind,
    Descriptors,
    check_same_kind,
    common_kind,
    decode_descriptors,
)
from rse_pf.maps.format import Keyframe, MapLimits, MapVersion, decode_map
from rse_pf.service import Registry
from rse_pf.slam.place_recognition import PlaceIndex, place_vector
from rse_pf.slam.relative_pose import View, landmarks_of_keyframe, measure_pose
from rse_pf.wire.arrays import Array, reshaped

__all__ = [
    "MAX_KEYFRAMES",
    "MAX_VIEW_FEATURES",
    "Candidate",
    "FeatureKind",
    "MapIndex",
    "PlaceReply",
    "PlaceRequest",
    "Within",
    "check_comparisons",
    "index_map",
    "map_limits",
    "open_map",
    "register",
    "view_of",
]

_CACHED_MAPS = 2
MAX_KEYFRAMES = 2000
"""Limit of all maps of one request together."""
MAX_FEATURES = 2_000_000
"""Likewise."""
MAX_VIEW_FEATURES = 20_000
"""Of the view of a request."""
_MAX_COMPARISONS = 2_000_000_000
"""Of one descriptor of ORB of the view with one of a candidate; they take about five seconds."""


class FeatureKind(msgspec.Struct, frozen=True, kw_only=True):
    """What the descriptors of a view are, as `DescriptorKind` says."""

    name: str
    dtype: str
    size: int


class Within(msgspec.Struct, frozen=True, kw_only=True):
    """A prior: the camera is within *radius_m* of ``(x, y, z)``, metres, map frame."""

    x: float
    y: float
    z: float
    radius_m: float


class PlaceRequest(msgspec.Struct, frozen=True, kw_only=True):
    """A view and the map to find it in.

    ``map`` is an encoded map version; ``pixels`` ``2n`` undistorted; ``descriptors`` raw bytes: ``32n`` of
    ORB.
    """

    map: bytes
    camera: Camera
    pixels: Array
    descriptors: bytes
    candidates: int = 5
    check: bool = True
    """Whether each candidate is checked by PnP; the candidates are then sorted by inliers."""
    within: Within | None = None
    features: FeatureKind | None = None
    """None for ORB."""


class Candidate(msgspec.Struct, frozen=True, kw_only=True):
    """A keyframe that may show the view; *score* is the cosine of the two views' vectors.

    *inliers* counts the matches that agree with one pose; None if that was not asked.
    """

    keyframe: int
    robot: str
    score: float
    inliers: int | None = None


class PlaceReply(msgspec.Struct, frozen=True, kw_only=True):
    """Candidates, best first: by inliers where they were checked, else by score."""

    candidates: list[Candidate]


class MapIndex:
    """The keyframes of a map, their ``(n, 4, 4)`` poses, and an index of their places; immutable.

    Rows are those of *keyframes*.
    """

    def __init__(self, keyframes: Sequence[Keyframe]) -> None:
        self.keyframes = tuple(keyframes)
        self.kind = common_kind((keyframe.kind for keyframe in self.keyframes), "the map")
        self.T_map_keyframe = np.array([keyframe.T_world_camera for keyframe in self.keyframes])
        self._places = PlaceIndex.from_vectors(
            place_vector(keyframe.descriptors) for keyframe in self.keyframes
        )

    def nearest(
        self, descriptors: Descriptors, count: int, within: Within | None = None
    ) -> list[tuple[int, float]]:
        """Return up to *count* ``(row, score)`` for a view, best first, of keyframes that are *within*."""
        rows: npt.NDArray[np.int64] | None = None
        if within is not None:
            centre = np.array([within.x, within.y, within.z])
            apart_m = np.linalg.norm(self.T_map_keyframe[:, :3, 3] - centre, axis=1)
            rows = np.flatnonzero(apart_m <= within.radius_m).astype(np.int64)
        return self._places.nearest(place_vector(descriptors), count, rows)


def map_limits(keyframes: int = MAX_KEYFRAMES) -> MapLimits:
    """Return what a map may hold that a service computes with."""
    return MapLimits(keyframes=keyframes, features=MAX_FEATURES)


def index_map(data: bytes) -> tuple[MapVersion, MapIndex]:
    """Return the map of *data* and its index.

    Raises:
        BadRequest: The bytes are not a map.
        LimitExceeded: It holds no keyframe, or more keyframes or features than a service computes with.
    """
    version = decode_map(data, limits=map_limits())
    if not version.keyframes:
        raise LimitExceeded(
            f"a map of 0 keyframes is not within 1..{MAX_KEYFRAMES}", hint="send a map with keyframes"
        )
    return version, MapIndex(version.keyframes)


open_map = functools.lru_cache(maxsize=_CACHED_MAPS)(index_map)
"""The same; the last results are cached."""


def view_of(
    camera: Camera, pixels: Array, descriptors: bytes, features: FeatureKind | None, index: MapIndex
) -> View:
    """Return the view of a request.

    Raises:
        BadRequest: Pixels and descriptors do not fit, or are of another kind than those of the map.
        LimitExceeded: It has too many features.
    """
    kind = ORB if features is None else DescriptorKind(features.name, features.dtype, features.size)
    check_same_kind(index.kind, kind, "the map")
    rows = reshaped("pixels", pixels, 2)
    if len(rows) > MAX_VIEW_FEATURES:
        raise LimitExceeded(
            f"a view of {len(rows)} features is above {MAX_VIEW_FEATURES}", hint="send the strongest ones"
        )
    return View(camera=camera, pixels=rows, descriptors=decode_descriptors(descriptors, len(rows), kind))


def check_comparisons(index: MapIndex, view: View, candidates: int) -> None:
    """Raise LimitExceeded if matching *view* to *candidates* keyframes of *index* would take too long."""
    largest = max(len(each.descriptors) for each in index.keyframes)
    comparisons = min(candidates, len(index.keyframes)) * largest * len(view.pixels)
    comparisons = comparisons * index.kind.size // ORB.size
    if comparisons > _MAX_COMPARISONS:
        raise LimitExceeded(
            f"{comparisons} comparisons of features are above {_MAX_COMPARISONS}",
            hint="ask for fewer candidates, or send fewer features",
        )


def register(registry: Registry) -> None:
    """Add ``place`` to *registry*."""

    @registry.service("place", limited=True)
    def place(request: PlaceRequest) -> PlaceReply:
        """Find the keyframes of a map that show what a view shows."""
        if not 1 <= request.candidates <= 100:
            raise BadRequest(
                f"candidates = {request.candidates} is not within 1..100", hint="5 to 10 are enough"
            )
        _, index = open_map(request.map)
        view = view_of(request.camera, request.pixels, request.descriptors, request.features, index)
        if request.check:
            check_comparisons(index, view, request.candidates)
        rows = index.nearest(view.descriptors, request.candidates, request.within)
        found = [_candidate(index.keyframes[row], score, view, request.check) for row, score in rows]
        if request.check:
            found.sort(key=lambda each: (-(each.inliers or 0), -each.score))
        return PlaceReply(candidates=found)


def _candidate(keyframe: Keyframe, score: float, view: View, check: bool) -> Candidate:
    inliers = None
    if check:
        measured = measure_pose(landmarks_of_keyframe(keyframe), view)
        inliers = 0 if isinstance(measured, str) else measured.inliers
    return Candidate(keyframe=keyframe.id, robot=keyframe.robot, score=score, inliers=inliers)
