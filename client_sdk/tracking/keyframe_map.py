"""The map that a tracker matches frames against: keyframes, and the landmarks that they measured.

A landmark is a feature with depth.  Each frame that sees it again measures it again, and the measurements are
fused by their noise.  Nothing is matched here, and no keyframe is ever moved but with its whole map.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from client_sdk.stereo.depth import with_offset
from client_sdk.tracking.place import Place
from rse_pf.geometry import Array, Camera, inverse, transform
from rse_pf.maps.descriptors import Descriptors
from rse_pf.pnp import DepthNoise
from rse_pf.slam.tracking import ImageFeatures, LandmarkLooks, NearLimits, seek_near

__all__ = [
    "NO_LANDMARK",
    "KeyframeMap",
    "Landmarks",
    "View",
    "between",
    "measure_points",
]

Rows = npt.NDArray[np.int64]

NO_LANDMARK = -1
_FIRST_ROOM = 4096
_DEG_PER_M = 30.0
"""A view that is turned by so many degrees shows as little of another one as a view a metre away."""
_FUSED_FLOOR_M2 = 0.003**2 / 20.0
"""Added to the variance of a landmark with each measurement: their errors are not independent."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """One image: its features, and their ``(n, 3)`` points in the camera's frame, NaN without depth.

    ``sways`` ``(n, 3)`` is how far the points move for each second that the camera's readout takes longer.
    ``is_stereo`` says that the depths are those of disparities, whose noise has no floor.  ``timestamp_s`` is
    that of the frame.
    """

    features: ImageFeatures
    points_camera: Array
    sways: Array
    camera: Camera
    place: Place
    is_stereo: bool = False
    timestamp_s: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Landmarks:
    """Points of the world that are sought in an image.

    ``points`` ``(n, 3)``; ``spreads`` ``(n, 3, 3)`` their covariances; ``rays`` ``(n, 3)`` from where they
    were seen last; ``turns`` ``(n, 3)`` their orientation there, in the world; ``sizes`` ``(n,)``;
    ``numbers`` ``(n,)`` of the map, NO_LANDMARK for points that only the last image has; ``sways`` ``(n, 3)``
    how far they move for each second that the camera's readout takes longer, empty without depth.
    """

    points: Array
    spreads: Array
    descriptors: Descriptors
    rays: Array
    turns: Array
    sizes: Array
    numbers: Rows
    sways: Array = field(default_factory=lambda: np.empty((0, 3)))

    @property
    def looks(self) -> LandmarkLooks:
        """How they looked."""
        return LandmarkLooks(
            points=self.points, rays=self.rays, turns=self.turns, sizes=self.sizes,
            descriptors=self.descriptors,
        )  # fmt: skip

    def seek(
        self, T_camera_world: Array, camera: Camera, image: ImageFeatures, limits: NearLimits,
        margin_px: float,
    ) -> tuple[Rows, Rows]:  # fmt: skip
        """Return their rows, and those of an image's features, that match where a pose expects them."""
        every = np.arange(len(self.points))
        return seek_near(self.looks, every, T_camera_world, camera, image, limits, margin_px)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Keyframe:
    """``landmarks`` ``(n,)`` holds the landmark of each feature; ``own`` those that there are, sorted."""

    view: View
    landmarks: Rows
    own: Rows


def between(measured_m: Array, expected_m: Array) -> Array:
    """Return the depths at which the noise of measured depths is taken where others are expected.

    What is measured too near would seem the better measurement, and draw the map nearer.  At the geometric
    mean, the deviation of a depth is exactly that of its disparity.
    """
    mean: Array = np.sqrt(measured_m * np.clip(expected_m, 0.25 * measured_m, 4.0 * measured_m))
    return mean


