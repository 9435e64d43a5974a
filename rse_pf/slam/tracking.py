"""Guided matching of landmarks with the features of an image, and the pose that fits matched landmarks.

The native core (``rse_pf_track.h``) does both.  Descriptors of other kinds than ORB, which a user's feature
extractor computes, are matched by numpy.  The trackers of `client_sdk.tracking` decide which landmarks are
matched and which poses are accepted.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest
from rse_pf.geometry import Array, Camera, transform
from rse_pf.maps.descriptors import ORB, DescriptorKind, Descriptors
from rse_pf.native import PART_ABIS, Workspace, address_of, aligned, core_function
from rse_pf.slam.descriptors import distance_bound, distances_of_pairs

__all__ = [
    "Features",
    "FittedPose",
    "GuidedMatchLimits",
    "LandmarkAppearance",
    "Observations",
    "PredictedFeatures",
    "fit_pose",
    "fit_readout_change",
    "match_landmarks",
    "match_predictions",
    "predict_features",
]

Rows = npt.NDArray[np.int64]

_ABI = PART_ABIS["track"]
_GRID_WORDS = 16_400
"""Words of 8 bytes of the workspace that the native core's guided matcher uses for its grid of image cells,
whatever the size of the image."""
_MAX_ORB_DISTANCE = 256
"""Largest possible Hamming distance of two ORB descriptors, in bits: the native core is given no larger
limit."""
_DESCRIPTOR_DTYPES = (np.uint8, np.int8)
_BAND_KEY_STEP = 1e6
"""Step between the sort keys of two horizontal bands of an image, in pixels: columns are clipped to less than
half of it on either side, so that the keys of two bands never overlap."""
_MAX_PIXEL_PX = 1e9
"""Features and predictions whose pixel coordinates exceed this absolute value match nothing."""
_MIN_LANDMARK_DEPTH_M = 0.1
"""Smallest depth of a landmark that is predicted in an image: of a nearer landmark, a small error of the pose
moves the pixel far, so that it is not matched."""
_MIN_VIEW_COSINE = 0.6
"""Smallest cosine between the present and the last viewing ray of a landmark that is predicted (53 degrees):
seen from another direction, a landmark has another descriptor."""
_MAX_APPROACH_RATIO = 2.0
"""A landmark is not predicted where its distance from the camera is less than that from the camera of the
last image that showed it, divided by this ratio: its descriptor then shows another scale."""
_MAX_RETREAT_RATIO = 2.0
"""A landmark is not predicted where its distance from the camera is more than that from the camera of the
last image that showed it, times this ratio: its descriptor then shows another scale."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Features:
    """Features of one image with their 3-D points, by ORB or by a user's feature extractor.

    Attributes:
        pixels: ``(n, 2)``, undistorted, column and row.
        descriptors: ``(n, d)`` of one *kind*.
        points_camera: ``(n, 3)`` metres in the camera's frame, NaN where the depth is missing, unreliable, or
            not measured by this kind of camera.
        orientations: ``(n, 2)``, cosine and sine of each feature's angle in the image; meaningless unless
            *is_oriented*.
        sizes: ``(n,)``, scale of each feature, 1 for the finest pyramid level; meaningless unless
            *is_scaled*.
        distinctiveness: ``(n,)``, distance of each descriptor to the most similar other one of the same
            image, see `rse_pf.slam.descriptors.measure_distinctiveness`.
        kind: Name, type and length of the descriptors.
        is_oriented: Whether the feature extractor measures orientations.
        is_scaled: Whether the feature extractor measures sizes.
    """

    pixels: Array
    descriptors: Descriptors
    points_camera: Array
    orientations: Array
    sizes: Array
    distinctiveness: npt.NDArray[np.int32]
    kind: DescriptorKind = ORB
    is_oriented: bool = True
    is_scaled: bool = True

    def __len__(self) -> int:
        return len(self.pixels)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PredictedFeatures:
    """Features as a pose predicts them in an image.

    Attributes:
        pixels: ``(m, 2)``, column and row.
        descriptors: ``(m, d)``.
        orientations: ``(m, 2)``, cosine and sine of the predicted angle in the image.
        sizes: ``(m,)``, predicted scale, 1 for the finest pyramid level.
    """

    pixels: Array
    descriptors: Descriptors
    orientations: Array
    sizes: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LandmarkAppearance:
    """Landmarks, and how each of them looked in the last image that showed it.

    Attributes:
        points: ``(n, 3)`` positions in the world, in metres or in the map's unit.
        rays: ``(n, 3)``, from the centre of the camera of that last image to the landmark, in the axes and
            the unit of the world; not normalised, so that their length is the distance.
        orientations: ``(n, 3)``, the feature's orientation in that image as a direction in the world.
        sizes: ``(n,)``, the feature's scale in that image, 1 for the finest pyramid level.
        descriptors: ``(n, d)``.
    """

    points: Array
    rays: Array
    orientations: Array
    sizes: Array
    descriptors: Descriptors


