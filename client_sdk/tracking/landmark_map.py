"""The map of one segment of a camera without depth: keyframes, landmarks, and their bundle adjustment.

A landmark is a point that two or more keyframes have triangulated.
The tracker decides which frames become keyframes, and which keyframes show the same place.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from client_sdk.monocular.bundle import Adjuster, Bundle, adjust
from client_sdk.tracking.landmark_matching import (
    NO_LANDMARK,
    PIXEL_SIGMA_PX,
    VERIFY_LOWE_RATIO,
    Landmarks,
    LazyPlaceVector,
    Matches,
    shift_landmarks,
)
from rse_pf.geometry import Array, Camera, exp_se3, inverse, log_se3, scaled, transform
from rse_pf.maps.descriptors import Descriptors
from rse_pf.slam.tracking import Features, GuidedMatchLimits
from rse_pf.slam.triangulation import parallax_deg, reprojection_errors, triangulate

__all__ = [
    "MAX_KEYFRAMES",
    "MIN_SHARED_LANDMARKS",
    "OUTLIER_SIGMAS",
    "LandmarkMap",
    "MonocularKeyframe",
    "MonocularView",
]

Rows = npt.NDArray[np.int64]

MIN_SHARED_LANDMARKS = 15
"""Fewest common landmarks of two keyframes that are neighbours in the covisibility graph."""
MAX_KEYFRAMES = 1000
"""Largest number of keyframes of a map; then frames are still tracked in it, but become no keyframes: bounds
memory."""
OUTLIER_SIGMAS = 2.45
"""Reprojection error, in standard deviations of the pixel, above which an observation is an outlier: 95 % of
the errors of a 2-D Gaussian are below it."""
_LATEST_NEIGHBOURS = 2
"""Number of keyframes whose numbers are just below that of a keyframe, and which count as its neighbours even
without common landmarks."""
_TRIANGULATION_NEIGHBOURS = 6
"""Number of neighbours with which a new keyframe triangulates landmarks: bounds the time of a keyframe."""
_LOCAL_NEIGHBOURS = 20
"""Number of neighbours of a keyframe whose landmarks are matched with a frame: bounds the time of a frame."""
_WINDOW_KEYFRAMES = 10
"""Number of keyframes that a local bundle adjustment moves: bounds the time of a keyframe."""
_FIXED_KEYFRAMES = 12
"""Number of further keyframes that take part in a local bundle adjustment with fixed poses: bounds the time
of a keyframe."""
_MAX_POSE_LANDMARKS = 3000
"""Largest number of landmarks, those seen most often, by which a bundle adjustment estimates the poses;
further landmarks are adjusted to these poses: bounds the time of an adjustment."""
_MAX_ADJUSTED_KEYFRAMES = 200
"""Number of keyframes of a map above which they are not adjusted all together: bounds the time to seconds."""
_MIN_PARALLAX_DEG = 1.0
"""Smallest angle, in degrees, between the two rays of a landmark that is triangulated: below it the depth is
noise."""
_SEARCH_RADIUS_PX = 30.0
"""Radius, in pixels, around its predicted pixel in which a feature of another keyframe is matched to be
triangulated; the prediction takes its depth from the landmarks around the feature."""
_DEPTH_LANDMARKS = 3
"""Number of landmarks nearest in the image whose mean inverse depth is the guessed inverse depth of a feature
without a landmark, by which the pixel of this feature in another keyframe is predicted."""
_MIN_LANDMARK_DEPTH = 1e-3
"""Smaller depths, in the unit of the map, count as this one where inverse depths are averaged."""
_MIN_BASELINE_DEPTH_SHARE = 0.01
"""Smallest distance of two keyframes that triangulate, as a share of the median depth: nearer, they see no
parallax."""
_OBSERVE_RADIUS_PX = 3.0
"""Radius, in pixels, around a projected new landmark in which it is matched with a feature of a further
keyframe."""
_LOCAL_ITERATIONS = 5
"""Iterations of the bundle adjustment that follows every keyframe: bounds the time of a frame."""
_CULL_AGE_KEYFRAMES = 3
"""Number of newer keyframes after which a landmark that too few keyframes have seen is removed."""
_CULL_OBSERVATIONS = 3
"""Fewest keyframes that must have seen a landmark when it is no longer new: a landmark of a wrong match is
mostly seen only by the two keyframes that triangulated it."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MonocularView:
    """One image without depth, as it is matched and kept in a map.

    Attributes:
        features: Features of the image, ``n`` of them.
        colours: ``(n, 3)`` uint8, red first: colour of the image at each feature.
        place_vector: Vector by which the place of the image is recognised.
    """

    features: Features
    colours: npt.NDArray[np.uint8]
    place_vector: LazyPlaceVector