def measure_points(
    view: View, T_world_camera: Array, rows: Rows, noise: DepthNoise, pixel_px: float,
    expected_m: Array | None = None,
) -> tuple[Array, Array]:  # fmt: skip
    """Return ``(n, 3)`` points in the world, and their ``(n, 3, 3)`` covariances by the noise.

    *expected_m* are ``(n,)`` depths where the points are known already.
    """
    points, camera = view.points_camera[rows], view.camera
    z = points[:, 2]
    along = points / z[:, None]
    variance = noise.variance_m2(z if expected_m is None else between(z, expected_m))
    spread = along[:, :, None] * along[:, None, :] * variance[:, None, None]
    pixel2 = (pixel_px * view.features.sizes[rows]) ** 2
    spread[:, 0, 0] += pixel2 * (z / camera.fx) ** 2
    spread[:, 1, 1] += pixel2 * (z / camera.fy) ** 2
    rotation = T_world_camera[:3, :3]
    return transform(T_world_camera, points), rotation @ spread @ rotation.T


class KeyframeMap:
    """Keyframes and landmarks of one odometry frame; at most *max_keyframes*, then older ones are thinned."""

    def __init__(self, max_keyframes: int) -> None:
        self._max_keyframes = max_keyframes
        self._keyframes: list[_Keyframe] = []
        self._poses: Array = np.empty((0, 4, 4))
        self._places: npt.NDArray[np.float32] = np.empty((0, 0), dtype=np.float32)
        self._count = 0
        self._points: Array = np.empty((_FIRST_ROOM, 3))
        self._spreads: Array = np.empty((_FIRST_ROOM, 3, 3))
        self._sways: Array = np.empty((_FIRST_ROOM, 3))
        self._descriptors: Descriptors = np.empty((_FIRST_ROOM, 0), dtype=np.uint8)
        self._rays: Array = np.empty((_FIRST_ROOM, 3))
        self._turns: Array = np.empty((_FIRST_ROOM, 3))
        self._sizes: Array = np.empty(_FIRST_ROOM)

    def __len__(self) -> int:
        return len(self._keyframes)

    @property
    def landmark_count(self) -> int:
        """The number of landmarks."""
        return self._count

    def pose(self, keyframe: int) -> Array:
        """Return ``T_world_camera`` of a keyframe."""
        pose: Array = self._poses[keyframe]
        return pose

    def view(self, keyframe: int) -> View:
        """Return the image of a keyframe."""
        return self._keyframes[keyframe].view

    def seen_in(self, keyframe: int) -> Rows:
        """Return the landmark of each feature of a keyframe, or NO_LANDMARK."""
        return self._keyframes[keyframe].landmarks

    def add_keyframe(
        self, view: View, T_world_camera: Array, landmarks: Rows, noise: DepthNoise, pixel_px: float
    ) -> Rows:
        """Add a keyframe; its features with depth and without a landmark become landmarks.

        Args:
            view: The image.
            T_world_camera: ``(4, 4)``.
            landmarks: ``(n,)``, of each feature, or NO_LANDMARK.
            noise: Of the depths.
            pixel_px: Deviation of a pixel on the finest level.

        Returns:
            ``(n,)``, the landmark of each feature.
        """
        descriptors = view.features.descriptors
        if not self._count:
            self._descriptors = np.empty((len(self._points), descriptors.shape[1]), dtype=descriptors.dtype)
        if len(self._keyframes) >= self._max_keyframes:
            landmarks = self._thin(landmarks)
        landmarks = landmarks.copy()
        seen = np.flatnonzero(landmarks != NO_LANDMARK)
        new = np.flatnonzero((landmarks == NO_LANDMARK) & np.isfinite(view.points_camera[:, 2]))
        numbers = self._count + np.arange(len(new))
        landmarks[new] = numbers
        self._make_room(self._count + len(new))
        self._count += len(new)
        points, spreads = measure_points(view, T_world_camera, new, noise, pixel_px)
        self._points[numbers], self._spreads[numbers] = points, spreads
        self._sways[numbers] = view.sways[new] @ T_world_camera[:3, :3].T
        for rows in (seen, new):
            self._note_look(landmarks[rows], view, T_world_camera, rows)
        keyframe = _Keyframe(view=view, landmarks=landmarks, own=np.sort(landmarks[landmarks != NO_LANDMARK]))
        self._keyframes.append(keyframe)
        self._poses = np.concatenate([self._poses, T_world_camera[None]])
        place = view.place.vector()[None]
        self._places = np.concatenate([self._places, place]) if len(self._places) else place
        return landmarks

    def distances(self, T_world_camera: Array) -> tuple[Array, Array]:
        """Return how far ``(k,)`` keyframes are from a pose: metres, and degrees."""
        metres = np.linalg.norm(self._poses[:, :3, 3] - T_world_camera[:3, 3], axis=1)
        cosines = (np.einsum("nij,ij->n", self._poses[:, :3, :3], T_world_camera[:3, :3]) - 1.0) / 2.0
        return metres, np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))

    def nearest(self, T_world_camera: Array, count: int) -> list[int]:
        """Return the *count* keyframes whose views a pose shares most, and the newest one."""
        metres, degrees = self.distances(T_world_camera)
        chosen: list[int] = np.argsort(metres + degrees / _DEG_PER_M, kind="stable")[:count].tolist()
        newest = len(self._keyframes) - 1
        return chosen if newest in chosen else [*chosen, newest]

    def most_alike(self, place: Place, count: int) -> list[int]:
        """Return the *count* keyframes that look most like an image, best first."""
        alike: list[int] = np.argsort(-(self._places @ place.vector()), kind="stable").tolist()
        return alike[:count]

    def landmarks(self, numbers: Rows) -> Landmarks:
        """Return landmarks by their numbers."""
        return Landmarks(
            points=self._points[numbers], spreads=self._spreads[numbers], sways=self._sways[numbers],
            descriptors=self._descriptors[numbers], rays=self._rays[numbers], turns=self._turns[numbers],
            sizes=self._sizes[numbers], numbers=numbers,
        )  # fmt: skip

    def landmarks_of(self, keyframes: list[int]) -> Landmarks:
        """Return the landmarks that any of the keyframes sees."""
        return self.landmarks(self._seen_by(keyframes))

    def seek(
        self, keyframes: list[int], T_camera_world: Array, view: View, limits: NearLimits, margin_px: float
    ) -> tuple[Rows, Rows]:
        """Match the landmarks that any of the keyframes sees with an image where a pose expects them.

        Returns:
            The landmarks, and the rows of the image's features.
        """
        numbers, count = self._seen_by(keyframes), self._count
        looks = LandmarkLooks(
            points=self._points[:count], rays=self._rays[:count], turns=self._turns[:count],
            sizes=self._sizes[:count], descriptors=self._descriptors[:count],
        )  # fmt: skip
        rows, features = seek_near(
            looks, numbers, T_camera_world, view.camera, view.features, limits, margin_px
        )
        return numbers[rows], features

    def landmarks_in(self, keyframe: int) -> tuple[Landmarks, Descriptors]:
        """Return the landmarks of one keyframe, with the descriptors that this keyframe has of them."""
        record = self._keyframes[keyframe]
        rows = np.flatnonzero(record.landmarks != NO_LANDMARK)
        return self.landmarks(record.landmarks[rows]), record.view.features.descriptors[rows]

    def landmarks_of_view(
        self, view: View, T_world_camera: Array, landmarks: Rows, noise: DepthNoise, pixel_px: float
    ) -> Landmarks:
        """Return the landmarks of an image, and points of its own where it has depth and no landmark."""
        rows = np.flatnonzero((landmarks != NO_LANDMARK) | np.isfinite(view.points_camera[:, 2]))
        numbers = landmarks[rows]
        points, spreads, sways = self._points[numbers], self._spreads[numbers], self._sways[numbers]
        new = np.flatnonzero(numbers == NO_LANDMARK)
        points[new], spreads[new] = measure_points(view, T_world_camera, rows[new], noise, pixel_px)
        sways[new] = view.sways[rows[new]] @ T_world_camera[:3, :3].T
        return Landmarks(
            points=points, spreads=spreads, sways=sways, descriptors=view.features.descriptors[rows],
            rays=points - T_world_camera[:3, 3], turns=_turns_in_world(view, T_world_camera, rows),
            sizes=view.features.sizes[rows], numbers=numbers,
        )  # fmt: skip

    def fuse(
        self, view: View, T_world_camera: Array, landmarks: Rows, noise: DepthNoise, pixel_px: float
    ) -> None:
        """Take what an image measured of ``(n,)`` landmarks of its features into the map."""
        rows = np.flatnonzero((landmarks != NO_LANDMARK) & np.isfinite(view.points_camera[:, 2]))
        if not len(rows):
            return
        numbers = landmarks[rows]
        known = transform(inverse(T_world_camera), self._points[numbers])[:, 2] if view.is_stereo else None
        points, spreads = measure_points(view, T_world_camera, rows, noise, pixel_px, known)
        before = self._spreads[numbers]
        gain = before @ _inverse_symmetric(before + spreads)
        sways = view.sways[rows] @ T_world_camera[:3, :3].T
        self._points[numbers] += np.einsum("nij,nj->ni", gain, points - self._points[numbers])
        self._sways[numbers] += np.einsum("nij,nj->ni", gain, sways - self._sways[numbers])
        self._spreads[numbers] = (np.eye(3) - gain) @ before + _FUSED_FLOOR_M2 * np.eye(3)

    def lengthen_readout(self, more_s: float) -> None:
        """Move all landmarks to where they are if the camera reads an image for so many seconds longer."""
        self._points[: self._count] += more_s * self._sways[: self._count]

    def move(self, T_new_old: Array) -> None:
        """Express the whole map in another frame."""
        rotation, count = T_new_old[:3, :3], self._count
        self._poses = T_new_old @ self._poses
        self._points[:count] = transform(T_new_old, self._points[:count])
        self._spreads[:count] = rotation @ self._spreads[:count] @ rotation.T
        self._sways[:count] = self._sways[:count] @ rotation.T
        self._rays[:count] = self._rays[:count] @ rotation.T
        self._turns[:count] = self._turns[:count] @ rotation.T

    def correct(self, T_world_camera: Array, f_baseline: float, offset_px: float) -> None:
        """Take corrected poses, and disparities that are *offset_px* larger.

        Each landmark follows the last keyframe that sees it.

        Args:
            T_world_camera: ``(k, 4, 4)``, of all keyframes.
            f_baseline: Focal length in pixels times the baseline in metres.
            offset_px: Pixels.
        """
        of = np.zeros(self._count, dtype=np.int64)
        for number, record in enumerate(self._keyframes):
            of[record.own] = number
        count, before, after = self._count, self._poses[of, :3], T_world_camera[of, :3]
        seen = np.einsum("nji,nj->ni", before[:, :, :3], self._points[:count] - before[:, :, 3])
        moved = with_offset(seen, f_baseline, offset_px)
        seen = np.where(np.isfinite(moved), moved, seen)
        rotation = after[:, :, :3] @ before[:, :, :3].transpose(0, 2, 1)
        self._rays[:count] = np.einsum("nij,nj->ni", after[:, :, :3], seen)
        self._points[:count] = self._rays[:count] + after[:, :, 3]
        self._spreads[:count] = rotation @ self._spreads[:count] @ rotation.transpose(0, 2, 1)
        self._turns[:count] = np.einsum("nij,nj->ni", rotation, self._turns[:count])
        self._sways[:count] = np.einsum("nij,nj->ni", rotation, self._sways[:count])
        self._poses = T_world_camera.copy()
        self._keyframes = [
            replace(record, view=replace(
                record.view, points_camera=with_offset(record.view.points_camera, f_baseline, offset_px)
            ))
            for record in self._keyframes
        ]  # fmt: skip

    def take(self, other: KeyframeMap) -> int:
        """Add all of another map in the same frame; return the number that its first landmark has here."""
        first = self._count
        for number, record in enumerate(other._keyframes):
            landmarks = np.where(record.landmarks == NO_LANDMARK, NO_LANDMARK, record.landmarks + first)
            self._keyframes.append(_Keyframe(view=record.view, landmarks=landmarks, own=record.own + first))
            self._poses = np.concatenate([self._poses, other._poses[number][None]])
        self._places = np.concatenate([self._places, other._places])
        self._make_room(first + other._count)
        self._count += other._count
        for mine, theirs in zip(self._arrays(), other._arrays(), strict=True):
            mine[first : self._count] = theirs[: other._count]
        return first

    def _seen_by(self, keyframes: list[int]) -> Rows:
        """Return the landmarks that any of the keyframes sees, ascending."""
        is_seen = np.zeros(self._count, dtype=bool)
        for number in keyframes:
            is_seen[self._keyframes[number].own] = True
        return np.flatnonzero(is_seen)

    def _note_look(self, numbers: Rows, view: View, T_world_camera: Array, rows: Rows) -> None:
        """Take how landmarks look in the newest keyframe that sees them."""
        self._descriptors[numbers] = view.features.descriptors[rows]
        self._rays[numbers] = self._points[numbers] - T_world_camera[:3, 3]
        self._turns[numbers] = _turns_in_world(view, T_world_camera, rows)
        self._sizes[numbers] = view.features.sizes[rows]

    def _arrays(self) -> tuple[npt.NDArray[np.generic], ...]:
        return (
            self._points, self._spreads, self._sways, self._descriptors, self._rays, self._turns, self._sizes
        )  # fmt: skip

    def _make_room(self, count: int) -> None:
        if count <= len(self._points):
            return
        room = max(count, 2 * len(self._points))

        def grown(array: npt.NDArray[np.generic]) -> npt.NDArray[np.generic]:
            larger = np.empty((room, *array.shape[1:]), dtype=array.dtype)
            larger[: self._count] = array[: self._count]
            return larger

        arrays = [grown(array) for array in self._arrays()]
        self._points, self._spreads, self._sways = arrays[0], arrays[1], arrays[2]  # type: ignore[assignment]
        self._descriptors, self._rays = arrays[3], arrays[4]  # type: ignore[assignment]
        self._turns, self._sizes = arrays[5], arrays[6]  # type: ignore[assignment]

    def _thin(self, current: Rows) -> Rows:
        """Drop every second keyframe of the older half, and landmarks that none sees; renumber *current*."""
        half = len(self._keyframes) // 2
        stays = np.ones(len(self._keyframes), dtype=bool)
        stays[:half:2] = False
        keyframes = [record for record, is_kept in zip(self._keyframes, stays, strict=True) if is_kept]
        is_seen = np.zeros(self._count + 1, dtype=bool)
        for record in keyframes:
            is_seen[record.own] = True
        is_seen[current] = True
        is_seen[self._count] = False  # where NO_LANDMARK points to
        numbers = np.full(self._count + 1, NO_LANDMARK)
        numbers[np.flatnonzero(is_seen)] = np.arange(int(is_seen.sum()))
        rows = np.flatnonzero(is_seen)
        for array in self._arrays():
            array[: len(rows)] = array[rows]
        self._count = len(rows)
        self._keyframes = [
            _Keyframe(view=record.view, landmarks=numbers[record.landmarks], own=np.sort(numbers[record.own]))
            for record in keyframes
        ]
        self._poses, self._places = self._poses[stays], self._places[stays]
        return numbers[current]


def _inverse_symmetric(matrices: Array) -> Array:
    """Return the inverses of ``(n, 3, 3)`` symmetric matrices by their cofactors: LAPACK takes longer."""
    a, b, c, d, e, f = matrices.reshape(-1, 9).T[[0, 1, 2, 4, 5, 8]]
    ab, ac, bc = c * e - b * f, b * e - c * d, b * c - a * e
    inverses = np.stack([d * f - e * e, ab, ac, ab, a * f - c * c, bc, ac, bc, a * d - b * b], axis=1)
    inverses /= (a * inverses[:, 0] + b * ab + c * ac)[:, None]
    found: Array = inverses.reshape(-1, 3, 3)
    return found


def _turns_in_world(view: View, T_world_camera: Array, rows: Rows) -> Array:
    turned: Array = view.features.turns[rows] @ T_world_camera[:3, :2].T
    return turned