@dataclass(frozen=True, slots=True, kw_only=True)
class GuidedMatchLimits:
    """Conditions under which a feature of an image matches a predicted feature.

    Attributes:
        radius_px: Largest distance between the feature and the predicted pixel.
        lowe_ratio: Lowe's ratio test: the best descriptor distance must be below this share of the second
            best within the radius.
        distinctiveness_ratio: The best descriptor distance must be below this share of the distance between
            the feature's descriptor and the most similar other one of its image (`Features.distinctiveness`):
            tiles and carpets repeat beyond the radius, where Lowe's ratio test does not look.
        min_orientation_cosine: Smallest cosine of the angle between the predicted and the measured
            orientation; not used for features without orientations.
        max_size_ratio: Largest ratio of the predicted and the measured size, either way; not used for
            features without sizes.
        max_distance: Largest Hamming distance of two descriptors of 256 bits, in bits; for binary descriptors
            of another length it is multiplied by their length over 256, for vectors it is not used.
    """

    radius_px: float
    lowe_ratio: float = 0.8
    distinctiveness_ratio: float = 0.8
    min_orientation_cosine: float = 0.9
    max_size_ratio: float = 1.35
    max_distance: int = 60


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Observations:
    """Landmarks, and the measurements that one image has of them.

    Attributes:
        points: ``(n, 3)`` metres, world.
        covariances: ``(n, 3, 3)`` of the points, square metres, world axes.
        pixels: ``(n, 2)``, measured.
        pixel_sigmas_px: ``(n,)``, standard deviations of the pixels.
        depths_m: ``(n,)``, measured along the optical axis, 0 where there is no depth.
        depth_sigmas_m: ``(n,)``, standard deviations of the depths; not read where there is no depth.
    """

    points: Array
    covariances: Array
    pixels: Array
    pixel_sigmas_px: Array
    depths_m: Array
    depth_sigmas_m: Array

    def select(self, rows: Rows) -> Observations:
        """Return new observations that have only the *rows* ``(k,)`` of these, in their order."""
        return Observations(
            points=self.points[rows],
            covariances=self.covariances[rows],
            pixels=self.pixels[rows],
            pixel_sigmas_px=self.pixel_sigmas_px[rows],
            depths_m=self.depths_m[rows],
            depth_sigmas_m=self.depth_sigmas_m[rows],
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FittedPose:
    """A pose that was fitted to observations.

    Attributes:
        T_camera_world: ``(4, 4)``, metres.
        information: ``(6, 6)``, inverse covariance of the pose's twist (metres, radians), applied on the left
            of ``T_camera_world``.
        is_inlier: ``(n,)``, whether each landmark lies more than 5 cm before the camera, and the squared
            distance of its observation from the prediction, in variances, is below *gate2* of `fit_pose`.
    """

    T_camera_world: Array
    information: Array
    is_inlier: npt.NDArray[np.bool_]


_P, _I, _D = ctypes.c_void_p, ctypes.c_int64, ctypes.c_double
_WORKSPACE = Workspace()


class _NearRequest(ctypes.Structure):
    """Request to match predicted features with those of an image, ``rse_pf_near_request`` of the C header."""

    _fields_ = (
        ("abi", ctypes.c_uint32),
        ("flags", ctypes.c_uint32),
        ("predicted_rows", _I),
        ("rows", _I),
        ("predicted_pixels", _P),
        ("predicted_directions", _P),
        ("predicted_sizes", _P),
        ("predicted_descriptors", _P),
        ("pixels", _P),
        ("directions", _P),
        ("sizes", _P),
        ("descriptors", _P),
        ("distinct", _P),
        ("radius_px", _D),
        ("ratio", _D),
        ("distinct_ratio", _D),
        ("min_cosine", _D),
        ("max_size_ratio", _D),
        ("max_distance", _I),
    )


class _SeekRequest(ctypes.Structure):
    """Request to predict the features of landmarks, ``rse_pf_seek_request`` of the C header."""

    _fields_ = (
        ("abi", ctypes.c_uint32),
        ("flags", ctypes.c_uint32),
        ("rows", _I),
        ("landmarks", _I),
        ("numbers", _P),
        ("points", _P),
        ("rays", _P),
        ("directions", _P),
        ("sizes", _P),
        ("descriptors", _P),
        ("fx", _D),
        ("fy", _D),
        ("cx", _D),
        ("cy", _D),
        ("width", _D),
        ("height", _D),
        ("margin_px", _D),
        ("min_depth_m", _D),
        ("min_cosine", _D),
        ("max_nearer", _D),
        ("max_farther", _D),
        ("T_camera_world", _D * 16),
    )


class _FitRequest(ctypes.Structure):
    """Request to fit a pose to observations, ``rse_pf_fit_request`` of the C header."""

    _fields_ = (
        ("abi", ctypes.c_uint32),
        ("flags", ctypes.c_uint32),
        ("rows", _I),
        ("points", _P),
        ("point_covariances", _P),
        ("pixels", _P),
        ("pixel_sigmas_px", _P),
        ("depths_m", _P),
        ("depth_sigmas_m", _P),
        ("fx", _D),
        ("fy", _D),
        ("cx", _D),
        ("cy", _D),
        ("cauchy2", _D),
        ("gate2", _D),
        ("T_camera_world", _D * 16),
    )


class _FitResult(ctypes.Structure):
    """Fitted pose, the C struct ``rse_pf_fit_result`` of ``rse_pf_track.h``."""

    _fields_ = (("inliers", _I), ("T_camera_world", _D * 16), ("information", _D * 36))


_CORE_SIGNATURES = {
    "match_near": ((_P,) * 4, _I),
    "seek": ((_P,) * 5, _I),
    "fit_pose": ((_P,) * 3, ctypes.c_int32),
    "fit_sway": ((_P,) * 4, ctypes.c_int32),
}


@cache
def _core(name: str) -> Any:
    return core_function("track", f"rse_pf_{name}", *_CORE_SIGNATURES[name])


def predict_features(
    landmarks: LandmarkAppearance, candidates: Rows, T_camera_world: Array, camera: Camera, margin_px: float
) -> tuple[Rows, PredictedFeatures]:
    """Predict how a camera at a pose sees landmarks.

    A landmark is predicted if it lies more than 0.1 m before the camera, within the image and its margin, and
    is seen from a similar direction and distance as in the last image that showed it.

    Args:
        landmarks: All landmarks.
        candidates: ``(m,)`` rows of *landmarks* that are considered.
        T_camera_world: ``(4, 4)``.
        camera: Its intrinsics.
        margin_px: Width of the border outside the image in which landmarks are predicted, too; negative to
            leave out a border of this width inside the image.

    Returns:
        ``(k,)`` ascending indices *i*: landmark ``candidates[i]`` is predicted; and the *k* predicted
        features.
    """
    # 1. Project the landmarks, and keep those more than 0.1 m before the camera and in the image with its
    #    margin.
    points = transform(T_camera_world, landmarks.points[candidates])
    rows = np.flatnonzero(points[:, 2] > _MIN_LANDMARK_DEPTH_M)
    pixels = camera.project(points[rows])
    u, v = pixels.T
    is_inside = (
        (u > -margin_px) & (u < camera.width + margin_px) & (v > -margin_px) & (v < camera.height + margin_px)
    )
    rows, pixels = rows[is_inside], pixels[is_inside]
    # 2. Keep those whose viewing ray is similar, in direction and length, to that of the last image.
    distances = np.linalg.norm(points[rows], axis=1)
    last_rays = landmarks.rays[candidates[rows]] @ T_camera_world[:3, :3].T
    last_distances = np.linalg.norm(last_rays, axis=1)
    cosines = (last_rays * points[rows]).sum(axis=1) / np.maximum(distances * last_distances, 1e-9)
    is_similar = (
        (cosines > _MIN_VIEW_COSINE)
        & (distances < _MAX_RETREAT_RATIO * last_distances)
        & (last_distances < _MAX_APPROACH_RATIO * distances)
    )
    rows, pixels = rows[is_similar], pixels[is_similar]
    # 3. Turn the orientation into this image, and scale the size by the change of distance.
    orientations = landmarks.orientations[candidates[rows]] @ T_camera_world[:2, :3].T
    sizes = landmarks.sizes[candidates[rows]] * last_distances[is_similar]
    return rows, PredictedFeatures(
        pixels=pixels,
        descriptors=landmarks.descriptors[candidates[rows]],
        orientations=orientations / np.maximum(np.linalg.norm(orientations, axis=1), 1e-9)[:, None],
        sizes=sizes / np.maximum(distances[is_similar], 1e-9),
    )


def match_landmarks(
    landmarks: LandmarkAppearance,
    candidates: Rows,
    T_camera_world: Array,
    camera: Camera,
    image: Features,
    limits: GuidedMatchLimits,
    margin_px: float,
) -> tuple[Rows, Rows]:
    """Match landmarks with the features of an image near the pixels at which a pose predicts them.

    The result is that of `predict_features` followed by `match_predictions`; for ORB the native core does
    both in one call.

    Args:
        landmarks: All landmarks.
        candidates: ``(m,)`` rows of *landmarks* that are considered.
        T_camera_world: ``(4, 4)``, the predicted pose.
        camera: Intrinsics of the image.
        image: Features of the image.
        limits: Conditions of a match.
        margin_px: Width of the border outside the image in which landmarks are predicted, too.

    Returns:
        ``(k,)`` ascending indices *i*: landmark ``candidates[i]`` is matched; and the ``(k,)`` rows of
        *image* that match these landmarks.

    Raises:
        BadRequest: Shapes or the radius do not fit, for descriptors other than ORB.  With ORB nothing is
            checked: the caller must give one row for each landmark or feature in every array.
        MissingExtra: The descriptors are ORB, and the native core is not installed.
    """
    if not ORB.is_kind_of(image.descriptors):
        predicted_rows, predicted = predict_features(landmarks, candidates, T_camera_world, camera, margin_px)
        rows, features = match_predictions(predicted, image, limits)
        return predicted_rows[rows], features
    chosen = aligned(candidates, np.int64)
    points, rays, orientations, sizes, descriptors = _align_arrays(
        landmarks.points,
        landmarks.rays,
        landmarks.orientations,
        landmarks.sizes,
        descriptors=landmarks.descriptors,
    )
    request = _SeekRequest(
        abi=_ABI,
        rows=len(chosen),
        landmarks=len(points),
        numbers=address_of(chosen),
        points=address_of(points),
        rays=address_of(rays),
        directions=address_of(orientations),
        sizes=address_of(sizes),
        descriptors=address_of(descriptors),
        fx=camera.fx,
        fy=camera.fy,
        cx=camera.cx,
        cy=camera.cy,
        width=camera.width,
        height=camera.height,
        margin_px=margin_px,
        min_depth_m=_MIN_LANDMARK_DEPTH_M,
        min_cosine=_MIN_VIEW_COSINE,
        max_nearer=_MAX_APPROACH_RATIO,
        max_farther=_MAX_RETREAT_RATIO,
        T_camera_world=(_D * 16)(*T_camera_world.ravel().tolist()),
    )
    near, _referenced = _make_near_request(image, limits)
    return _call_matcher(_core("seek"), (request, near), len(chosen), len(image))


def match_predictions(
    predicted: PredictedFeatures, image: Features, limits: GuidedMatchLimits
) -> tuple[Rows, Rows]:
    """Match predicted features with features of an image; deterministic, one to one.

    A feature or prediction with a pixel coordinate that is not finite, or beyond 1e9 px, matches nothing.

    Returns:
        Ascending rows of *predicted*, and the row of *image* that matches each of them.

    Raises:
        BadRequest: Shapes or the radius do not fit, or descriptors are neither uint8 nor int8.
        MissingExtra: The descriptors are ORB, and the native core is not installed.
    """
    m, n = len(predicted.pixels), len(image)
    d = predicted.descriptors.shape[1:]
    shapes = (
        predicted.pixels.shape,
        predicted.descriptors.shape,
        predicted.orientations.shape,
        predicted.sizes.shape,
        image.pixels.shape,
        image.descriptors.shape,
        image.orientations.shape,
        image.sizes.shape,
        image.distinctiveness.shape,
    )
    if len(d) != 1 or shapes != ((m, 2), (m, *d), (m, 2), (m,), (n, 2), (n, *d), (n, 2), (n,), (n,)):
        raise BadRequest(
            f"arrays of {m} predicted features and {n} features of an image have shapes {shapes}, which do "
            "not fit together",
            hint="give one row for each feature in every array, and descriptors of one length",
        )
    dtypes = predicted.descriptors.dtype, image.descriptors.dtype
    if dtypes[0] not in _DESCRIPTOR_DTYPES or dtypes[1] != dtypes[0]:
        raise BadRequest(
            f"descriptors of {dtypes[0]} and {dtypes[1]} cannot be compared",
            hint="give descriptors of uint8 or int8 on both sides",
        )
    if not 0.0 <= limits.radius_px <= _MAX_PIXEL_PX:
        raise BadRequest(
            f"a search radius of {limits.radius_px:g} px is not within 0 to {_MAX_PIXEL_PX:g} px",
            hint="give a finite search radius, such as 40 px",
        )
    if not ORB.is_kind_of(image.descriptors):
        return _match_by_numpy(predicted, image, limits)
    arrays = _align_arrays(
        predicted.pixels, predicted.orientations, predicted.sizes, descriptors=predicted.descriptors
    )
    request, _referenced = _make_near_request(image, limits, arrays, m)
    return _call_matcher(_core("match_near"), (request,), m, n)


def _align_arrays(*arrays: Array, descriptors: npt.NDArray[np.uint8]) -> list[npt.NDArray[Any]]:
    """Return arrays as the native core reads them: float64 and contiguous, the descriptors last."""
    return [*(aligned(array, np.float64) for array in arrays), aligned(descriptors)]


def _make_near_request(
    image: Features,
    limits: GuidedMatchLimits,
    predicted: Sequence[npt.NDArray[Any]] = (),
    predicted_count: int = 0,
) -> tuple[_NearRequest, list[npt.NDArray[Any]]]:
    """Return a request for the native core, and the arrays that it points to, which must outlive the call.

    *predicted* are the arrays of `PredictedFeatures`, aligned.  Where the core predicts the features itself,
    there are none, and *predicted_count* is 0.
    """
    arrays = _align_arrays(image.pixels, image.orientations, image.sizes, descriptors=image.descriptors)
    arrays.append(aligned(image.distinctiveness, np.int32))
    predicted_addresses: list[int | None] = [None] * 4
    predicted_addresses[: len(predicted)] = map(address_of, predicted)
    *thresholds, max_distance = _thresholds(limits, image)
    request = _NearRequest(
        _ABI,
        0,
        predicted_count,
        len(image),
        *predicted_addresses,
        *map(address_of, arrays),
        *map(float, thresholds),
        int(min(max(max_distance, -1), _MAX_ORB_DISTANCE)),
    )
    return request, arrays


def _call_matcher(
    function: Any, requests: Sequence[ctypes.Structure], predicted_count: int, feature_count: int
) -> tuple[Rows, Rows]:
    """Call a matching function of the native core; return the matching rows of predictions and of features.

    There are none if the core refuses a size: more than 2^24 rows.
    """
    rows, features = np.empty((2, min(predicted_count, feature_count)), dtype=np.int64)
    workspace = _WORKSPACE.words(11 * predicted_count + 12 * feature_count + _GRID_WORDS)
    count = function(*map(ctypes.byref, requests), workspace, rows, features)
    return rows[: max(0, count)], features[: max(0, count)]


def _thresholds(limits: GuidedMatchLimits, image: Features) -> tuple[float, float, float, float, float, int]:
    """Return the six *limits* in the order in which the native core's request has them.

    If the features of *image* have no orientations, or no sizes, the limit of these is an infinite one, which
    every feature passes.
    """
    return (
        limits.radius_px,
        limits.lowe_ratio,
        limits.distinctiveness_ratio,
        limits.min_orientation_cosine if image.is_oriented else -np.inf,
        limits.max_size_ratio if image.is_scaled else np.inf,
        limits.max_distance,
    )


def _match_by_numpy(
    predicted: PredictedFeatures, image: Features, limits: GuidedMatchLimits
) -> tuple[Rows, Rows]:
    """Match predicted features of a kind other than ORB, as `match_predictions` describes."""
    radius_px, lowe_ratio, distinctiveness_ratio, min_cosine, max_size_ratio, max_bits = _thresholds(
        limits, image
    )
    empty = np.empty(0, dtype=np.int64)
    if not len(predicted.pixels) or not len(image):
        return empty, empty
    # 1. For a kind other than ORB (the native core matches ORB): pair predictions with the features of the
    #    image that lie within the radius and have a similar orientation and size.
    with np.errstate(invalid="ignore", over="ignore"):
        rows, features = _find_pairs_within(
            np.asarray(predicted.pixels, np.float64), np.asarray(image.pixels, np.float64), radius_px
        )
        a = np.asarray(predicted.orientations, np.float64)[rows]
        b = np.asarray(image.orientations, np.float64)[features]
        predicted_size = np.asarray(predicted.sizes, np.float64)[rows]
        size = np.asarray(image.sizes, np.float64)[features]
        is_similar = (
            (a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] >= min_cosine)
            & (size <= max_size_ratio * predicted_size)
            & (predicted_size <= max_size_ratio * size)
        )
    rows, features = rows[is_similar], features[is_similar]
    if not len(rows):
        return empty, empty
    # 2. Find the best and the second best feature of each prediction by the distance of descriptors.
    distances = distances_of_pairs(predicted.descriptors[rows], image.descriptors[features])
    order = np.lexsort((features, distances, rows))
    rows, features, distances = rows[order], features[order], distances[order]
    starts = np.flatnonzero(np.concatenate(([True], rows[1:] != rows[:-1])))
    seconds = np.minimum(starts + 1, len(rows) - 1)
    has_second = (rows[seconds] == rows[starts]) & (seconds > starts)
    best = distances[starts]
    # 3. Keep the best features that pass the tests of distance, of distinctiveness and of Lowe's ratio.
    max_distance = max_bits * image.descriptors.shape[1] // ORB.size
    if image.descriptors.dtype != np.uint8:
        max_distance = distance_bound(image.descriptors)
    is_clear = (
        (best <= max_distance)
        & (best < distinctiveness_ratio * image.distinctiveness[features[starts]])
        & (~has_second | (best < lowe_ratio * distances[seconds]))
    )
    rows, features, best = rows[starts][is_clear], features[starts][is_clear], best[is_clear]
    # 4. Of several predictions with the same best feature, keep the one whose descriptor is most similar.
    nearest_first = np.argsort(best, kind="stable")
    _, firsts = np.unique(features[nearest_first], return_index=True)
    chosen = np.sort(nearest_first[firsts])
    return rows[chosen].astype(np.int64), features[chosen]


