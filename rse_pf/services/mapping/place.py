"""The service ``place``: find the keyframes of a map that show the same place as a view (place recognition).

Equal requests have equal replies.  A prior of the position only narrows the search.  Maps of recent requests
are cached.
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
    "MAP_LIMITS",
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
    "open_map",
    "register",
    "view_of",
]

_CACHED_MAPS = 2
"""Number of decoded maps with their indexes that a process keeps between requests: those used last."""
MAX_KEYFRAMES = 2000
"""Most keyframes of all maps of one request together, which bounds its time and memory; a request with more
is refused with LimitExceeded."""
MAX_FEATURES = 2_000_000
"""Most features of all keyframes of one map together, which bounds the memory of a request; a request with a
larger map is refused with LimitExceeded."""
MAP_LIMITS = MapLimits(keyframes=MAX_KEYFRAMES, features=MAX_FEATURES)
"""Limits of each map of a request; a larger map is refused."""
MAX_VIEW_FEATURES = 20_000
"""Most features of the view (the image to localise) of a request, which bounds the time of matching; a
request with more is refused with LimitExceeded."""
_MAX_COMPARISONS = 2_000_000_000
"""Most comparisons of two ORB descriptors, one of the view and one of a candidate keyframe, in one request,
which is refused with LimitExceeded beyond it; this number of comparisons takes about five seconds.
A comparison of longer descriptors counts as several, in proportion to their size."""


class FeatureKind(msgspec.Struct, frozen=True, kw_only=True):
    """The kind of the descriptors of a view.

    Attributes:
        name: Name of the feature, such as ``orb``.
        dtype: ``uint8`` for binary descriptors, ``int8`` for vectors.
        size: Bytes of a binary descriptor, or dimensions of a vector.
    """

    name: str
    dtype: str
    size: int


class Within(msgspec.Struct, frozen=True, kw_only=True):
    """A prior of the camera's position: within *radius_m* of ``(x, y, z)``, metres, map frame."""

    x: float
    y: float
    z: float
    radius_m: float


class PlaceRequest(msgspec.Struct, frozen=True, kw_only=True):
    """A view and the map in which its place is sought.

    Attributes:
        map: Encoded map version.
        camera: Intrinsics of the view.
        pixels: ``2n`` undistorted pixel coordinates of the features.
        descriptors: Raw bytes of the ``n`` descriptors; 32 bytes each for ORB.
        candidates: Most keyframes of the reply, 1..100.
        check: Whether the relative pose of the view and each candidate is estimated by PnP, and the
            candidates are sorted by the number of inliers; else they are sorted by their score.
        within: Prior of the camera's position; None to search the whole map.
        features: Kind of the descriptors; None for ORB.
    """

    map: bytes
    camera: Camera
    pixels: Array
    descriptors: bytes
    candidates: int = 5
    check: bool = True
    within: Within | None = None
    features: FeatureKind | None = None


class Candidate(msgspec.Struct, frozen=True, kw_only=True):
    """A keyframe that may show the same place as the view.

    Attributes:
        keyframe: Id of the keyframe.
        robot: Robot that took the keyframe.
        score: Cosine similarity of the place vectors of view and keyframe.
        inliers: Inliers of the relative pose by PnP, 0 without a pose; None if candidates are not verified.
    """

    keyframe: int
    robot: str
    score: float
    inliers: int | None = None


class PlaceReply(msgspec.Struct, frozen=True, kw_only=True):
    """Candidates in descending order: by inliers where they were verified, otherwise by score."""

    candidates: list[Candidate]


