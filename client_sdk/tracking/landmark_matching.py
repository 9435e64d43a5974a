"""Match landmarks of a map with the features of an image, also at places that are to be recognised.

Guided matching compares features near predicted pixels; matching by appearance compares all of them.  Places
are recognised in two stages: keyframes are ranked by the cosine similarity of place vectors, and the best
ones by their number of matches.  The trackers decide which matches and which keyframes are accepted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields
from typing import Protocol

import numpy as np
import numpy.typing as npt

from client_sdk.plugins import LoopsPlugin
from rse_pf.geometry import Array, Camera
from rse_pf.maps.descriptors import Descriptors
from rse_pf.slam.descriptors import match_all
from rse_pf.slam.place_recognition import PlaceVector, place_vector
from rse_pf.slam.tracking import Features, GuidedMatchLimits, LandmarkAppearance, match_landmarks

__all__ = [
    "GUIDED_MATCHES_FACTOR",
    "JOIN_INTERVAL_FRAMES",
    "LATEST_KEYFRAMES",
    "MAX_JOIN_DIFFERENCE_DEG",
    "NO_LANDMARK",
    "PIXEL_SIGMA_PX",
    "VERIFY_LOWE_RATIO",
    "VERIFY_RADIUS_PX",
    "Candidate",
    "Landmarks",
    "LazyPlaceVector",
    "Matches",
    "make_place_vector",
    "match_candidates",
    "match_known_places",
    "match_other_segments",
    "shift_landmarks",
]

Rows = npt.NDArray[np.int64]

NO_LANDMARK = -1
"""Stands in arrays of landmark numbers for a feature that shows no landmark of the map."""
PIXEL_SIGMA_PX = 1.0
"""Standard deviation, in pixels, of a feature's position on the finest pyramid level; it grows with the size
of the feature."""
LATEST_KEYFRAMES = 3
"""Number of newest keyframes of the present segment that are compared with a frame after the camera was lost:
most losses end near the place where they began.  Without depth, also those at which an unclear answer is
accepted."""
GUIDED_MATCHES_FACTOR = 3
"""Fewest matches near predicted pixels for which a pose is queried, as a multiple of ``min_inliers``: with
fewer the predicted pose is most likely wrong."""
VERIFY_RADIUS_PX = 8.0
"""Radius, in pixels, around projected landmarks in which features are matched to verify a solved pose, and to
fuse the landmarks of two keyframes of one place."""
VERIFY_LOWE_RATIO = 0.9
"""Lowe's ratio for matches around the pixels of a pose that was solved: looser than usual, since the radius
is small."""
JOIN_INTERVAL_FRAMES = 3
"""Every third frame is compared with other segments, if there are any: bounds the time of a frame."""
MAX_JOIN_DIFFERENCE_DEG = 4.0
"""Largest rotation, in degrees, between two measurements of where one segment lies in another one, with which
they confirm each other."""
_MAX_RELOCALISATION_QUERIES = 3
"""Largest number of pose queries by which one lost frame is relocalised, against the keyframes with the most
matches: bounds the time of a lost frame."""
_SIMILAR_KEYFRAMES = 5
"""Number of keyframes of each segment that place recognition proposes for a frame."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Landmarks:
    """Points of the world with their uncertainty, and how each looked in the last image that showed it.

    The last image is the newest keyframe that sees the landmark.  `KeyframeMap.landmarks_of_view` also
    returns landmarks whose last image is a frame that is no keyframe.

    Attributes:
        points: ``(n, 3)``, world, in metres or in the unit of the segment.
        covariances: ``(n, 3, 3)`` of the points, in the squared unit of the points, world axes; 0 of a camera
            without depth.
        shutter_displacements: ``(n, 3)``: how far each point moves in the world for each second that the
            camera's rolling-shutter readout takes longer.
        descriptors: ``(n, d)``.
        rays: ``(n, 3)``, from the centre of the camera of that image to the point, world axes.
        orientations: ``(n, 3)``, orientation of the feature in that image as a direction in the world.
        sizes: ``(n,)``, scale of the feature in that image, 1 for the finest pyramid level.
        numbers: ``(n,)``, number of each landmark in its map; NO_LANDMARK for a point that is in no map.
    """

    points: Array
    covariances: Array
    shutter_displacements: Array
    descriptors: Descriptors
    rays: Array
    orientations: Array
    sizes: Array
    numbers: Rows

    def __len__(self) -> int:
        return len(self.points)

    @property
    def appearance(self) -> LandmarkAppearance:
        """The part of the landmarks that guided matching needs."""
        return LandmarkAppearance(
            points=self.points,
            rays=self.rays,
            orientations=self.orientations,
            sizes=self.sizes,
            descriptors=self.descriptors,
        )

    def first(self, count: int) -> Landmarks:
        """Return the first *count* landmarks, as views of the same memory."""
        return Landmarks(**{column.name: getattr(self, column.name)[:count] for column in fields(self)})

    def matched(self, rows: Rows, features: Rows) -> Matches:
        """Pair the landmark of row ``rows[i]`` with row ``features[i]`` of an image's features, for each
        *i*."""
        return Matches(
            features=features,
            numbers=self.numbers[rows],
            points=self.points[rows],
            covariances=self.covariances[rows],
            shutter_displacements=self.shutter_displacements[rows],
        )

    def match(
        self,
        T_camera_world: Array,
        camera: Camera,
        image: Features,
        limits: GuidedMatchLimits,
        margin_px: float,
    ) -> Matches:
        """Match the landmarks with features near the pixels at which a pose predicts them.

        Args:
            T_camera_world: ``(4, 4)``, the predicted pose of the image.
            camera: Intrinsics of the image.
            image: Features of the image.
            limits: Radius, Lowe's ratio and further conditions of a match.
            margin_px: Width of the border around the image in which landmarks are predicted, too.
        """
        rows, features = match_landmarks(
            self.appearance, np.arange(len(self)), T_camera_world, camera, image, limits, margin_px
        )
        return self.matched(rows, features)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Matches:
    """Landmarks and the features of an image that show them: what a pose is solved and fitted by.

    Attributes:
        features: ``(n,)``, row of the feature that shows each landmark.
        numbers: ``(n,)``, ``points`` ``(n, 3)``, ``covariances`` ``(n, 3, 3)`` and ``shutter_displacements``
            ``(n, 3)`` of the landmarks, as in `Landmarks`.
    """

    features: Rows
    numbers: Rows
    points: Array
    covariances: Array
    shutter_displacements: Array

    def __len__(self) -> int:
        return len(self.features)

    def followed_by(self, other: Matches) -> Matches:
        """Return these matches and then *other*, as one."""
        return Matches(
            features=np.concatenate([self.features, other.features]),
            numbers=np.concatenate([self.numbers, other.numbers]),
            points=np.concatenate([self.points, other.points]),
            covariances=np.concatenate([self.covariances, other.covariances]),
            shutter_displacements=np.concatenate([self.shutter_displacements, other.shutter_displacements]),
        )