def _find_pairs_within(predicted: Array, pixels: Array, radius_px: float) -> tuple[Rows, Rows]:
    """Return all pairs (row of *predicted*, row of *pixels*) that are at most *radius_px* apart.

    The pixels are sorted by horizontal bands, and by column within a band, so that each prediction is
    compared with a stretch of three bands only.
    """
    reach = radius_px + 1.0  # a pixel more, since the sum of a coordinate and the radius is rounded
    finite = np.flatnonzero((np.abs(predicted) <= _MAX_PIXEL_PX).all(axis=1))
    predicted = predicted[finite]
    keys = _band_keys(np.floor(pixels[:, 1] / reach), pixels[:, 0])
    order = np.argsort(keys, kind="stable")
    keys = keys[order]
    bands = np.floor(predicted[:, 1] / reach)
    pairs: list[tuple[Rows, Rows]] = []
    for offset in (-1, 0, 1):
        first = np.searchsorted(keys, _band_keys(bands + offset, predicted[:, 0] - reach))
        last = np.searchsorted(keys, _band_keys(bands + offset, predicted[:, 0] + reach), side="right")
        counts = last - first
        rows = np.repeat(np.arange(len(predicted)), counts)
        within_stretch = np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts)
        features = order[np.repeat(first, counts) + within_stretch]
        apart = pixels[features] - predicted[rows]
        is_near = apart[:, 0] * apart[:, 0] + apart[:, 1] * apart[:, 1] <= radius_px * radius_px
        pairs.append((finite[rows[is_near]], features[is_near].astype(np.int64)))
    return np.concatenate([rows for rows, _ in pairs]), np.concatenate([features for _, features in pairs])