class MapIndex:
    """An immutable index of the keyframes of a map for place recognition.

    Attributes:
        keyframes: The keyframes; a *row* of this index is the index of a keyframe in this tuple.
        kind: Kind of their descriptors.
        T_map_keyframe: ``(n, 4, 4)``, poses of the keyframes, metres.
    """

    def __init__(self, keyframes: Sequence[Keyframe]) -> None:
        """Index *keyframes*; raises BadRequest if their features are of several kinds."""
        self.keyframes = tuple(keyframes)
        self.kind = common_kind((keyframe.kind for keyframe in self.keyframes), "the map")
        self.T_map_keyframe = np.array([keyframe.T_world_camera for keyframe in self.keyframes])
        self._places = PlaceIndex.from_pairs(
            (row, place_vector(keyframe.descriptors)) for row, keyframe in enumerate(self.keyframes)
        )

    def nearest(
        self, descriptors: Descriptors, count: int, within: Within | None = None
    ) -> list[tuple[int, float]]:
        """Return the *count* keyframes most similar to a view, as ``(row, score)``, the best first.

        The score is the cosine similarity of the place vectors.  However low it is, the keyframe is returned.

        Args:
            descriptors: Descriptors of the view.
            count: Most keyframes that are returned; fewer only if fewer are searched.
            within: Prior of the position: only keyframes whose cameras are within its radius are searched;
                None to search all.
        """
        rows: npt.NDArray[np.int64] | None = None
        if within is not None:
            centre = np.array([within.x, within.y, within.z])
            distance_m = np.linalg.norm(self.T_map_keyframe[:, :3, 3] - centre, axis=1)
            rows = np.flatnonzero(distance_m <= within.radius_m).astype(np.int64)
        return self._places.nearest(place_vector(descriptors), count, rows)


def index_map(data: bytes) -> tuple[MapVersion, MapIndex]:
    """Decode the map version *data*, and return the version with an index of its keyframes.

    Raises:
        BadRequest: The bytes are not a map.
        LimitExceeded: The map has no keyframes, or more keyframes or features than the limits allow.
    """
    version = decode_map(data, limits=MAP_LIMITS)
    if not version.keyframes:
        raise LimitExceeded(
            f"the map has 0 keyframes, not 1..{MAX_KEYFRAMES}", hint="send a map with keyframes"
        )
    return version, MapIndex(version.keyframes)


open_map = functools.lru_cache(maxsize=_CACHED_MAPS)(index_map)
"""`index_map` with a cache of the results for the last `_CACHED_MAPS` encoded maps; callers share a
result."""


def view_of(
    camera: Camera, pixels: Array, descriptors: bytes, features: FeatureKind | None, index: MapIndex
) -> View:
    """Return the view of a request, whose descriptors must be of the same kind as those of the map.

    Args:
        camera: Intrinsics of the view.
        pixels: ``2n`` undistorted pixel coordinates.
        descriptors: Raw bytes of the ``n`` descriptors.
        features: Kind of the descriptors; None for ORB.
        index: Index of the map.

    Raises:
        BadRequest: Pixels and descriptors do not fit each other, or the descriptors are of another kind than
            the map's.
        LimitExceeded: The view has more than `MAX_VIEW_FEATURES` features.
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
    """Raise LimitExceeded if it would take too long to match *view* to *candidates* keyframes of *index*.

    Each candidate counts as the keyframe of the map with most features.
    """
    largest = max(len(keyframe.descriptors) for keyframe in index.keyframes)
    comparisons = min(candidates, len(index.keyframes)) * largest * len(view.pixels)
    comparisons = comparisons * index.kind.size // ORB.size
    if comparisons > _MAX_COMPARISONS:
        raise LimitExceeded(
            f"{comparisons} comparisons of features are above {_MAX_COMPARISONS}",
            hint="ask for fewer candidates, or send fewer features",
        )


def register(registry: Registry) -> None:
    """Add the service ``place`` to *registry*."""

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
        candidates = [
            _make_candidate(index.keyframes[row], score, view, request.check) for row, score in rows
        ]
        if request.check:
            candidates.sort(key=lambda candidate: (-(candidate.inliers or 0), -candidate.score))
        return PlaceReply(candidates=candidates)


def _make_candidate(keyframe: Keyframe, score: float, view: View, check: bool) -> Candidate:
    inliers = None
    if check:
        measured = measure_pose(landmarks_of_keyframe(keyframe), view)
        inliers = 0 if isinstance(measured, str) else measured.inliers
    return Candidate(keyframe=keyframe.id, robot=keyframe.robot, score=score, inliers=inliers)