@dataclass(slots=True, kw_only=True, eq=False)
class MonocularKeyframe:
    """A keyframe of a map: its image, and what the bundle adjustment changes.

    Attributes:
        view: The image.
        T_camera_world: ``(4, 4)``.
        landmarks: ``(n,)``, landmark of each feature, or NO_LANDMARK.
    """

    view: MonocularView
    T_camera_world: Array
    landmarks: Rows


class LandmarkMap:
    """Keyframes of one camera and their landmarks.

    Attributes:
        camera: Intrinsics of all keyframes.
        keyframes: All keyframes, oldest first.
        points: ``(n, 3)`` landmarks in the world, in the unit of the map, which is arbitrary until the map is
            scaled to metres.
        descriptors: ``(n, d)``, descriptor of each landmark in the keyframe that saw it last.
        colours: ``(n, 3)`` uint8.
        is_alive: ``(n,)``; removed landmarks keep their number and are not alive.
    """

    def __init__(self, camera: Camera, adjuster: Adjuster = adjust) -> None:
        self.camera = camera
        self.keyframes: list[MonocularKeyframe] = []
        self.points: Array = np.empty((0, 3))
        self.descriptors: Descriptors = np.empty((0, 0), dtype=np.uint8)
        self.colours: npt.NDArray[np.uint8] = np.empty((0, 3), dtype=np.uint8)
        self.is_alive: npt.NDArray[np.bool_] = np.empty(0, dtype=bool)
        self._adjust_bundle = adjuster
        self._creation_keyframes: Rows = np.empty(0, dtype=np.int64)
        """Number of the newest keyframe when each landmark was made, which gives the age of the landmark."""
        self._rays: Array = np.empty((0, 3))
        self._orientations: Array = np.empty((0, 3))
        self._sizes: Array = np.empty(0)

    @property
    def keyframe_count(self) -> int:
        """The number of keyframes."""
        return len(self.keyframes)

    # --- Add keyframes and landmarks ---

    def add_keyframe(self, view: MonocularView, T_camera_world: Array, landmarks: Rows) -> int:
        """Add a keyframe and return its number; the landmarks that it sees get their appearance from it.

        Args:
            view: The image.
            T_camera_world: ``(4, 4)``, its pose.
            landmarks: ``(n,)``, landmark of each feature, or NO_LANDMARK.
        """
        if not len(self.points):
            self.descriptors = view.features.descriptors[:0]
        self.keyframes.append(
            MonocularKeyframe(view=view, T_camera_world=T_camera_world, landmarks=landmarks.copy())
        )
        view.place_vector.get()  # computed now, so that the image is released
        number = len(self.keyframes) - 1
        seen = np.flatnonzero(landmarks != NO_LANDMARK)
        self._update_appearance(number, landmarks[seen], seen)
        return number

    def add_landmarks(self, points: Array, first: tuple[int, Rows], second: tuple[int, Rows]) -> None:
        """Add landmarks that two keyframes see.

        Args:
            points: ``(n, 3)``, in the world.
            first: Number of a keyframe, and the ``(n,)`` rows of its features that show the landmarks.
            second: The same of the other keyframe, which gives colours and appearance of the landmarks.
        """
        count = len(points)
        numbers = len(self.points) + np.arange(count)
        view = self.keyframes[second[0]].view
        self._append_landmarks(
            points=points,
            descriptors=view.features.descriptors[second[1]],
            colours=view.colours[second[1]],
            is_alive=np.ones(count, dtype=bool),
            _creation_keyframes=np.full(count, len(self.keyframes) - 1),
            _rays=np.zeros((count, 3)),
            _orientations=np.zeros((count, 3)),
            _sizes=np.ones(count),
        )
        for keyframe, features in (first, second):
            self.keyframes[keyframe].landmarks[features] = numbers
            self._update_appearance(keyframe, numbers, features)

    def extend(self, number: int) -> None:
        """Triangulate new landmarks from a keyframe and its neighbours.

        All neighbours then observe the new landmarks, too, where a feature matches.  A keyframe that sees no
        landmark adds none: the depths of its features, by which their pixels in the neighbours are predicted,
        are guessed from landmarks.
        """
        count = len(self.points)
        depths = self._interpolate_depths(number)
        if depths is None:
            return
        for neighbour in self._neighbours(number)[:_TRIANGULATION_NEIGHBOURS]:
            self._triangulate(number, neighbour, depths)
        for neighbour in self._neighbours(number):
            self._observe_again(neighbour, np.arange(count, len(self.points)))

    def append(self, other: LandmarkMap) -> tuple[int, int]:
        """Add all of another map in the same frame and unit.

        Returned are the numbers that the other map's first keyframe and first landmark have here.
        """
        keyframe, landmark = len(self.keyframes), len(self.points)
        if not landmark:
            self.descriptors = other.descriptors[:0]
        self.keyframes += [
            replace(record, landmarks=shift_landmarks(record.landmarks, landmark))
            for record in other.keyframes
        ]
        self._append_landmarks(
            points=other.points,
            descriptors=other.descriptors,
            colours=other.colours,
            is_alive=other.is_alive,
            _creation_keyframes=other._creation_keyframes + keyframe,
            _rays=other._rays,
            _orientations=other._orientations,
            _sizes=other._sizes,
        )
        return keyframe, landmark

    def _append_landmarks(self, **columns: npt.NDArray[np.generic]) -> None:
        """Append rows to all arrays that have one row for each landmark."""
        for name, rows in columns.items():
            setattr(self, name, np.concatenate((getattr(self, name), rows)))

    # --- Look up ---

    def landmarks_of(self, number: int) -> Rows:
        """Return the numbers of the landmarks that a keyframe sees."""
        landmarks: Rows = self.keyframes[number].landmarks
        seen: Rows = landmarks[landmarks != NO_LANDMARK]
        return seen

    def landmarks(self, numbers: Rows) -> Landmarks:
        """Return landmarks by their numbers; their covariances are 0."""
        count = len(numbers)
        return Landmarks(
            points=self.points[numbers],
            covariances=np.broadcast_to(np.zeros((3, 3)), (count, 3, 3)),
            shutter_displacements=np.broadcast_to(np.zeros(3), (count, 3)),
            descriptors=self.descriptors[numbers],
            rays=self._rays[numbers],
            orientations=self._orientations[numbers],
            sizes=self._sizes[numbers],
            numbers=numbers,
        )

    def matched(self, numbers: Rows, features: Rows) -> Matches:
        """Pair the landmark ``numbers[i]`` with row ``features[i]`` of an image's features, for each *i*.

        The covariances are 0.
        """
        return Matches(
            features=features,
            numbers=numbers,
            points=self.points[numbers],
            covariances=np.zeros((len(numbers), 3, 3)),
            shutter_displacements=np.zeros((len(numbers), 3)),
        )

    def landmarks_in(self, keyframe: int) -> tuple[Rows, Descriptors]:
        """Return the numbers of the landmarks that a keyframe sees, and their descriptors in it."""
        record = self.keyframes[keyframe]
        rows = np.flatnonzero(record.landmarks != NO_LANDMARK)
        return record.landmarks[rows], record.view.features.descriptors[rows]

    def local_keyframes(self, number: int) -> list[int]:
        """Return a keyframe, and its neighbours in the order of how many landmarks they share with it."""
        return [number, *self._neighbours(number)[:_LOCAL_NEIGHBOURS]]

    def local_landmarks(self, number: int) -> Rows:
        """Return the ascending numbers of the landmarks that a keyframe and its neighbours see."""
        return np.unique(
            np.concatenate([self.landmarks_of(keyframe) for keyframe in self.local_keyframes(number)])
        )

    @property
    def positions(self) -> Array:
        """Positions ``(k, 3)`` of all keyframes."""
        return np.array([inverse(keyframe.T_camera_world)[:3, 3] for keyframe in self.keyframes])

    def rank_by_similarity(self, place: LazyPlaceVector, count: int, among: Rows | None = None) -> list[int]:
        """Return the *count* keyframes whose place vectors are most similar to an image's, best first.

        Only keyframes of *among* are considered, all for None.
        """
        numbers = np.arange(len(self.keyframes)) if among is None else among
        vectors = np.stack([self.keyframes[number].view.place_vector.get() for number in numbers])
        ranked: list[int] = numbers[np.argsort(-(vectors @ place.get()), kind="stable")].tolist()
        return ranked[:count]

    def count_shared_landmarks(self, number: int) -> Rows:
        """Return how many landmarks each keyframe, also *number* itself, shares with *number*, ``(k,)``."""
        is_seen = np.zeros(len(self.points), dtype=bool)
        is_seen[self.landmarks_of(number)] = True
        return np.array([int(is_seen[self.landmarks_of(k)].sum()) for k in range(len(self.keyframes))])

    def median_depth(self, number: int) -> float:
        """Return the median depth of the landmarks that a keyframe sees, 1 if it sees none."""
        depths = self.depths(number)
        depths = depths[np.isfinite(depths)]
        return float(np.median(depths)) if len(depths) else 1.0

    def depths(self, number: int) -> Array:
        """Return the ``(n,)`` depths of a keyframe's features by their landmarks, NaN without a landmark."""
        keyframe = self.keyframes[number]
        seen = keyframe.landmarks != NO_LANDMARK
        depths = np.full(len(seen), np.nan)
        points = self.points[keyframe.landmarks[seen]]
        depths[seen] = transform(keyframe.T_camera_world, points)[:, 2]
        return depths

    # --- Adjust, move and clean up ---

    def adjust_around(self, number: int) -> None:
        """Adjust a keyframe, at most 9 neighbours, and all landmarks that these keyframes see.

        At most 12 further keyframes take part with fixed poses.  Outlier observations are removed.
        """
        window = [number, *self._neighbours(number)[: _WINDOW_KEYFRAMES - 1]]
        self._adjust(sorted(window), _FIXED_KEYFRAMES, iterations=_LOCAL_ITERATIONS)

    def adjust_all(self, *, iterations: int = 12) -> None:
        """Adjust all keyframes and landmarks twice; each time, outlier observations are removed afterwards.

        The first two keyframes keep their poses, which fixes the frame and the scale of the map.  A map of
        more than 200 keyframes stays as it is.
        """
        if len(self.keyframes) > _MAX_ADJUSTED_KEYFRAMES:
            return
        everything = list(range(len(self.keyframes)))
        self._adjust(everything, 0, iterations=iterations)
        self._adjust(everything, 0, iterations=iterations)

    def cull(self) -> None:
        """Remove landmarks that fewer than two keyframes see, and older ones that only two keyframes see.

        Older landmarks are those after whose newest keyframe at creation three or more keyframes were added.
        """
        counts = self._count_observations()
        age = len(self.keyframes) - 1 - self._creation_keyframes
        is_old = age >= _CULL_AGE_KEYFRAMES
        is_doubtful = (counts < 2) | (is_old & (counts < _CULL_OBSERVATIONS))
        self._remove(np.flatnonzero(self.is_alive & is_doubtful))

    def move(self, T_new_old: Array, scale: float = 1.0) -> None:
        """Express the map in another world frame: multiply all lengths by *scale*, then apply *T_new_old*.

        A point ``x`` of the world moves to ``T_new_old (scale x)``.
        """
        rotation = T_new_old[:3, :3]
        self.points = transform(T_new_old, scale * self.points)
        self._rays = scale * self._rays @ rotation.T
        self._orientations = self._orientations @ rotation.T
        for keyframe in self.keyframes:
            keyframe.T_camera_world = scaled(keyframe.T_camera_world, scale) @ inverse(T_new_old)

    def bend(self, older: int, newer: int, T_new_old: Array, scale: float) -> None:
        """Distribute the similarity that closes a loop over the keyframes of the loop.

        Each keyframe between *older* and *newer* moves by a share of the similarity that grows with its
        number from 0 to 1.  A landmark moves with the keyframe that was the newest one when the landmark was
        made.

        Args:
            older: Number of the keyframe that stays, with all before it.
            newer: Number of the keyframe that moves by the whole similarity, with all after it.
            T_new_old: ``(4, 4)``, rigid motion in the world, applied after the lengths are multiplied.
            scale: Factor of all lengths, about the origin of the world.
        """
        centre = inverse(self.keyframes[newer].T_camera_world)[:3, 3]
        moved_centre = transform(T_new_old, scale * centre[None])[0]
        twist = log_se3(_rotation_pose(T_new_old[:3, :3])[None])[0]
        numbers = np.arange(len(self.keyframes))
        shares = np.clip((numbers - older) / max(1, newer - older), 0.0, 1.0)
        rotations = exp_se3(shares[:, None] * twist)[:, :3, :3]
        scales = scale**shares
        # With the centre of the newer keyframe's camera before and after the whole similarity, and with the
        # share, scale and rotation R of a keyframe, a point x of this keyframe moves to
        # centre + share (moved_centre - centre) + scale R (x - centre).
        shifts = centre + shares[:, None] * (moved_centre - centre)
        shifts -= scales[:, None] * (rotations @ centre)
        for number in np.flatnonzero(shares > 0.0):
            motion = _rotation_pose(rotations[number])
            motion[:3, 3] = shifts[number]
            keyframe = self.keyframes[number]
            keyframe.T_camera_world = scaled(keyframe.T_camera_world, scales[number]) @ inverse(motion)
        of = self._creation_keyframes
        self.points = scales[of, None] * np.einsum("nij,nj->ni", rotations[of], self.points) + shifts[of]

    def fuse(self, number: int, landmarks: Rows, radius_px: float) -> None:
        """Match landmarks with a keyframe that does not see them yet, and fuse duplicates.

        Where the matched feature has another landmark already, both are the same point: all keyframes see the
        given landmark instead.

        Args:
            number: Number of the keyframe.
            landmarks: Numbers of landmarks.
            radius_px: Radius around the projected landmarks.
        """
        keyframe = self.keyframes[number]
        matches = self._match_projected(keyframe, landmarks, radius_px)
        matched, existing = matches.numbers, keyframe.landmarks[matches.features]
        is_free = existing == NO_LANDMARK
        keyframe.landmarks[matches.features[is_free]] = matched[is_free]
        # 1. Replace each duplicate by the matched landmark in all keyframes.
        replacements = np.arange(len(self.points) + 1)
        replacements[-1] = NO_LANDMARK  # the last row is that of NO_LANDMARK
        replacements[existing[~is_free]] = matched[~is_free]
        for record in self.keyframes:
            renumbered = replacements[record.landmarks]
            # 2. A keyframe sees a landmark once: its first feature keeps the landmark.
            unique, firsts = np.unique(renumbered, return_index=True)
            record.landmarks = np.full(len(renumbered), NO_LANDMARK)
            record.landmarks[firsts[unique != NO_LANDMARK]] = unique[unique != NO_LANDMARK]
        self.is_alive[existing[~is_free]] = False

    # --- Private: triangulation ---

    def _match_projected(self, keyframe: MonocularKeyframe, landmarks: Rows, radius_px: float) -> Matches:
        """Match landmarks that are alive and that a keyframe does not see near their projections in it."""
        landmarks = landmarks[self.is_alive[landmarks] & ~np.isin(landmarks, keyframe.landmarks)]
        limits = GuidedMatchLimits(radius_px=radius_px, lowe_ratio=VERIFY_LOWE_RATIO)
        return self.landmarks(landmarks).match(
            keyframe.T_camera_world, self.camera, keyframe.view.features, limits, 0.0
        )

    def _observe_again(self, number: int, landmarks: Rows) -> None:
        """Let a keyframe see landmarks that match its features without a landmark; others stay unseen."""
        keyframe = self.keyframes[number]
        matches = self._match_projected(keyframe, landmarks, _OBSERVE_RADIUS_PX)
        is_free = keyframe.landmarks[matches.features] == NO_LANDMARK
        keyframe.landmarks[matches.features[is_free]] = matches.numbers[is_free]

    def _triangulate(self, number: int, neighbour: int, depths: Array) -> None:
        """Match the features without a landmark of a keyframe and its neighbour, and add their points.

        *depths* ``(n,)`` are guesses of the depths of the keyframe's features.  Nothing is added if the two
        cameras are too near to each other; points with too little parallax or too large errors are left out.
        """
        one, two = self.keyframes[neighbour], self.keyframes[number]
        centres = [inverse(keyframe.T_camera_world)[:3, 3] for keyframe in (one, two)]
        if np.linalg.norm(centres[0] - centres[1]) < _MIN_BASELINE_DEPTH_SHARE * self.median_depth(number):
            return
        rows, columns = self._match_by_depth(one, two, depths)
        if not len(rows):
            return
        sizes = np.maximum(one.view.features.sizes[rows], two.view.features.sizes[columns])
        points, is_good = triangulate(
            one.T_camera_world,
            two.T_camera_world,
            one.view.features.pixels[rows],
            two.view.features.pixels[columns],
            self.camera,
            max_error_px=OUTLIER_SIGMAS * PIXEL_SIGMA_PX * sizes,
        )
        is_good &= parallax_deg(points, *centres) >= _MIN_PARALLAX_DEG
        self.add_landmarks(points[is_good], (neighbour, rows[is_good]), (number, columns[is_good]))

    def _interpolate_depths(self, number: int) -> Array | None:
        """Guess the depths of a keyframe's features by the three landmarks nearest in the image.

        The inverse of a guess is the mean of the inverse depths of these landmarks.  Returned is ``(n,)``,
        also for features with a landmark; None if the keyframe sees no landmark.
        """
        keyframe = self.keyframes[number]
        seen = np.flatnonzero(keyframe.landmarks != NO_LANDMARK)
        if not len(seen):
            return None
        known = transform(keyframe.T_camera_world, self.points[keyframe.landmarks[seen]])[:, 2]
        u, v = keyframe.view.features.pixels.T.astype(np.float32)
        squared = np.square(u[:, None] - u[seen]) + np.square(v[:, None] - v[seen])
        nearest = np.argpartition(squared, min(_DEPTH_LANDMARKS, len(seen)) - 1, axis=1)
        inverse_depths = (1.0 / np.maximum(known, _MIN_LANDMARK_DEPTH))[nearest[:, :_DEPTH_LANDMARKS]]
        depths: Array = 1.0 / inverse_depths.mean(axis=1)
        return depths

    def _match_by_depth(
        self, one: MonocularKeyframe, two: MonocularKeyframe, depths: Array
    ) -> tuple[Rows, Rows]:
        """Match the features without a landmark of two keyframes near the pixels that depths predict.

        *depths* ``(n,)`` are guesses of the depths of all features of the second keyframe, which are
        projected into the first one.  Returned are the rows of matched features in the first and in the
        second keyframe.
        """
        image = two.view.features
        free = np.flatnonzero(two.landmarks == NO_LANDMARK)
        T_world_two = inverse(two.T_camera_world)
        points = transform(T_world_two, self.camera.back_project(image.pixels[free], depths[free]))
        guesses = Landmarks(
            points=points,
            covariances=np.broadcast_to(np.zeros((3, 3)), (len(free), 3, 3)),
            shutter_displacements=np.broadcast_to(np.zeros(3), (len(free), 3)),
            descriptors=image.descriptors[free],
            rays=points - T_world_two[:3, 3],
            orientations=image.orientations[free] @ T_world_two[:3, :2].T,
            sizes=image.sizes[free],
            numbers=free,
        )
        limits = GuidedMatchLimits(radius_px=_SEARCH_RADIUS_PX)
        matches = guesses.match(one.T_camera_world, self.camera, one.view.features, limits, _SEARCH_RADIUS_PX)
        is_free = one.landmarks[matches.features] == NO_LANDMARK
        return matches.features[is_free], matches.numbers[is_free]

    def _neighbours(self, number: int) -> list[int]:
        """Return the keyframes that share at least `MIN_SHARED_LANDMARKS` with one, most first.

        The two keyframes before it follow, if they are not among them.
        """
        shared = self.count_shared_landmarks(number)
        shared[number] = 0
        order = np.argsort(-shared, kind="stable")
        covisible = [int(k) for k in order if shared[k] >= MIN_SHARED_LANDMARKS]
        latest = range(number - 1, max(-1, number - 1 - _LATEST_NEIGHBOURS), -1)
        return covisible + [k for k in latest if k not in covisible]

    def _update_appearance(self, number: int, landmarks: Rows, features: Rows) -> None:
        """Set descriptor, ray, orientation and size of landmarks to those in a keyframe.

        *features* are the rows of the keyframe's features that show *landmarks*.
        """
        keyframe = self.keyframes[number]
        image, T_world_camera = keyframe.view.features, inverse(keyframe.T_camera_world)
        self.descriptors[landmarks] = image.descriptors[features]
        self._rays[landmarks] = self.points[landmarks] - T_world_camera[:3, 3]
        self._orientations[landmarks] = image.orientations[features] @ T_world_camera[:3, :2].T
        self._sizes[landmarks] = image.sizes[features]

    def _count_observations(self) -> Rows:
        """Return how many keyframes see each landmark, ``(n,)``."""
        counts = np.zeros(len(self.points), dtype=np.int64)
        for number in range(len(self.keyframes)):
            counts[self.landmarks_of(number)] += 1
        return counts

    def _remove(self, landmarks: Rows) -> None:
        is_removed = np.zeros(len(self.points) + 1, dtype=bool)  # the last row is that of NO_LANDMARK
        is_removed[landmarks] = True
        self.is_alive[landmarks] = False
        for keyframe in self.keyframes:
            keyframe.landmarks[is_removed[keyframe.landmarks]] = NO_LANDMARK

    # --- Private: bundle adjustment ---

    def _adjust(self, window: list[int], fixed_count: int, *, iterations: int) -> None:
        """Adjust the keyframes of *window* and their landmarks; remove observations that do not fit.

        At most *fixed_count* further keyframes, those that see most of the landmarks, take part with fixed
        poses.  The first keyframe of the map never moves; of all that take part, the two oldest are fixed if
        fewer than two are.
        """
        # 1. Choose the landmarks that the window sees, and the keyframes with fixed poses.
        is_adjusted = np.zeros(len(self.points), dtype=bool)
        for number in window:
            is_adjusted[self.landmarks_of(number)] = True
        shared = {
            number: int(is_adjusted[self.landmarks_of(number)].sum())
            for number in range(len(self.keyframes))
            if number not in window
        }
        fixed = sorted((n for n in shared if shared[n] > 0), key=lambda n: -shared[n])[:fixed_count]
        numbers = sorted([*window, *fixed])
        is_fixed = np.array([number in fixed or number == 0 for number in numbers])
        if is_fixed.sum() < 2:
            is_fixed[:2] = True
        # 2. Collect all observations of these landmarks by these keyframes as one bundle.
        cameras, features, landmarks = self._observations(numbers, is_adjusted)
        used, points = np.unique(landmarks, return_inverse=True)
        images = [self.keyframes[number].view.features for number in numbers]
        features_of = np.split(features, np.cumsum(np.bincount(cameras, minlength=len(numbers)))[:-1])
        pixels = np.concatenate([i.pixels[rows] for i, rows in zip(images, features_of, strict=True)])
        sizes = np.concatenate([i.sizes[rows] for i, rows in zip(images, features_of, strict=True)])
        bundle = Bundle(
            T_camera_world=np.stack([self.keyframes[number].T_camera_world for number in numbers]),
            is_fixed=is_fixed,
            points_world=self.points[used],
            cameras=cameras,
            points=points.ravel(),
            pixels=pixels,
            sigma_px=sizes * PIXEL_SIGMA_PX,
        )
        # 3. Adjust the bundle, and write its points and poses back into the map.
        bundle = self._solve(bundle, iterations)
        self.points[used] = bundle.points_world
        for camera, number in enumerate(numbers):
            self.keyframes[number].T_camera_world = bundle.T_camera_world[camera]
        # 4. Remove observations with large errors, then landmarks that fewer than two keyframes see.
        errors_px, _ = reprojection_errors(
            bundle.T_camera_world[bundle.cameras], bundle.points_world[bundle.points], pixels, self.camera
        )
        is_outlier = errors_px > OUTLIER_SIGMAS * bundle.sigma_px
        for camera, number in enumerate(numbers):
            self.keyframes[number].landmarks[features[is_outlier & (cameras == camera)]] = NO_LANDMARK
        self._remove(used[self._count_observations()[used] < 2])

    def _observations(self, numbers: list[int], is_wanted: npt.NDArray[np.bool_]) -> tuple[Rows, Rows, Rows]:
        """Return all observations of wanted landmarks by keyframes.

        Returned are, ``(n,)`` each, the row of *numbers*, the feature and the landmark of each observation;
        they are sorted by the row of *numbers*.
        """
        cameras, features, landmarks = [], [], []
        for camera, number in enumerate(numbers):
            of_features = self.keyframes[number].landmarks
            rows = np.flatnonzero(of_features != NO_LANDMARK)
            rows = rows[is_wanted[of_features[rows]]]
            cameras.append(np.full(len(rows), camera))
            features.append(rows)
            landmarks.append(of_features[rows])
        return np.concatenate(cameras), np.concatenate(features), np.concatenate(landmarks)

    def _solve(self, bundle: Bundle, iterations: int) -> Bundle:
        """Return a new bundle with adjusted poses and points.

        Of more than 3,000 landmarks, only those seen most often determine the poses; then all landmarks are
        adjusted to the new poses.
        """
        if len(bundle.points_world) <= _MAX_POSE_LANDMARKS:
            poses, points = self._adjust_bundle(bundle, self.camera, iterations=iterations)
            return replace(bundle, T_camera_world=poses, points_world=points)
        # 1. Adjust the cameras and the landmarks that are seen most often.
        counts = np.bincount(bundle.points, minlength=len(bundle.points_world))
        is_used = np.zeros(len(counts), dtype=bool)
        is_used[np.argsort(-counts, kind="stable")[:_MAX_POSE_LANDMARKS]] = True
        rows = is_used[bundle.points]
        poses, points = self._adjust_bundle(
            replace(
                bundle,
                cameras=bundle.cameras[rows],
                points=bundle.points[rows],
                pixels=bundle.pixels[rows],
                sigma_px=bundle.sigma_px[rows],
            ),
            self.camera,
            iterations=iterations,
        )
        # 2. Adjust all landmarks to the cameras, which are fixed now.
        bundle = replace(bundle, T_camera_world=poses, points_world=points)
        with_fixed_cameras = replace(bundle, is_fixed=np.ones(len(poses), dtype=bool))
        _, points = self._adjust_bundle(with_fixed_cameras, self.camera, iterations=iterations)
        return replace(bundle, points_world=points)


def _rotation_pose(rotation: Array) -> Array:
    pose = np.eye(4)
    pose[:3, :3] = rotation
    return pose