def _band_keys(bands: Array, columns: Array) -> Array:
    """Return numbers that sort pixels by band, then by column; columns far outside stay in their band."""
    keys: Array = bands * _BAND_KEY_STEP + np.clip(columns, -0.4 * _BAND_KEY_STEP, 0.4 * _BAND_KEY_STEP)
    return keys


def fit_pose(
    observed: Observations,
    camera: Camera,
    T_camera_world: Array,
    *,
    cauchy: float = 2.5,
    gate2: float = 11.3,
) -> FittedPose | None:
    """Fit a pose to pixels and depths of landmarks, weighted by the noise of pixels, depths and landmarks.

    The method is iteratively reweighted least squares with Cauchy weights; after three iterations only
    observations within the gate count.

    Args:
        observed: Observations of one image.
        camera: Its intrinsics.
        T_camera_world: ``(4, 4)``, the initial pose.
        cauchy: Distance, in standard deviations, at which an observation has half its weight.
        gate2: Squared distance of pixel and depth from their prediction, in variances, beyond which an
            observation is an outlier; 11.3 keeps 99 % of Gaussian observations of three numbers, and more of
            those without depth, which have two.

    Returns:
        None where the observations do not determine the pose, where the fit diverges, and where any number of
        any observation is not finite, or beyond its limit: 1e9 m for a point, 1e9 px for a pixel, 1 km for a
        depth, 0.001 to 1e6 px for the standard deviation of a pixel, and 1e-6 to 1000 m for that of a depth.

    Raises:
        BadRequest: Shapes do not fit.
        MissingExtra: The native core is not installed.

    Source:
        Errors in variables after Segal et al., "Generalized-ICP", RSS 2009, here with pixels and depths.
    """
    n = len(observed.points)
    shapes = (
        observed.points.shape,
        observed.covariances.shape,
        observed.pixels.shape,
        observed.pixel_sigmas_px.shape,
        observed.depths_m.shape,
        observed.depth_sigmas_m.shape,
        T_camera_world.shape,
    )
    if shapes != ((n, 3), (n, 3, 3), (n, 2), (n,), (n,), (n,), (4, 4)):
        raise BadRequest(
            f"observations of {n} landmarks and a pose have shapes {shapes}, which do not fit together",
            hint="give one row for each landmark in every array, and a 4x4 pose",
        )
    is_inlier = np.zeros(n, dtype=np.uint8)
    result = _FitResult()
    request, _referenced = _make_fit_request(observed, camera, T_camera_world, cauchy, gate2)
    if _core("fit_pose")(ctypes.byref(request), is_inlier, ctypes.byref(result)):
        return None
    return FittedPose(
        T_camera_world=np.array(result.T_camera_world).reshape(4, 4),
        information=np.array(result.information).reshape(6, 6),
        is_inlier=is_inlier.view(bool),
    )


