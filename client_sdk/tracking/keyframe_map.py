"""The map of one segment of a camera with depth: keyframes, and the landmarks that they measured.

A landmark is a feature with depth.  Every frame that sees it again measures it again, and the measurements
are fused by their covariances.  The pose of a keyframe is not adjusted when further frames are added: only
`KeyframeMap.move` and `KeyframeMap.correct` change it, together with those of all other keyframes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace

import numpy as np
import numpy.typing as npt

from client_sdk.stereo.depth import with_offset
from client_sdk.tracking.landmark_matching import (
    NO_LANDMARK,
    PIXEL_SIGMA_PX,
    Landmarks,
    LazyPlaceVector,
    Matches,
    shift_landmarks,
)
from client_sdk.trajectory import Trajectory
from rse_pf.geometry import Array, Camera, inverse, transform
from rse_pf.maps.descriptors import Descriptors
from rse_pf.pnp import DepthNoise
from rse_pf.slam.descriptors import match_all
from rse_pf.slam.tracking import (
    Features,
    GuidedMatchLimits,
    LandmarkAppearance,
    Observations,
    match_landmarks,
)

__all__ = ["KeyframeMap", "PosedView", "View", "depths_for_noise", "measure_points", "observe_landmarks"]

Rows = npt.NDArray[np.int64]

_LOCAL_KEYFRAMES = 6
"""Number of keyframes nearest to a pose whose landmarks are matched with an image that has this pose."""
_INITIAL_CAPACITY = 4096
"""Number of landmarks for which a new map has memory; the memory doubles when it is full."""
_DEG_PER_M = 30.0
"""Degrees of rotation that change a view as much as a metre of translation, where nearest keyframes are
sought."""
_FUSION_NOISE_M2 = 0.003**2 / 20.0
"""Square metres that each fusion adds to the variance of a landmark, (3 mm)^2 in 20 fusions, as the process
noise of a Kalman filter: the errors of its measurements are correlated, so that its variance must not fall to
0."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """One image with depth, as it is matched and kept in a map.

    Attributes:
        features: Features of the image with their points, ``n`` of them.
        shutter_displacements: ``(n, 3)``, metres per second in the camera's frame: the derivative of each
            corrected point by the readout time of the camera's rolling shutter.
        camera: Intrinsics.
        place_vector: Vector by which the place of the image is recognised.
        is_stereo: Whether depths are computed from disparities, whose noise has no constant part.
        timestamp_s: Time of the frame, in seconds.
    """

    features: Features
    shutter_displacements: Array
    camera: Camera
    place_vector: LazyPlaceVector
    is_stereo: bool = False
    timestamp_s: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PosedView:
    """An image with its verified pose.

    Attributes:
        view: The image.
        T_world_camera: ``(4, 4)``.
        landmarks: ``(n,)``, number of the landmark that each feature shows, or NO_LANDMARK; only features
            that agree with the pose have one.
        inliers: Number of features that agree with the pose; 0 for the first frame of a segment.
        matches: Number of matches for which the pose was queried, or of those by which it was verified,
            whichever is larger; 0 for the first frame of a segment.
        is_weak: Whether the verdict of the solver is ``weak``: the evidence for the pose is little.  The
            image then changes no landmark, and never becomes a keyframe.
        rotation_rate: ``(3,)`` rad/s in the camera's frame, mean rate since the camera's last pose; zeros
            after a loss, a cut, and where the place was recognised far from the last pose.
    """

    view: View
    T_world_camera: Array
    landmarks: Rows
    inliers: int
    matches: int
    is_weak: bool
    rotation_rate: Array = field(default_factory=lambda: np.zeros(3))


def depths_for_noise(measured_m: Array, expected_m: Array) -> Array:
    """Return the depths at which the noise of stereo depths is evaluated.

    They are the geometric means of the measured depths and of those that the map predicts.

    The noise grows with the depth.  At the measured depth, a point that is measured too near would get too
    small a noise, thus too much weight, and would draw the map nearer.  At the geometric mean, the error of a
    depth divided by its noise is exactly the error of its disparity divided by that of the disparity.

    Args:
        measured_m: ``(n,)`` metres.
        expected_m: ``(n,)`` metres, by the map; limited to a quarter and to four times the measured depth.
    """
    mean: Array = np.sqrt(measured_m * np.clip(expected_m, 0.25 * measured_m, 4.0 * measured_m))
    return mean


def measure_points(
    view: View, T_world_camera: Array, rows: Rows, noise: DepthNoise, expected_m: Array | None = None
) -> tuple[Array, Array]:
    """Return the points of features in the world, and their covariances by the noise of pixels and depths.

    Args:
        view: The image.
        T_world_camera: ``(4, 4)``, its pose.
        rows: ``(n,)`` rows of the features.
        noise: Noise model of the depths.
        expected_m: ``(n,)`` depths that the map predicts, for stereo pairs: the noise is evaluated between
            them and the measured depths, see `depths_for_noise`.  None: it is evaluated at the measured
            depths.

    Returns:
        ``(n, 3)`` metres in the world, and ``(n, 3, 3)`` square metres, world axes.
    """
    points, camera = view.features.points_camera[rows], view.camera
    z = points[:, 2]
    rays = points / z[:, None]
    depth_variance = noise.variance_m2(z if expected_m is None else depths_for_noise(z, expected_m))
    covariances = rays[:, :, None] * rays[:, None, :] * depth_variance[:, None, None]
    pixel_variance = (PIXEL_SIGMA_PX * view.features.sizes[rows]) ** 2
    covariances[:, 0, 0] += pixel_variance * (z / camera.fx) ** 2
    covariances[:, 1, 1] += pixel_variance * (z / camera.fy) ** 2
    rotation = T_world_camera[:3, :3]
    return transform(T_world_camera, points), rotation @ covariances @ rotation.T


def observe_landmarks(view: View, matches: Matches, T_world_camera: Array, noise: DepthNoise) -> Observations:
    """Return what an image measured of matched landmarks, with the noise of each measurement.

    The depth is 0 where there is none.

    Args:
        view: The image.
        matches: Landmarks that it shows.
        T_world_camera: ``(4, 4)``, its approximate pose; used for stereo pairs only, whose noise is evaluated
            between the measured depth and the one that this pose predicts.
        noise: Noise model of the depths.
    """
    depths_m = np.nan_to_num(view.features.points_camera[matches.features, 2], posinf=0.0, neginf=0.0)
    noise_depths_m = depths_m
    if view.is_stereo:
        expected_m = transform(inverse(T_world_camera), matches.points)[:, 2]
        noise_depths_m = depths_for_noise(depths_m, expected_m)
    return Observations(
        points=matches.points,
        covariances=matches.covariances,
        pixels=view.features.pixels[matches.features],
        pixel_sigmas_px=PIXEL_SIGMA_PX * view.features.sizes[matches.features],
        depths_m=depths_m,
        depth_sigmas_m=np.sqrt(noise.variance_m2(noise_depths_m)),
    )


class KeyframeMap:
    """Keyframes and landmarks of one segment, which have one world frame.

    When there are *max_keyframes*, the next keyframe first removes every second one of the older half.

    Attributes:
        views: Image of each keyframe, oldest first; not to be changed by others.
        seen: ``(n,)`` for each keyframe: the landmark of each of its features, or NO_LANDMARK.
        poses: ``T_world_camera`` ``(k, 4, 4)`` of the keyframes.
        last_pose: ``(4, 4)``, pose of the newest frame, which need not be a keyframe.
        last_stamp_s: Time of that frame, in seconds.
    """

    def __init__(self, max_keyframes: int) -> None:
        self._max_keyframes = max_keyframes
        self.views: list[View] = []
        self.seen: list[Rows] = []
        self.poses: Array = np.empty((0, 4, 4))
        self.last_pose: Array = np.eye(4)
        self.last_stamp_s = -math.inf
        self._place_vectors: npt.NDArray[np.float32] = np.empty((0, 0), dtype=np.float32)
        self._count = 0
        self._table = _allocate(_INITIAL_CAPACITY, np.empty((0, 0), dtype=np.uint8))
        """All landmarks, then free rows."""

    @property
    def keyframe_count(self) -> int:
        """The number of keyframes."""
        return len(self.views)

    @property
    def landmark_count(self) -> int:
        """The number of landmarks."""
        return self._count

    def add_keyframe(self, view: View, T_world_camera: Array, landmarks: Rows, noise: DepthNoise) -> Rows:
        """Add a keyframe; its features with depth and without a landmark become landmarks.

        Args:
            view: The image.
            T_world_camera: ``(4, 4)``, its pose.
            landmarks: ``(n,)``, landmark of each feature, or NO_LANDMARK.
            noise: Noise model of the depths.

        Returns:
            ``(n,)``, landmark of each feature, with the new ones.  If keyframes were removed before, all
            landmarks have new numbers, and only the returned ones are valid.
        """
        descriptors = view.features.descriptors
        if not self._count:
            self._table = _allocate(len(self._table), descriptors)
        if len(self.views) >= self._max_keyframes:
            landmarks = self._thin_out(landmarks)
        landmarks = landmarks.copy()
        known = np.flatnonzero(landmarks != NO_LANDMARK)
        new = np.flatnonzero((landmarks == NO_LANDMARK) & np.isfinite(view.features.points_camera[:, 2]))
        numbers = self._count + np.arange(len(new))
        landmarks[new] = numbers
        self._reserve(self._count + len(new))
        self._count += len(new)
        table = self._table
        table.points[numbers], table.covariances[numbers] = measure_points(view, T_world_camera, new, noise)
        table.shutter_displacements[numbers] = view.shutter_displacements[new] @ T_world_camera[:3, :3].T
        for rows in (known, new):
            self._update_appearance(landmarks[rows], view, T_world_camera, rows)
        self.views.append(view)
        self.seen.append(landmarks)
        self.poses = np.concatenate([self.poses, T_world_camera[None]])
        vector = view.place_vector.get()[None]
        self._place_vectors = (
            np.concatenate([self._place_vectors, vector]) if len(self._place_vectors) else vector
        )
        return landmarks

    def distances(self, T_world_camera: Array) -> tuple[Array, Array]:
        """Return the distances ``(k,)`` of all keyframes from a pose, in metres and in degrees."""
        metres = np.linalg.norm(self.poses[:, :3, 3] - T_world_camera[:3, 3], axis=1)
        cosines = (np.einsum("nij,ij->n", self.poses[:, :3, :3], T_world_camera[:3, :3]) - 1.0) / 2.0
        return metres, np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))

    def set_last(self, T_world_camera: Array, stamp_s: float) -> None:
        """Note the pose ``(4, 4)`` and the time of the newest frame."""
        self.last_pose, self.last_stamp_s = T_world_camera, stamp_s

    def trajectory(self) -> Trajectory:
        """Return the poses of the keyframes and of the newest frame in the order of time."""
        stamps_s = np.array([*(view.timestamp_s for view in self.views), self.last_stamp_s])
        order = np.argsort(stamps_s, kind="stable")
        return Trajectory(stamps_s[order], np.concatenate([self.poses, self.last_pose[None]])[order])

    def rank_by_similarity(self, place: LazyPlaceVector, count: int, among: Rows | None = None) -> list[int]:
        """Return the *count* keyframes whose place vectors are most similar to an image's, best first.

        Only keyframes of *among* are considered, all for None.
        """
        numbers = np.arange(len(self.views)) if among is None else among
        similarities = self._place_vectors[numbers] @ place.get()
        ranked: list[int] = numbers[np.argsort(-similarities, kind="stable")].tolist()
        return ranked[:count]

    def matched(self, numbers: Rows, features: Rows) -> Matches:
        """Pair the landmark ``numbers[i]`` with row ``features[i]`` of an image's features, for each *i*."""
        return self._table.matched(numbers, features)

    def landmarks_in(self, keyframe: int) -> tuple[Rows, Descriptors]:
        """Return the numbers of the landmarks that a keyframe sees, and their descriptors in it."""
        seen = self.seen[keyframe]
        rows = np.flatnonzero(seen != NO_LANDMARK)
        return seen[rows], self.views[keyframe].features.descriptors[rows]

    def landmarks_around(self, T_world_camera: Array) -> tuple[LandmarkAppearance, Rows]:
        """Return the appearance of all landmarks, and the ascending numbers (rows) of those around a pose.

        Around a pose are the landmarks that at least one of the six nearest keyframes, or the newest
        keyframe, sees.  The distance of a keyframe is that of its pose in metres, plus its rotation in
        degrees over 30.
        """
        metres, degrees = self.distances(T_world_camera)
        nearest = np.argsort(metres + degrees / _DEG_PER_M, kind="stable")[:_LOCAL_KEYFRAMES]
        is_seen = np.zeros(self._count + 1, dtype=bool)  # the last row is that of NO_LANDMARK
        for keyframe in (*nearest, -1):
            is_seen[self.seen[keyframe]] = True
        return self._table.first(self._count).appearance, np.flatnonzero(is_seen[:-1])

    def match(
        self,
        view: View,
        T_world_camera: Array,
        limits: GuidedMatchLimits,
        last: PosedView | None,
        noise: DepthNoise,
        enough: float = np.inf,
    ) -> Matches:
        """Match the landmarks around a pose, and those of the last frame, with an image near their pixels.

        Where a feature or a landmark has a match of both kinds, that with the last frame is taken, whose
        descriptor is the newest.  Landmarks are also predicted in a border around the image as wide as the
        radius of the limits.

        Args:
            view: The image.
            T_world_camera: ``(4, 4)``, its predicted pose.
            limits: Conditions of a match.
            last: The last frame, with its features with depth that are not landmarks of the map, too; None to
                match with the landmarks around the pose only.
            noise: Noise model of the depths, for those features of the last frame.
            enough: If the landmarks around the pose give this many matches, the last frame is left out.
        """
        # 1. Match the landmarks that the nearest keyframes see.
        T_camera_world, radius_px = inverse(T_world_camera), limits.radius_px
        appearance, numbers = self.landmarks_around(T_world_camera)
        rows, features = match_landmarks(
            appearance, numbers, T_camera_world, view.camera, view.features, limits, radius_px
        )
        if last is None or len(rows) >= enough:
            return self.matched(numbers[rows], features)
        # 2. Match the landmarks and other points that the last frame shows.
        recent = self.landmarks_of_view(last, noise).match(
            T_camera_world, view.camera, view.features, limits, radius_px
        )
        # 3. Add those of the first matches that share no feature and no landmark with the second ones.
        is_free_feature = np.ones(len(view.features), bool)
        is_free_landmark = np.ones(self._count + 1, bool)  # the last row is that of NO_LANDMARK
        is_free_feature[recent.features] = False
        is_free_landmark[recent.numbers] = False
        free = np.flatnonzero(is_free_feature[features] & is_free_landmark[numbers[rows]])
        return self.matched(numbers[rows[free]], features[free]).followed_by(recent)

    def match_last_frame(self, view: View, last: PosedView, noise: DepthNoise) -> Matches:
        """Match all landmarks and other points of the last frame with an image by their descriptors alone."""
        recent = self.landmarks_of_view(last, noise)
        return recent.matched(*match_all(recent.descriptors, view.features.descriptors))

    def landmarks_of_view(self, posed: PosedView, noise: DepthNoise) -> Landmarks:
        """Return the landmarks of an image, and its other features with depth as landmarks of no map.

        Landmarks of the map have their fused points, the others the points that this image measured, and the
        number NO_LANDMARK.  The appearance of all is that in this image.  The map is not changed.

        Args:
            posed: The image with its pose, which need not be a keyframe.
            noise: Noise model of the depths.
        """
        view, T_world_camera, landmarks = posed.view, posed.T_world_camera, posed.landmarks
        rows = np.flatnonzero((landmarks != NO_LANDMARK) | np.isfinite(view.features.points_camera[:, 2]))
        numbers = landmarks[rows]
        new = np.flatnonzero(numbers == NO_LANDMARK)
        points, covariances = self._table.points[numbers], self._table.covariances[numbers]
        displacements = self._table.shutter_displacements[numbers]
        points[new], covariances[new] = measure_points(view, T_world_camera, rows[new], noise)
        displacements[new] = view.shutter_displacements[rows[new]] @ T_world_camera[:3, :3].T
        return Landmarks(
            points=points,
            covariances=covariances,
            shutter_displacements=displacements,
            descriptors=view.features.descriptors[rows],
            rays=points - T_world_camera[:3, 3],
            orientations=_orientations_in_world(view, T_world_camera, rows),
            sizes=view.features.sizes[rows],
            numbers=numbers,
        )

    def fuse(self, view: View, T_world_camera: Array, landmarks: Rows, noise: DepthNoise) -> None:
        """Update the landmarks that an image shows with a depth by its measurements, as a Kalman filter does.

        Features without a landmark or without a depth change nothing, and no landmark is added.

        Args:
            view: The image.
            T_world_camera: ``(4, 4)``, its pose.
            landmarks: ``(n,)``, landmark of each feature, or NO_LANDMARK.
            noise: Noise model of the depths.
        """
        rows = np.flatnonzero((landmarks != NO_LANDMARK) & np.isfinite(view.features.points_camera[:, 2]))
        if not len(rows):
            return
        numbers, table = landmarks[rows], self._table
        expected_m = None
        if view.is_stereo:
            expected_m = transform(inverse(T_world_camera), table.points[numbers])[:, 2]
        points, covariances = measure_points(view, T_world_camera, rows, noise, expected_m)
        prior = table.covariances[numbers]
        gain = prior @ _invert_symmetric(prior + covariances)
        displacements = view.shutter_displacements[rows] @ T_world_camera[:3, :3].T
        for column, measured in ((table.points, points), (table.shutter_displacements, displacements)):
            column[numbers] += np.einsum("nij,nj->ni", gain, measured - column[numbers])
        table.covariances[numbers] = (np.eye(3) - gain) @ prior + _FUSION_NOISE_M2 * np.eye(3)

    def change_readout(self, change_s: float) -> None:
        """Correct all landmarks after the estimate of the readout time grew by *change_s* seconds."""
        table, count = self._table, self._count
        table.points[:count] += change_s * table.shutter_displacements[:count]

    def move(self, T_new_old: Array) -> None:
        """Express the whole map in another world frame, by the ``(4, 4)`` rigid motion *T_new_old*."""
        rotation, table = T_new_old[:3, :3], self._table.first(self._count)
        self.poses, self.last_pose = T_new_old @ self.poses, T_new_old @ self.last_pose
        table.points[:] = transform(T_new_old, table.points)
        table.covariances[:] = rotation @ table.covariances @ rotation.T
        for directions in (table.shutter_displacements, table.rays, table.orientations):
            directions[:] = directions @ rotation.T

    def correct(self, T_world_camera: Array, f_baseline: float, offset_px: float) -> None:
        """Set corrected poses of all keyframes, and add an offset to the disparities of their images.

        Each landmark moves with the newest keyframe that sees it, and along its ray in that keyframe to the
        depth that the changed disparity gives.

        Args:
            T_world_camera: ``(k, 4, 4)``, corrected poses of all keyframes.
            f_baseline: Focal length in pixels times the baseline in metres.
            offset_px: Pixels that are added to every disparity.
        """
        newest_keyframe = np.zeros(self._count, dtype=np.int64)
        for keyframe, seen in enumerate(self.seen):
            newest_keyframe[seen[seen != NO_LANDMARK]] = keyframe
        old, new = self.poses[newest_keyframe, :3], T_world_camera[newest_keyframe, :3]
        table = self._table.first(self._count)
        # 1. Express each landmark in the old frame of its keyframe, and move it along its ray by the offset.
        local = np.einsum("nji,nj->ni", old[:, :, :3], table.points - old[:, :, 3])
        moved = with_offset(local, f_baseline, offset_px)
        local = np.where(np.isfinite(moved), moved, local)
        # 2. Map the landmarks back to the world by the corrected poses.
        rotation = new[:, :, :3] @ old[:, :, :3].transpose(0, 2, 1)
        table.rays[:] = np.einsum("nij,nj->ni", new[:, :, :3], local)
        table.points[:] = table.rays + new[:, :, 3]
        table.covariances[:] = rotation @ table.covariances @ rotation.transpose(0, 2, 1)
        table.orientations[:] = np.einsum("nij,nj->ni", rotation, table.orientations)
        table.shutter_displacements[:] = np.einsum("nij,nj->ni", rotation, table.shutter_displacements)
        self.poses = T_world_camera.copy()
        # 3. Add the offset to the disparities of the points that the keyframes measured.
        points_cameras = [
            with_offset(view.features.points_camera, f_baseline, offset_px) for view in self.views
        ]
        self.views = [
            replace(view, features=replace(view.features, points_camera=points_camera))
            for view, points_camera in zip(self.views, points_cameras, strict=True)
        ]

    def append(self, other: KeyframeMap) -> int:
        """Add all of another map in the same world frame, after the own keyframes and landmarks.

        Returned is the number that the other map's first landmark has here.
        """
        first = self._count
        self.views += other.views
        self.seen += [shift_landmarks(seen, first) for seen in other.seen]
        self.poses = np.concatenate([self.poses, other.poses])
        if other.last_stamp_s > self.last_stamp_s:
            self.set_last(other.last_pose, other.last_stamp_s)
        self._place_vectors = np.concatenate([self._place_vectors, other._place_vectors])
        self._reserve(first + other._count)
        self._count += other._count
        for own, others in zip(_columns(self._table), _columns(other._table), strict=True):
            own[first : self._count] = others[: other._count]
        return first

    def _update_appearance(self, numbers: Rows, view: View, T_world_camera: Array, rows: Rows) -> None:
        """Set descriptor, ray, orientation and size of landmarks to those in an image.

        *rows* are the image's features that show the landmarks *numbers*.
        """
        table = self._table
        table.descriptors[numbers] = view.features.descriptors[rows]
        table.rays[numbers] = table.points[numbers] - T_world_camera[:3, 3]
        table.orientations[numbers] = _orientations_in_world(view, T_world_camera, rows)
        table.sizes[numbers] = view.features.sizes[rows]

    def _reserve(self, count: int) -> None:
        """Provide memory for *count* landmarks in total; if it must grow, it is at least doubled."""
        if count <= len(self._table):
            return
        larger = _allocate(max(count, 2 * len(self._table)), self._table.descriptors)
        for new, old in zip(_columns(larger), _columns(self._table), strict=True):
            new[: self._count] = old[: self._count]
        self._table = larger

    def _thin_out(self, current: Rows) -> Rows:
        """Remove every second keyframe of the older half, and landmarks that no keyframe sees any more.

        The first keyframe is among those removed.  Landmarks are renumbered.  *current*, landmark numbers (or
        NO_LANDMARK) that must stay, is returned with the new numbers.
        """
        is_kept = np.ones(len(self.views), dtype=bool)
        is_kept[: len(self.views) // 2 : 2] = False
        kept = np.flatnonzero(is_kept)
        self.views = [self.views[keyframe] for keyframe in kept]
        self.seen = [self.seen[keyframe] for keyframe in kept]
        self.poses, self._place_vectors = self.poses[kept], self._place_vectors[kept]
        rows = np.unique(np.concatenate([*self.seen, current]))
        rows = rows[rows != NO_LANDMARK]
        new_numbers = np.full(self._count + 1, NO_LANDMARK)  # the last row is that of NO_LANDMARK
        new_numbers[rows] = np.arange(len(rows))
        for column in _columns(self._table):
            column[: len(rows)] = column[rows]
        self._count = len(rows)
        self.seen = [new_numbers[seen] for seen in self.seen]
        return new_numbers[current]


def _allocate(capacity: int, descriptors: Descriptors) -> Landmarks:
    """Return memory for landmarks with descriptors of the kind of *descriptors*; only the numbers are set."""
    return Landmarks(
        points=np.empty((capacity, 3)),
        covariances=np.empty((capacity, 3, 3)),
        shutter_displacements=np.empty((capacity, 3)),
        descriptors=np.empty((capacity, descriptors.shape[1]), dtype=descriptors.dtype),
        rays=np.empty((capacity, 3)),
        orientations=np.empty((capacity, 3)),
        sizes=np.empty(capacity),
        numbers=np.arange(capacity),
    )


def _columns(table: Landmarks) -> list[npt.NDArray[np.generic]]:
    """Return the arrays of a table of landmarks, but for the numbers, which are those of its rows."""
    return [getattr(table, column.name) for column in fields(table) if column.name != "numbers"]


def _invert_symmetric(matrices: Array) -> Array:
    """Invert ``(n, 3, 3)`` symmetric matrices by their cofactors, which is faster than LAPACK."""
    a, b, c, d, e, f = matrices.reshape(-1, 9).T[[0, 1, 2, 4, 5, 8]]
    ab, ac, bc = c * e - b * f, b * e - c * d, b * c - a * e
    cofactors = np.stack([d * f - e * e, ab, ac, ab, a * f - c * c, bc, ac, bc, a * d - b * b], axis=1)
    cofactors /= (a * cofactors[:, 0] + b * ab + c * ac)[:, None]
    inverses: Array = cofactors.reshape(-1, 3, 3)
    return inverses


def _orientations_in_world(view: View, T_world_camera: Array, rows: Rows) -> Array:
    directions: Array = view.features.orientations[rows] @ T_world_camera[:3, :2].T
    return directions
