"""The map of one camera without depth: keyframes, the landmarks that they see, and their adjustment.

A landmark is a point that two or more keyframes have triangulated.  Memory and time are bounded by
``LandmarkLimits``.  It holds no images and sends nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from client_sdk.monocular.bundle import Bundle, adjust, reprojection_errors
from client_sdk.monocular.descriptors import match_all, match_near
from client_sdk.monocular.two_view import parallax_deg, triangulate
from rse_pf.geometry import Array, Camera, inverse, transform

__all__ = ["LandmarkLimits", "LandmarkMap", "ViewFeatures"]

Rows = npt.NDArray[np.int64]
NO_LANDMARK = -1


@dataclass(frozen=True, slots=True, kw_only=True)
class LandmarkLimits:
    """How much a map holds, and which observations it accepts.

    Attributes:
        neighbours: Keyframes with which a new one is triangulated.
        window: Keyframes that a local adjustment moves.
        fixed: Further keyframes that see the same landmarks and take part with fixed poses.
        min_parallax_deg: Smallest angle between the rays of a new landmark.
        outlier_sigma: Observations farther than this many standard deviations from the landmark are removed.
        pixel_sigma: Standard deviation of a feature of the finest octave, pixels.
        max_keyframes: After that the map is tracked, and no longer extended.
    """

    neighbours: int = 6
    window: int = 10
    fixed: int = 12
    min_parallax_deg: float = 1.0
    outlier_sigma: float = 2.45
    pixel_sigma: float = 1.0
    max_keyframes: int = 1000


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ViewFeatures:
    """Features of one image: ``pixels`` ``(n, 2)``, ``descriptors`` ``(n, 32)``, ``sigma_px`` ``(n,)``,
    ``colours`` ``(n, 3)`` uint8."""

    pixels: Array
    descriptors: npt.NDArray[np.uint8]
    sigma_px: Array
    colours: npt.NDArray[np.uint8]


@dataclass(slots=True, kw_only=True, eq=False)
class _Keyframe:
    """``landmarks`` ``(n,)`` holds the landmark of each feature, or NO_LANDMARK."""

    features: ViewFeatures
    T_camera_world: Array
    landmarks: Rows


class LandmarkMap:
    """Keyframes and landmarks; ``camera`` took all of them."""

    def __init__(self, camera: Camera, limits: LandmarkLimits | None = None) -> None:
        self.camera = camera
        self.limits = limits or LandmarkLimits()
        self.keyframes: list[_Keyframe] = []
        self.points: Array = np.empty((0, 3))
        self.descriptors: npt.NDArray[np.uint8] = np.empty((0, 32), dtype=np.uint8)
        self.colours: npt.NDArray[np.uint8] = np.empty((0, 3), dtype=np.uint8)
        self.is_alive: npt.NDArray[np.bool_] = np.empty(0, dtype=bool)
        self._born: Rows = np.empty(0, dtype=np.int64)
        self._seen_from: Array = np.empty((0, 3))

    def __len__(self) -> int:
        return int(self.is_alive.sum())

    def add_keyframe(self, features: ViewFeatures, T_camera_world: Array, landmarks: Rows) -> int:
        """Add a keyframe whose features see *landmarks*, ``(n,)``, and return its number."""
        self.keyframes.append(
            _Keyframe(features=features, T_camera_world=T_camera_world, landmarks=landmarks.copy())
        )
        seen = np.flatnonzero(landmarks != NO_LANDMARK)
        self._observed(len(self.keyframes) - 1, landmarks[seen], seen)
        return len(self.keyframes) - 1

    def add_landmarks(self, points: Array, first: tuple[int, Rows], second: tuple[int, Rows]) -> None:
        """Add landmarks that two keyframes see; each is (number of the keyframe, rows of its features)."""
        rows = len(self.points) + np.arange(len(points))
        features = self.keyframes[second[0]].features
        self.points = np.concatenate((self.points, points))
        self.descriptors = np.concatenate((self.descriptors, features.descriptors[second[1]]))
        self.colours = np.concatenate((self.colours, features.colours[second[1]]))
        self.is_alive = np.concatenate((self.is_alive, np.ones(len(points), dtype=bool)))
        self._born = np.concatenate((self._born, np.full(len(points), len(self.keyframes) - 1)))
        self._seen_from = np.concatenate((self._seen_from, np.zeros((len(points), 3))))
        for number, of_features in (first, second):
            self.keyframes[number].landmarks[of_features] = rows
            self._observed(number, rows, of_features)

    def landmarks_of(self, number: int) -> Rows:
        """Return the landmarks that a keyframe sees."""
        landmarks: Rows = self.keyframes[number].landmarks
        seen: Rows = landmarks[landmarks != NO_LANDMARK]
        return seen

    def visible(self, T_camera_world: Array, margin_px: float = 0.0) -> tuple[Rows, Array]:
        """Return the landmarks that lie in the image of a pose, and their ``(n, 2)`` pixels.

        Landmarks that were seen from a very different direction are left out: they would look different.
        """
        points = transform(T_camera_world, self.points)
        ahead = np.flatnonzero(self.is_alive & (points[:, 2] > 1e-3))
        pixels = self.camera.project(points[ahead])
        size = np.array([self.camera.width, self.camera.height])
        inside = ((pixels > -margin_px) & (pixels < size + margin_px)).all(axis=1)
        rays = self.points[ahead] - inverse(T_camera_world)[:3, 3]
        lengths = np.linalg.norm(rays, axis=1)
        before = self._seen_from[ahead]
        lengths_before = np.linalg.norm(before, axis=1)
        cosines = np.einsum("ij,ij->i", rays, before) / np.maximum(lengths * lengths_before, 1e-12)
        ratio = lengths / np.maximum(lengths_before, 1e-12)
        kept = inside & (cosines > 0.6) & (ratio > 0.5) & (ratio < 2.0)
        return ahead[kept], pixels[kept]

    def extend(self, number: int) -> int:
        """Triangulate what a keyframe and its neighbours see and no landmark has; return how many."""
        before = len(self.points)
        for other in self._neighbours(number)[: self.limits.neighbours]:
            self._triangulate(number, other)
        for other in self._neighbours(number):
            self._observe_again(other, np.arange(before, len(self.points)))
        return len(self.points) - before

    def adjust_around(self, number: int) -> None:
        """Adjust a keyframe, its neighbours, and all landmarks that they see; remove outliers."""
        window = [number, *self._neighbours(number)[: self.limits.window - 1]]
        self._adjust(sorted(window), self.limits.fixed, iterations=5)

    def adjust_all(self, *, iterations: int = 12) -> None:
        """Adjust every keyframe and every landmark."""
        self._adjust(list(range(len(self.keyframes))), 0, iterations=iterations)
        self._adjust(list(range(len(self.keyframes))), 0, iterations=iterations)

    def cull(self) -> None:
        """Remove landmarks that only two keyframes see although newer ones should."""
        counts = self._observation_counts()
        age = len(self.keyframes) - 1 - self._born
        self._remove(np.flatnonzero(self.is_alive & ((counts < 2) | ((age >= 3) & (counts < 3)))))

    def rescale(self, scale: float) -> None:
        """Multiply all lengths by *scale*."""
        self.points *= scale
        self._seen_from *= scale
        for keyframe in self.keyframes:
            pose = keyframe.T_camera_world.copy()
            pose[:3, 3] *= scale
            keyframe.T_camera_world = pose

    def _observed(self, number: int, landmarks: Rows, of_features: Rows) -> None:
        """Take the newest descriptor and direction of landmarks that a keyframe sees."""
        keyframe = self.keyframes[number]
        self.descriptors[landmarks] = keyframe.features.descriptors[of_features]
        self._seen_from[landmarks] = self.points[landmarks] - inverse(keyframe.T_camera_world)[:3, 3]

    def _neighbours(self, number: int) -> list[int]:
        """Return the other keyframes that share landmarks with one, most first."""
        own = np.zeros(len(self.points), dtype=bool)
        own[self.landmarks_of(number)] = True
        shared = np.array([int(own[self.landmarks_of(each)].sum()) for each in range(len(self.keyframes))])
        shared[number] = 0
        order = np.argsort(-shared, kind="stable")
        near = [int(each) for each in order if shared[each] >= 15]
        latest = [each for each in range(number - 1, max(-1, number - 3), -1) if each not in near]
        return near + latest

    def _triangulate(self, number: int, other: int) -> None:
        one, two = self.keyframes[other], self.keyframes[number]
        base = np.linalg.norm(inverse(one.T_camera_world)[:3, 3] - inverse(two.T_camera_world)[:3, 3])
        if base < 0.01 * self.median_depth(number):
            return
        free_one = np.flatnonzero(one.landmarks == NO_LANDMARK)
        free_two = np.flatnonzero(two.landmarks == NO_LANDMARK)
        rows, columns = match_all(
            one.features.descriptors[free_one],
            two.features.descriptors[free_two],
            ratio=0.85,
            max_distance=50,
        )
        if not len(rows):
            return
        rows, columns = free_one[rows], free_two[columns]
        sigma = np.maximum(one.features.sigma_px[rows], two.features.sigma_px[columns])
        points, good = triangulate(
            one.T_camera_world, two.T_camera_world, one.features.pixels[rows], two.features.pixels[columns],
            self.camera, max_error_px=self.limits.outlier_sigma * self.limits.pixel_sigma * sigma,
        )  # fmt: skip
        angles = parallax_deg(points, inverse(one.T_camera_world)[:3, 3], inverse(two.T_camera_world)[:3, 3])
        good &= angles >= self.limits.min_parallax_deg
        self.add_landmarks(points[good], (other, rows[good]), (number, columns[good]))

    def _observe_again(self, number: int, landmarks: Rows) -> None:
        """Let a keyframe see *landmarks* where its free features look alike at the projected pixels."""
        keyframe = self.keyframes[number]
        landmarks = landmarks[self.is_alive[landmarks] & ~np.isin(landmarks, keyframe.landmarks)]
        points = transform(keyframe.T_camera_world, self.points[landmarks])
        ahead = points[:, 2] > 1e-3
        landmarks, points = landmarks[ahead], points[ahead]
        free = np.flatnonzero(keyframe.landmarks == NO_LANDMARK)
        rows, columns = match_near(
            self.camera.project(points), self.descriptors[landmarks], keyframe.features.pixels[free],
            keyframe.features.descriptors[free], radius_px=3.0,
        )  # fmt: skip
        keyframe.landmarks[free[columns]] = landmarks[rows]

    def median_depth(self, number: int) -> float:
        """Return the median depth of the landmarks that a keyframe sees, 1 if it sees none."""
        seen = self.landmarks_of(number)
        if not len(seen):
            return 1.0
        return float(np.median(transform(self.keyframes[number].T_camera_world, self.points[seen])[:, 2]))

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
        observed = []
        for row, number in enumerate(numbers):
            features = np.flatnonzero(self.keyframes[number].landmarks != NO_LANDMARK)
            features = features[in_window[self.keyframes[number].landmarks[features]]]
            observed.append(np.column_stack((np.full(len(features), row), features)))
        table = np.concatenate(observed)
        landmarks = np.concatenate(
            [
                self.keyframes[number].landmarks[rows[:, 1]]
                for number, rows in zip(numbers, observed, strict=True)
            ]
        )
        used, of_points = np.unique(landmarks, return_inverse=True)
        features_of = [self.keyframes[number].features for number in numbers]
        pixels = np.concatenate([f.pixels[rows[:, 1]] for f, rows in zip(features_of, observed, strict=True)])
        sigma = np.concatenate(
            [f.sigma_px[rows[:, 1]] for f, rows in zip(features_of, observed, strict=True)]
        )
        sigma = sigma * self.limits.pixel_sigma
        bundle = Bundle(
            T_camera_world=np.stack([self.keyframes[number].T_camera_world for number in numbers]),
            is_fixed=is_fixed,
            points_world=self.points[used],
            cameras=table[:, 0],
            points=of_points.ravel(),
            pixels=pixels,
            sigma_px=sigma,
        )
        poses, points = adjust(bundle, self.camera, iterations=iterations)
        self.points[used] = points
        for row, number in enumerate(numbers):
            self.keyframes[number].T_camera_world = poses[row]
        errors, _ = reprojection_errors(poses[table[:, 0]], points[of_points.ravel()], pixels, self.camera)
        wrong = errors > self.limits.outlier_sigma * sigma
        for row, number in enumerate(numbers):
            own = wrong & (table[:, 0] == row)
            self.keyframes[number].landmarks[table[own, 1]] = NO_LANDMARK
        self._remove(used[self._observation_counts()[used] < 2])