def _make_fit_request(
    observed: Observations, camera: Camera, T_camera_world: Array, cauchy: float, gate2: float
) -> tuple[_FitRequest, list[Array]]:
    """Return a request for the native core, and the arrays that it points to, which must outlive the call."""
    upper_triangles = observed.covariances.reshape(-1, 9)[:, (0, 1, 2, 4, 5, 8)]
    measured = observed.pixels, observed.pixel_sigmas_px, observed.depths_m, observed.depth_sigmas_m
    arrays = [aligned(array, np.float64) for array in (observed.points, upper_triangles, *measured)]
    points, point_covariances, pixels, pixel_sigmas_px, depths_m, depth_sigmas_m = map(address_of, arrays)
    request = _FitRequest(
        abi=_ABI,
        rows=len(observed.points),
        points=points,
        point_covariances=point_covariances,
        pixels=pixels,
        pixel_sigmas_px=pixel_sigmas_px,
        depths_m=depths_m,
        depth_sigmas_m=depth_sigmas_m,
        fx=camera.fx,
        fy=camera.fy,
        cx=camera.cx,
        cy=camera.cy,
        cauchy2=cauchy * cauchy,
        gate2=gate2,
        T_camera_world=(_D * 16)(*T_camera_world.ravel().tolist()),
    )
    return request, arrays