def shift_landmarks(numbers: Rows, first: int) -> Rows:
    """Return landmark numbers after their map was appended to another one, where they begin at *first*."""
    return np.where(numbers == NO_LANDMARK, NO_LANDMARK, numbers + first)


class LazyPlaceVector:
    """The place vector of one image, computed when it is first needed; the image is released then."""

    def __init__(self, compute: Callable[[], PlaceVector]) -> None:
        self._compute: Callable[[], PlaceVector] | None = compute
        self._vector: PlaceVector

    def get(self) -> PlaceVector:
        """Return the ``(d,)`` unit vector, or zeros for an image without features."""
        if self._compute is not None:
            self._vector, self._compute = self._compute(), None
        return self._vector


class RecognisableMap(Protocol):
    """A map of one segment whose keyframes can be recognised."""

    @property
    def keyframe_count(self) -> int:
        """The number of keyframes."""

    def rank_by_similarity(self, place: LazyPlaceVector, count: int, among: Rows | None = None) -> list[int]:
        """Return the *count* keyframes whose place vectors are most similar to an image's, best first.

        Only keyframes of *among* are considered, all for None.
        """

    def landmarks_in(self, keyframe: int) -> tuple[Rows, Descriptors]:
        """Return the numbers of the landmarks that a keyframe sees, and their descriptors in it."""

    def matched(self, numbers: Rows, features: Rows) -> Matches:
        """Pair the landmark ``numbers[i]`` with row ``features[i]`` of an image's features, for each *i*."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Candidate:
    """A keyframe that may show the place of an image.

    Attributes:
        segment: Number of the segment of the keyframe.
        keyframe: Number of the keyframe in its segment.
        matches: Matches of the landmarks that the keyframe sees with the features of the image.
    """

    segment: int
    keyframe: int
    matches: Matches


def make_place_vector(
    descriptors: Descriptors, rgb: npt.NDArray[np.uint8], plugin: LoopsPlugin | None
) -> LazyPlaceVector:
    """Make the place vector of an image from its descriptors, or by a function that the user of the SDK gave.

    Args:
        descriptors: ``(n, d)``, of the image's features.
        rgb: ``(h, w, 3)``, the image.
        plugin: The user's function for place recognition; None for the vector of the descriptors (VLAD).
    """
    if plugin is None:
        return LazyPlaceVector(lambda: place_vector(descriptors))
    return LazyPlaceVector(lambda: plugin(rgb))


def match_known_places(
    maps: Mapping[int, RecognisableMap], place: LazyPlaceVector, image: Features, current_segment: int
) -> list[Candidate]:
    """Match the keyframes that may show the place of an untracked frame; return the best three, best first.

    These keyframes are the five most similar ones of every segment, and the three newest ones of the current
    segment.

    Args:
        maps: Map of each segment by its number.
        place: Place vector of the frame's image.
        image: Features of the image.
        current_segment: Number of the current segment.
    """
    keyframes: dict[tuple[int, int], None] = {}
    for segment, segment_map in maps.items():
        similar = segment_map.rank_by_similarity(place, _SIMILAR_KEYFRAMES)
        if segment == current_segment:
            newest = segment_map.keyframe_count - 1
            similar = [*range(newest, max(-1, newest - LATEST_KEYFRAMES), -1), *similar]
        keyframes.update(dict.fromkeys((segment, keyframe) for keyframe in similar))
    return match_candidates(maps, keyframes, image)[:_MAX_RELOCALISATION_QUERIES]


def match_other_segments(
    maps: Mapping[int, RecognisableMap], place: LazyPlaceVector, image: Features, current_segment: int
) -> Candidate:
    """Match the five most similar keyframes of each segment but the current one; return the best.

    The arguments are those of `match_known_places`; there must be another segment.
    """
    keyframes = [
        (segment, keyframe)
        for segment, segment_map in maps.items()
        if segment != current_segment
        for keyframe in segment_map.rank_by_similarity(place, _SIMILAR_KEYFRAMES)
    ]
    return match_candidates(maps, keyframes, image)[0]


def match_candidates(
    maps: Mapping[int, RecognisableMap], keyframes: Iterable[tuple[int, int]], image: Features
) -> list[Candidate]:
    """Match the landmarks of each keyframe with an image by appearance; return all, most matches first.

    Args:
        maps: Map of each segment by its number.
        keyframes: (segment, keyframe) of each candidate.
        image: Features of the image.
    """
    candidates = []
    for segment, keyframe in keyframes:
        numbers, descriptors = maps[segment].landmarks_in(keyframe)
        rows, features = match_all(descriptors, image.descriptors)
        matches = maps[segment].matched(numbers[rows], features)
        candidates.append(Candidate(segment=segment, keyframe=keyframe, matches=matches))
    return sorted(candidates, key=lambda candidate: -len(candidate.matches))
