"""Place recognition: which keyframes of which segments may show the place that an image shows.

Keyframes are ranked by the cosine similarity of place vectors, and the best ones by their number of matches.
The trackers decide which of them is accepted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from client_sdk.plugins import LoopsPlugin
from client_sdk.tracking.landmarks import Landmarks, Matches, match_by_appearance
from rse_pf.maps.descriptors import Descriptors
from rse_pf.slam.place_recognition import PlaceVector, place_vector
from rse_pf.slam.tracking import ImageFeatures

__all__ = [
    "LATEST_KEYFRAMES",
    "Candidate",
    "LazyPlaceVector",
    "list_other_segments",
    "list_relocalisation_candidates",
    "make_place_vector",
    "match_candidates",
]

LATEST_KEYFRAMES = 3
"""Number of newest keyframes of the present segment that are compared with a frame after the camera was lost:
most losses end near the place where they began."""
_SIMILAR_KEYFRAMES = 5
"""Number of keyframes of each segment that place recognition proposes for a frame."""


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

    def rank_by_similarity(self, place: LazyPlaceVector, count: int) -> list[int]:
        """Return the *count* keyframes whose place vectors are most similar to an image's, best first."""

    def landmarks_in(self, keyframe: int) -> tuple[Landmarks, Descriptors]:
        """Return the landmarks that a keyframe sees, and their descriptors in that keyframe."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Candidate:
    """A keyframe that may show the place of an image, and the matches of its landmarks with that image."""

    segment: int
    keyframe: int
    matches: Matches


def make_place_vector(
    descriptors: Descriptors, rgb: npt.NDArray[np.uint8], plugin: LoopsPlugin | None
) -> LazyPlaceVector:
    """Make the place vector of an image from its descriptors, or by a user's place recogniser.

    Args:
        descriptors: ``(n, d)``, of the image's features.
        rgb: ``(h, w, 3)``, the image.
        plugin: A user's place recogniser; None for the vector of the descriptors (VLAD).
    """
    if plugin is None:
        return LazyPlaceVector(lambda: place_vector(descriptors))
    return LazyPlaceVector(lambda: plugin(rgb))


def list_relocalisation_candidates(
    maps: Mapping[int, RecognisableMap], place: LazyPlaceVector, current_segment: int
) -> Iterator[tuple[int, int]]:
    """Yield (segment, keyframe) of all keyframes that may show the place of an untracked frame.

    These are the five most similar keyframes of every segment, and the three newest ones of the current
    segment; each keyframe is yielded once.
    """
    for segment, segment_map in maps.items():
        keyframes = segment_map.rank_by_similarity(place, _SIMILAR_KEYFRAMES)
        if segment == current_segment:
            newest = segment_map.keyframe_count - 1
            keyframes = [*range(newest, max(-1, newest - LATEST_KEYFRAMES), -1), *keyframes]
        yield from ((segment, keyframe) for keyframe in dict.fromkeys(keyframes))


def list_other_segments(
    maps: Mapping[int, RecognisableMap], place: LazyPlaceVector, current_segment: int
) -> Iterator[tuple[int, int]]:
    """Yield (segment, keyframe) of the five most similar keyframes of each segment but the current one."""
    for segment, segment_map in maps.items():
        if segment != current_segment:
            yield from ((segment, k) for k in segment_map.rank_by_similarity(place, _SIMILAR_KEYFRAMES))


def match_candidates(
    maps: Mapping[int, RecognisableMap], keyframes: Iterable[tuple[int, int]], image: ImageFeatures
) -> list[Candidate]:
    """Match the landmarks of each keyframe with an image by appearance; return all, most matches first.

    Args:
        maps: Map of each segment by its number.
        keyframes: (segment, keyframe) of each candidate.
        image: Features of the image.
    """
    candidates = [
        Candidate(
            segment=segment,
            keyframe=keyframe,
            matches=match_by_appearance(*maps[segment].landmarks_in(keyframe), image),
        )
        for segment, keyframe in keyframes
    ]
    return sorted(candidates, key=lambda candidate: -len(candidate.matches))
