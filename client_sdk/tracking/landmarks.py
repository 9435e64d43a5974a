"""Landmarks of a map, and their matches with the features of an image."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array, Camera
from rse_pf.maps.descriptors import Descriptors
from rse_pf.slam.descriptors import match_all
from rse_pf.slam.tracking import GuidedMatchLimits, ImageFeatures, LandmarkAppearance, match_landmarks

__all__ = ["NO_LANDMARK", "Landmarks", "Matches", "match_by_appearance", "shift_landmarks"]

Rows = npt.NDArray[np.int64]

NO_LANDMARK = -1
"""Stands in arrays of landmark numbers for a feature that shows no landmark of the map."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Landmarks:
    """Points of the world with their uncertainty, and how each looked in the last image that showed it.

    The last image is a keyframe, except for landmarks that were made of a single frame.

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

    def select(self, rows: Rows | slice) -> Landmarks:
        """Return the landmarks of *rows*."""
        return _change_columns(lambda column: column[rows], self)

    def match(
        self,
        T_camera_world: Array,
        camera: Camera,
        image: ImageFeatures,
        limits: GuidedMatchLimits,
        margin_px: float,
    ) -> Matches:
        """Match the landmarks with features near the pixels at which a pose predicts them.

        Args:
            T_camera_world: ``(4, 4)``, the predicted pose of the image.
            camera: Intrinsics of the image.
            image: Features of the image.
            limits: Conditions of a match.
            margin_px: Width of the border around the image in which landmarks are predicted, too.
        """
        rows, features = match_landmarks(
            self.appearance, np.arange(len(self)), T_camera_world, camera, image, limits, margin_px
        )
        return Matches(landmarks=self.select(rows), features=features)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Matches:
    """Landmarks and the features of an image that show them.

    Attributes:
        landmarks: ``n`` landmarks.
        features: ``(n,)``, row of the feature that shows each landmark.
    """

    landmarks: Landmarks
    features: Rows

    def __len__(self) -> int:
        return len(self.features)

    def replace_by(self, other: Matches, feature_count: int, landmark_count: int) -> Matches:
        """Return *other* after those of these matches that share no feature and no landmark with it.

        Args:
            other: Matches that take precedence.
            feature_count: Number of features of the image.
            landmark_count: Number of landmarks of the map.
        """
        is_free_feature = np.ones(feature_count, bool)
        is_free_landmark = np.ones(landmark_count + 1, bool)  # the last row is that of NO_LANDMARK
        is_free_feature[other.features] = False
        is_free_landmark[other.landmarks.numbers] = False
        rows = np.flatnonzero(is_free_feature[self.features] & is_free_landmark[self.landmarks.numbers])
        return Matches(
            landmarks=_change_columns(
                lambda own, others: np.concatenate([own[rows], others]), self.landmarks, other.landmarks
            ),
            features=np.concatenate([self.features[rows], other.features]),
        )


def match_by_appearance(landmarks: Landmarks, descriptors: Descriptors, image: ImageFeatures) -> Matches:
    """Match landmarks with the features of an image by their descriptors alone, wherever they are.

    Args:
        landmarks: ``n`` landmarks.
        descriptors: ``(n, d)``, of the landmarks in the image with which the present one is compared.
        image: Features of the present image.
    """
    rows, features = match_all(descriptors, image.descriptors)
    return Matches(landmarks=landmarks.select(rows), features=features)


def shift_landmarks(numbers: Rows, first: int) -> Rows:
    """Return landmark numbers after their map was appended to another one, where they begin at *first*."""
    return np.where(numbers == NO_LANDMARK, NO_LANDMARK, numbers + first)


def _change_columns(change: Callable[..., npt.NDArray[np.generic]], *tables: Landmarks) -> Landmarks:
    """Return landmarks whose arrays are made by *change* from the same array of each of *tables*."""
    columns = {name: change(*(getattr(table, name) for table in tables)) for name in _COLUMNS}
    return Landmarks(**columns)  # type: ignore[arg-type]


_COLUMNS = tuple(column.name for column in fields(Landmarks))