def fit_readout_change(
    observed: Observations,
    displacements: Array,
    camera: Camera,
    T_camera_world: Array,
    *,
    cauchy: float = 2.5,
) -> tuple[float, float]:
    """Estimate by how many seconds a rolling shutter's readout time is wrong, from one image.

    The change of the readout time and the change of the pose are solved together by one Gauss-Newton step
    from the pose that fits; the change of the pose is discarded.

    Args:
        observed: Inliers of one image.
        displacements: ``(n, 3)`` metres per second, camera axes.  If the readout time is wrong, the landmark
            in the map and its point measured by this image are both in a wrong place.  This is the derivative
            of the landmark's position by the readout time minus that of the measured point.
        camera: Intrinsics.
        T_camera_world: ``(4, 4)``, the pose that fits.
        cauchy: Distance, in standard deviations, at which an observation has half its weight.

    Returns:
        The change in seconds, to be added to the readout time, and its information (inverse variance, 1/s^2);
        0 and 0 where the image does not determine it.

    Raises:
        MissingExtra: The native core is not installed.
    """
    request, _referenced = _make_fit_request(observed, camera, T_camera_world, cauchy, 0.0)
    fitted = np.zeros(2)
    _core("fit_sway")(
        ctypes.byref(request), displacements.astype(np.float64, copy=False), fitted[:1], fitted[1:]
    )
    return float(fitted[0]), float(fitted[1])
