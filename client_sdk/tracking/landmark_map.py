"""The map of one camera without depth: keyframes, the landmarks that they see, and their adjustment.

A landmark is a point that two or more keyframes have triangulated.  Memory and time are bounded by
``LandmarkLimits``.  It holds no images and sends nothing; which frame becomes a keyframe, and which places
are the same, is decided elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from client_sdk.monocular.bundle import Adjuster, Bundle, adjust
from client_sdk.tracking.keyframe_map import NO_LANDMARK, Landmarks
from client_sdk.tracking.place import Place
from rse_pf.geometry import Array, Camera, exp_se3, inverse, log_se3, scaled, transform
from rse_pf.maps.descriptors import Descriptors
from rse_pf.slam.place_recognition import PlaceVector
from rse_pf.slam.tracking import ImageFeatures, NearLimits
from rse_pf.slam.triangulation import parallax_deg, reprojection_errors, triangulate

__all__ = ["MIN_SHARED", "LandmarkLimits", "LandmarkMap", "ViewFeatures"]

Rows = npt.NDArray[np.int64]

MIN_SHARED = 15
"""Keyframes that share so many landmarks are neighbours."""
_NEAREST_LANDMARKS = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class LandmarkLimits:
    """How much a map holds, and which observations it accepts.

    Attributes:
        neighbours: Keyframes with which a new one is triangulated.
        local: Keyframes that share landmarks with one, among whose landmarks a frame is matched.
        search_px: Radius in which a feature is sought whose depth is that of the landmarks around it.
        window: Keyframes that a local adjustment moves.
        fixed: Further keyframes that see the same landmarks and take part with fixed poses.
        in_all: Landmarks that an adjustment of all keyframes takes, those seen most; the others follow.
        max_in_all: Keyframes of a map beyond which they are no longer adjusted all together.
        min_parallax_deg: Smallest angle between the rays of a new landmark.
        outlier_sigma: Observations farther than this many standard deviations from the landmark are removed.
        pixel_sigma: Standard deviation of a feature of the finest octave, pixels.
        max_keyframes: After that the map is tracked, and no longer extended.
    """

    neighbours: int = 6
    local: int = 20
    search_px: float = 30.0
    window: int = 10
    fixed: int = 12
    in_all: int = 3000
    max_in_all: int = 200
    min_parallax_deg: float = 1.0
    outlier_sigma: float = 2.45
    pixel_sigma: float = 1.0
    max_keyframes: int = 1000


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ViewFeatures:
    """Features of one image, their ``(n, 3)`` uint8 colours, and its place."""

    image: ImageFeatures
    colours: npt.NDArray[np.uint8]
    place: Place


@dataclass(slots=True, kw_only=True, eq=False)
class _Keyframe:
    """``landmarks`` ``(n,)`` holds the landmark of each feature, or NO_LANDMARK."""

    features: ViewFeatures
    T_camera_world: Array
    landmarks: Rows
    place: PlaceVector


class LandmarkMap:
    """Keyframes and landmarks; ``camera`` took all of them, and *adjuster* adjusts them as `adjust` does."""

    def __init__(
        self, camera: Camera, limits: LandmarkLimits | None = None, adjuster: Adjuster = adjust
    ) -> None:
        self.camera = camera
        self._adjust_bundle = adjuster
        self.limits = limits or LandmarkLimits()
        self.keyframes: list[_Keyframe] = []
        self.points: Array = np.empty((0, 3))
        self.descriptors: Descriptors = np.empty((0, 0), dtype=np.uint8)
        self.colours: npt.NDArray[np.uint8] = np.empty((0, 3), dtype=np.uint8)
        self.is_alive: npt.NDArray[np.bool_] = np.empty(0, dtype=bool)
        self._born: Rows = np.empty(0, dtype=np.int64)
        self._rays: Array = np.empty((0, 3))
        self._turns: Array = np.empty((0, 3))
        self._sizes: Array = np.empty(0)

    def __len__(self) -> int:
        return int(self.is_alive.sum())

    def add_keyframe(self, features: ViewFeatures, T_camera_world: Array, landmarks: Rows) -> int:
        """Add a keyframe whose features see *landmarks*, ``(n,)``, and return its number."""
        if not len(self.points):
            self.descriptors = features.image.descriptors[:0]
        self.keyframes.append(
            _Keyframe(
                features=features,
                T_camera_world=T_camera_world,
                landmarks=landmarks.copy(),
                place=features.place.vector(),
            )
        )
        seen = np.flatnonzero(landmarks != NO_LANDMARK)
        self._observed(len(self.keyframes) - 1, landmarks[seen], seen)
        return len(self.keyframes) - 1

    def add_landmarks(self, points: Array, first: tuple[int, Rows], second: tuple[int, Rows]) -> None:
        """Add landmarks that two keyframes see; each is (number of the keyframe, rows of its features)."""
        rows = len(self.points) + np.arange(len(points))
        features = self.keyframes[second[0]].features
        self.points = np.concatenate((self.points, points))
        self.descriptors = np.concatenate((self.descriptors, features.image.descriptors[second[1]]))
        self.colours = np.concatenate((self.colours, features.colours[second[1]]))
        self.is_alive = np.concatenate((self.is_alive, np.ones(len(points), dtype=bool)))
        self._born = np.concatenate((self._born, np.full(len(points), len(self.keyframes) - 1)))
        self._rays = np.concatenate((self._rays, np.zeros((len(points), 3))))
        self._turns = np.concatenate((self._turns, np.zeros((len(points), 3))))
        self._sizes = np.concatenate((self._sizes, np.ones(len(points))))
        for number, of_features in (first, second):
            self.keyframes[number].landmarks[of_features] = rows
            self._observed(number, rows, of_features)

    def landmarks_of(self, number: int) -> Rows:
        """Return the landmarks that a keyframe sees."""
        landmarks: Rows = self.keyframes[number].landmarks
        seen: Rows = landmarks[landmarks != NO_LANDMARK]
        return seen

    def landmarks(self, numbers: Rows) -> Landmarks:
        """Return landmarks as they are sought in an image; they are points without spread."""
        return Landmarks(
            points=self.points[numbers], spreads=np.broadcast_to(np.zeros((3, 3)), (len(numbers), 3, 3)),
            descriptors=self.descriptors[numbers], rays=self._rays[numbers], turns=self._turns[numbers],
            sizes=self._sizes[numbers], numbers=numbers,
        )  # fmt: skip

    def local(self, number: int) -> list[int]:
        """Return a keyframe and those that share landmarks with it, most first."""
        return [number, *self._neighbours(number)[: self.limits.local]]

    def around(self, number: int) -> Rows:
        """Return the landmarks of a keyframe and of those that share landmarks with it."""
        return np.unique(np.concatenate([self.landmarks_of(keyframe) for keyframe in self.local(number)]))

    def most_alike(self, place: Place, among: Rows) -> list[int]:
        """Return keyframes of *among* in the order of how much they look like an image."""
        places = np.stack([self.keyframes[number].place for number in among])
        alike: list[int] = among[np.argsort(-(places @ place.vector()), kind="stable")].tolist()
        return alike

    def landmarks_in(self, number: int) -> tuple[Rows, Descriptors]:
        """Return the landmarks of one keyframe, and the descriptors that this keyframe has of them."""
        keyframe = self.keyframes[number]
        rows = np.flatnonzero(keyframe.landmarks != NO_LANDMARK)
        return keyframe.landmarks[rows], keyframe.features.image.descriptors[rows]

    def extend(self, number: int) -> int:
        """Triangulate what a keyframe and its neighbours see and no landmark has; return how many."""
        before = len(self.points)
        depths = self._depths_nearby(number)
        if depths is None:
            return 0
        for other in self._neighbours(number)[: self.limits.neighbours]:
            self._triangulate(number, other, depths)
        for other in self._neighbours(number):
            self._observe_again(other, np.arange(before, len(self.points)))
        return len(self.points) - before

    def adjust_around(self, number: int) -> None:
        """Adjust a keyframe, its neighbours, and all landmarks that they see; remove outliers."""
        window = [number, *self._neighbours(number)[: self.limits.window - 1]]
        self._adjust(sorted(window), self.limits.fixed, iterations=5)

    def adjust_all(self, *, iterations: int = 12) -> None:
        """Adjust every keyframe and every landmark; the first two keyframes keep their places.

        A map of more than ``max_in_all`` keyframes stays as it is.
        """
        if len(self.keyframes) > self.limits.max_in_all:
            return
        everything = list(range(len(self.keyframes)))
        self._adjust(everything, 0, iterations=iterations)
        self._adjust(everything, 0, iterations=iterations)

    def cull(self) -> None:
        """Remove landmarks that only two keyframes see although newer ones should."""
        counts = self._observation_counts()
        age = len(self.keyframes) - 1 - self._born
        self._remove(np.flatnonzero(self.is_alive & ((counts < 2) | ((age >= 3) & (counts < 3)))))

    def move(self, T_new_old: Array, scale: float = 1.0) -> None:
        """Express the map in another frame: multiply all lengths by *scale*, then move it by *T_new_old*."""
        rotation = T_new_old[:3, :3]
        self.points = transform(T_new_old, scale * self.points)
        self._rays = scale * self._rays @ rotation.T
        self._turns = self._turns @ rotation.T
        for keyframe in self.keyframes:
            keyframe.T_camera_world = scaled(keyframe.T_camera_world, scale) @ inverse(T_new_old)

    def take(self, other: LandmarkMap) -> tuple[int, int]:
        """Add all of another map in the same frame; return the numbers of its first keyframe and landmark."""
        keyframe, landmark = len(self.keyframes), len(self.points)
        if not landmark:
            self.descriptors = other.descriptors[:0]
        self.keyframes += [
            replace(
                record,
                landmarks=np.where(record.landmarks == NO_LANDMARK, NO_LANDMARK, record.landmarks + landmark),
            )
            for record in other.keyframes
        ]
        self.points = np.concatenate((self.points, other.points))
        self.descriptors = np.concatenate((self.descriptors, other.descriptors))
        self.colours = np.concatenate((self.colours, other.colours))
        self.is_alive = np.concatenate((self.is_alive, other.is_alive))
        self._born = np.concatenate((self._born, other._born + keyframe))
        self._rays = np.concatenate((self._rays, other._rays))
        self._turns = np.concatenate((self._turns, other._turns))
        self._sizes = np.concatenate((self._sizes, other._sizes))
        return keyframe, landmark

    def bend(self, older: int, newer: int, T_new_old: Array, scale: float) -> None:
        """Move the keyframes between two by a growing share of what moves the newer one and its landmarks.

        Args:
            older: Stays, with all before it.
            newer: Moves as a whole, with all after it: by *T_new_old* after its lengths are multiplied.
            T_new_old: ``(4, 4)``.
            scale: Of all lengths, about the origin.
        """
        centre = inverse(self.keyframes[newer].T_camera_world)[:3, 3]
        moved = transform(T_new_old, scale * centre[None])[0]
        turn = log_se3(_turned(T_new_old[:3, :3])[None])[0]
        numbers = np.arange(len(self.keyframes))
        shares = np.clip((numbers - older) / max(1, newer - older), 0.0, 1.0)
        rotations = exp_se3(shares[:, None] * turn)[:, :3, :3]
        scales = scale**shares
        # x -> centre + share (moved - centre) + scale R (x - centre), of each keyframe.
        shifts = centre + shares[:, None] * (moved - centre)
        shifts -= scales[:, None] * (rotations @ centre)
        for number in np.flatnonzero(shares > 0.0):
            motion = _turned(rotations[number])
            motion[:3, 3] = shifts[number]
            keyframe = self.keyframes[number]
            keyframe.T_camera_world = scaled(keyframe.T_camera_world, scales[number]) @ inverse(motion)
        born = self._born
        self.points = (
            scales[born, None] * np.einsum("nij,nj->ni", rotations[born], self.points) + shifts[born]
        )

    def fuse(self, number: int, landmarks: Rows, radius_px: float) -> int:
        """Let a keyframe see *landmarks* where it sees them; return how many were two landmarks, now one.

        Where the feature at the projected pixel has another landmark already, both are the same.
        """
        keyframe = self.keyframes[number]
        landmarks = landmarks[self.is_alive[landmarks] & ~np.isin(landmarks, keyframe.landmarks)]
        rows, columns = self.landmarks(landmarks).seek(
            keyframe.T_camera_world, self.camera, keyframe.features.image,
            NearLimits(radius_px=radius_px, ratio=0.9), 0.0,
        )  # fmt: skip
        landmarks, same = landmarks[rows], keyframe.landmarks[columns]
        is_free = same == NO_LANDMARK
        keyframe.landmarks[columns[is_free]] = landmarks[is_free]
        becomes = np.arange(len(self.points) + 1)
        becomes[-1] = NO_LANDMARK  # where NO_LANDMARK points to
        becomes[same[~is_free]] = landmarks[~is_free]
        for record in self.keyframes:
            renamed = becomes[record.landmarks]
            known, firsts = np.unique(renamed, return_index=True)
            record.landmarks = np.full(len(renamed), NO_LANDMARK)
            record.landmarks[firsts[known != NO_LANDMARK]] = known[known != NO_LANDMARK]
        self.is_alive[same[~is_free]] = False
        return int((~is_free).sum())

    def shared_with(self, number: int) -> Rows:
        """Return how many landmarks each keyframe shares with one, ``(k,)``."""
        own = np.zeros(len(self.points), dtype=bool)
        own[self.landmarks_of(number)] = True
        return np.array([int(own[self.landmarks_of(other)].sum()) for other in range(len(self.keyframes))])

    def _observed(self, number: int, landmarks: Rows, of_features: Rows) -> None:
        """Take how landmarks look in the newest keyframe that sees them."""
        keyframe = self.keyframes[number]
        image, T = keyframe.features.image, inverse(keyframe.T_camera_world)
        self.descriptors[landmarks] = image.descriptors[of_features]
        self._rays[landmarks] = self.points[landmarks] - T[:3, 3]
        self._turns[landmarks] = image.turns[of_features] @ T[:3, :2].T
        self._sizes[landmarks] = image.sizes[of_features]

    def _neighbours(self, number: int) -> list[int]:
        """Return the other keyframes that share landmarks with one, most first."""
        shared = self.shared_with(number)
        shared[number] = 0
        order = np.argsort(-shared, kind="stable")
        near = [int(other) for other in order if shared[other] >= MIN_SHARED]
        latest = [other for other in range(number - 1, max(-1, number - 3), -1) if other not in near]
        return near + latest

    def _triangulate(self, number: int, other: int, depths: Array) -> None:
        one, two = self.keyframes[other], self.keyframes[number]
        base = np.linalg.norm(inverse(one.T_camera_world)[:3, 3] - inverse(two.T_camera_world)[:3, 3])
        if base < 0.01 * self.median_depth(number):
            return
        rows, columns = self._matches_by_depth(one, two, depths)
        if not len(rows):
            return
        sigma = np.maximum(one.features.image.sizes[rows], two.features.image.sizes[columns])
        points, good = triangulate(
            one.T_camera_world, two.T_camera_world, one.features.image.pixels[rows],
            two.features.image.pixels[columns], self.camera,
            max_error_px=self.limits.outlier_sigma * self.limits.pixel_sigma * sigma,
        )  # fmt: skip
        angles = parallax_deg(points, inverse(one.T_camera_world)[:3, 3], inverse(two.T_camera_world)[:3, 3])
        good &= angles >= self.limits.min_parallax_deg
        self.add_landmarks(points[good], (other, rows[good]), (number, columns[good]))

    def _depths_nearby(self, number: int) -> Array | None:
        """Return the depth that each feature of a keyframe may have by the landmarks around it in the image.

        The mean, in inverse depth, of the three nearest landmarks; None without landmarks.
        """
        keyframe = self.keyframes[number]
        seen = np.flatnonzero(keyframe.landmarks != NO_LANDMARK)
        if not len(seen):
            return None
        known = transform(keyframe.T_camera_world, self.points[keyframe.landmarks[seen]])[:, 2]
        u, v = keyframe.features.image.pixels.T.astype(np.float32)
        squared = np.square(u[:, None] - u[seen]) + np.square(v[:, None] - v[seen])
        nearest = np.argpartition(squared, min(_NEAREST_LANDMARKS, len(seen)) - 1, axis=1)[
            :, :_NEAREST_LANDMARKS
        ]
        depths: Array = 1.0 / (1.0 / np.maximum(known, 1e-3))[nearest].mean(axis=1)
        return depths

    def _matches_by_depth(self, one: _Keyframe, two: _Keyframe, depths: Array) -> tuple[Rows, Rows]:
        """Return free features of two keyframes that match near the pixels which depths predict."""
        image = two.features.image
        free = np.flatnonzero(two.landmarks == NO_LANDMARK)
        T_world_two = inverse(two.T_camera_world)
        points = transform(T_world_two, self.camera.back_project(image.pixels[free], depths[free]))
        looks = Landmarks(
            points=points, spreads=np.empty((0, 3, 3)), descriptors=image.descriptors[free],
            rays=points - T_world_two[:3, 3], turns=image.turns[free] @ T_world_two[:3, :2].T,
            sizes=image.sizes[free], numbers=free,
        )  # fmt: skip
        rows, columns = looks.seek(
            one.T_camera_world, self.camera, one.features.image,
            NearLimits(radius_px=self.limits.search_px), self.limits.search_px,
        )  # fmt: skip
        is_free = one.landmarks[columns] == NO_LANDMARK
        return columns[is_free], free[rows[is_free]]

    def _observe_again(self, number: int, landmarks: Rows) -> None:
        """Let a keyframe see *landmarks* where its free features look alike at the projected pixels."""
        keyframe = self.keyframes[number]
        landmarks = landmarks[self.is_alive[landmarks] & ~np.isin(landmarks, keyframe.landmarks)]
        rows, columns = self.landmarks(landmarks).seek(
            keyframe.T_camera_world, self.camera, keyframe.features.image,
            NearLimits(radius_px=3.0, ratio=0.9), 0.0,
        )  # fmt: skip
        is_free = keyframe.landmarks[columns] == NO_LANDMARK
        keyframe.landmarks[columns[is_free]] = landmarks[rows[is_free]]

    def median_depth(self, number: int) -> float:
        """Return the median depth of the landmarks that a keyframe sees, 1 if it sees none."""
        depths = self.depths(number)
        depths = depths[np.isfinite(depths)]
        return float(np.median(depths)) if len(depths) else 1.0

    def depths(self, number: int) -> Array:
        """Return the ``(n,)`` depths of a keyframe's features by their landmarks, NaN where there is none."""
        keyframe = self.keyframes[number]
        seen = keyframe.landmarks != NO_LANDMARK
        depths = np.full(len(seen), np.nan)
        points = self.points[keyframe.landmarks[seen]]
        depths[seen] = transform(keyframe.T_camera_world, points)[:, 2]
        return depths

    def _observation_counts(self) -> Rows:
        counts = np.zeros(len(self.points), dtype=np.int64)
        for number in range(len(self.keyframes)):
            counts[self.landmarks_of(number)] += 1
        return counts

    def _remove(self, landmarks: Rows) -> None:
        gone = np.zeros(len(self.points) + 1, dtype=bool)
        gone[landmarks] = True
        self.is_alive[landmarks] = False
        for keyframe in self.keyframes:
            keyframe.landmarks[gone[keyframe.landmarks]] = NO_LANDMARK

    def _adjust(self, window: list[int], fixed: int, *, iterations: int) -> None:
        in_window = np.zeros(len(self.points), dtype=bool)
        for number in window:
            in_window[self.landmarks_of(number)] = True
        shared = {
            number: int(in_window[self.landmarks_of(number)].sum())
            for number in range(len(self.keyframes))
            if number not in window
        }
        helpers = sorted((n for n in shared if shared[n] > 0), key=lambda n: -shared[n])[:fixed]
        numbers = sorted([*window, *helpers])
        is_fixed = np.array([number in helpers or number == 0 for number in numbers])
        if is_fixed.sum() < 2:
            is_fixed[:2] = True
        table, landmarks = self._observations(numbers, in_window)
        used, of_points = np.unique(landmarks, return_inverse=True)
        images = [self.keyframes[number].features.image for number in numbers]
        counts = np.bincount(table[:, 0], minlength=len(numbers))
        rows_of = np.split(table[:, 1], np.cumsum(counts)[:-1])
        pixels = np.concatenate([image.pixels[rows] for image, rows in zip(images, rows_of, strict=True)])
        sigma = np.concatenate([image.sizes[rows] for image, rows in zip(images, rows_of, strict=True)])
        bundle = Bundle(
            T_camera_world=np.stack([self.keyframes[number].T_camera_world for number in numbers]),
            is_fixed=is_fixed,
            points_world=self.points[used],
            cameras=table[:, 0],
            points=of_points.ravel(),
            pixels=pixels,
            sigma_px=sigma * self.limits.pixel_sigma,
        )
        bundle = self._adjusted(bundle, iterations)
        self.points[used] = bundle.points_world
        for row, number in enumerate(numbers):
            self.keyframes[number].T_camera_world = bundle.T_camera_world[row]
        errors, _ = reprojection_errors(
            bundle.T_camera_world[bundle.cameras], bundle.points_world[bundle.points], pixels, self.camera
        )
        wrong = errors > self.limits.outlier_sigma * bundle.sigma_px
        for row, number in enumerate(numbers):
            own = wrong & (table[:, 0] == row)
            self.keyframes[number].landmarks[table[own, 1]] = NO_LANDMARK
        self._remove(used[self._observation_counts()[used] < 2])

    def _observations(self, numbers: list[int], is_wanted: npt.NDArray[np.bool_]) -> tuple[Rows, Rows]:
        """Return ``(n, 2)`` row in *numbers* and feature, and the ``(n,)`` wanted landmark that it sees."""
        table, landmarks = [], []
        for row, number in enumerate(numbers):
            of_features = self.keyframes[number].landmarks
            features = np.flatnonzero(of_features != NO_LANDMARK)
            features = features[is_wanted[of_features[features]]]
            table.append(np.column_stack((np.full(len(features), row), features)))
            landmarks.append(of_features[features])
        return np.concatenate(table), np.concatenate(landmarks)

    def _adjusted(self, bundle: Bundle, iterations: int) -> Bundle:
        """Return a bundle after its adjustment: by its landmarks that are seen most, if there are many."""
        if len(bundle.points_world) <= self.limits.in_all:
            poses, points = self._adjust_bundle(bundle, self.camera, iterations=iterations)
            return replace(bundle, T_camera_world=poses, points_world=points)
        seen = np.bincount(bundle.points, minlength=len(bundle.points_world))
        takes_part = np.zeros(len(seen), dtype=bool)
        takes_part[np.argsort(-seen, kind="stable")[: self.limits.in_all]] = True
        rows = takes_part[bundle.points]
        poses, points = self._adjust_bundle(
            replace(
                bundle, cameras=bundle.cameras[rows], points=bundle.points[rows], pixels=bundle.pixels[rows],
                sigma_px=bundle.sigma_px[rows],
            ),
            self.camera, iterations=iterations,
        )  # fmt: skip
        bundle = replace(bundle, T_camera_world=poses, points_world=points)
        everywhere = replace(bundle, is_fixed=np.ones(len(poses), dtype=bool))
        _, points = self._adjust_bundle(everywhere, self.camera, iterations=iterations)
        return replace(bundle, points_world=points)


def _turned(rotation: Array) -> Array:
    pose = np.eye(4)
    pose[:3, :3] = rotation
    return pose
