"""What a tracker computes for each frame: matches near predicted pixels, and the pose that fits landmarks.

The native core does both.  Features of other kinds than ORB, which a user's function computes, are matched by
numpy.  Which landmarks are sought, and what is done with a pose, is decided elsewhere.
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
from rse_pf.maps.descriptors import ORB, Descriptors
from rse_pf.native import PART_ABIS, Workspace, address_of, aligned, core_function
from rse_pf.slam.descriptors import distance_matrix, distances_of_pairs, no_distance

__all__ = [
    "ExpectedFeatures",
    "FittedPose",
    "ImageFeatures",
    "LandmarkLooks",
    "NearLimits",
    "Observations",
    "SoughtFeatures",
    "distinct_distances",
    "expect",
    "fit_pose",
    "fit_sway",
    "match_near",
    "seek_near",
]

Rows = npt.NDArray[np.int64]

_ABI = PART_ABIS["track"]
_CELL_WORDS = 16_400  # of the grid of cells in which `rse_pf_match_near` sorts features
_NO_ORB_DISTANCE = 256  # above every distance of two descriptors that differ
_DTYPES = (np.uint8, np.int8)
_BAND = 1e6  # between the sort keys of two rows of bands; no image is wider
_MAX_ABS = 1e9  # px: features farther out match nothing
_NEAREST_M = 0.1  # nearer landmarks are not sought
_MIN_COSINE = 0.6  # between the rays of two looks: from other directions a landmark looks different
_MAX_NEARER, _MAX_FARTHER = 2.0, 2.0  # ratios of distances: from others a landmark looks different


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImageFeatures:
    """Features of one image.

    ``pixels`` ``(n, 2)``, undistorted; ``descriptors`` ``(n, d)``; ``turns`` ``(n, 2)``, cosine and sine of
    the orientation; ``sizes`` ``(n,)``, the scale of the pyramid's level, 1 for the finest; ``distinct``
    ``(n,)`` as `distinct_distances` returns it.  Turns and sizes tell nothing unless the features are
    *is_oriented* and *is_scaled*.
    """

    pixels: Array
    descriptors: Descriptors
    turns: Array
    sizes: Array
    distinct: npt.NDArray[np.int32]
    is_oriented: bool = True
    is_scaled: bool = True

    def __len__(self) -> int:
        return len(self.pixels)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SoughtFeatures:
    """Features that are expected in an image: their ``(m, 2)`` pixels, ``(m, 2)`` turns and ``(m,)`` sizes.

    ``turns`` are cosine and sine of the expected orientation.
    """

    pixels: Array
    descriptors: Descriptors
    turns: Array
    sizes: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LandmarkLooks:
    """Points of the world, and how they looked in the last image that showed them.

    ``points`` ``(n, 3)``; ``rays`` ``(n, 3)`` from the camera that saw them last, and ``turns`` ``(n, 3)``
    their orientation there, in the world; ``sizes`` ``(n,)``; ``descriptors`` ``(n, d)``.
    """

    points: Array
    rays: Array
    turns: Array
    sizes: Array
    descriptors: Descriptors


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ExpectedFeatures:
    """Landmarks as a pose expects them in its image: ``rows`` of the landmarks, and the features."""

    rows: Rows
    features: SoughtFeatures


@dataclass(frozen=True, slots=True, kw_only=True)
class NearLimits:
    """When a feature is the expected one.

    Attributes:
        radius_px: Around the expected pixel.
        ratio: The most similar feature must be this much nearer than the second within the radius.
        distinct_ratio: And this much nearer than the feature of its own image that resembles it most: a
            carpet or a wall of tiles looks alike beyond the radius, too.
        min_cosine: Between the expected orientation and its own.
        max_size_ratio: Between the expected size and its own, either way.
        max_distance: Largest Hamming distance, of 256 bits; other binary descriptors by their bits.  Vectors
            have none.
    """

    radius_px: float
    ratio: float = 0.8
    distinct_ratio: float = 0.8
    min_cosine: float = 0.9
    max_size_ratio: float = 1.35
    max_distance: int = 60


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Observations:
    """Landmarks and what one image measured of them.

    Attributes:
        points: ``(n, 3)`` metres, world.
        spreads: ``(n, 3, 3)`` covariances of the points, square metres, world.
        pixels: ``(n, 2)``.
        pixels_px: ``(n,)`` deviations of the pixels.
        depths_m: ``(n,)`` along the optical axis, 0 where there is none.
        depths_dev_m: ``(n,)`` deviations of the depths; not read where there is none.
    """

    points: Array
    spreads: Array
    pixels: Array
    pixels_px: Array
    depths_m: Array
    depths_dev_m: Array

    def only(self, rows: Rows) -> Observations:
        """Return some of the rows."""
        return Observations(
            points=self.points[rows], spreads=self.spreads[rows], pixels=self.pixels[rows],
            pixels_px=self.pixels_px[rows], depths_m=self.depths_m[rows],
            depths_dev_m=self.depths_dev_m[rows],
        )  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FittedPose:
    """``T_camera_world``, the ``(6, 6)`` information of the twist on its left, and ``(n,)`` who agrees."""

    T_camera_world: Array
    information: Array
    is_inlier: npt.NDArray[np.bool_]


_P, _I, _D = ctypes.c_void_p, ctypes.c_int64, ctypes.c_double
_WORKSPACE = Workspace()


class _NearRequest(ctypes.Structure):
    """``rse_pf_near_request`` of ``rse_pf_track.h``."""

    _fields_ = (
        ("abi", ctypes.c_uint32), ("flags", ctypes.c_uint32), ("sought_rows", _I), ("rows", _I),
        ("predicted", _P), ("sought_turns", _P), ("sought_sizes", _P), ("sought", _P), ("pixels", _P),
        ("turns", _P), ("sizes", _P), ("descriptors", _P), ("distinct", _P), ("radius_px", _D), ("ratio", _D),
        ("distinct_ratio", _D), ("min_cosine", _D), ("max_size_ratio", _D), ("max_distance", _I),
    )  # fmt: skip


class _SeekRequest(ctypes.Structure):
    """``rse_pf_seek_request`` of ``rse_pf_track.h``."""

    _fields_ = (
        ("abi", ctypes.c_uint32), ("flags", ctypes.c_uint32), ("rows", _I), ("landmarks", _I),
        ("numbers", _P), ("points", _P), ("rays", _P), ("turns", _P), ("sizes", _P), ("descriptors", _P),
        ("fx", _D), ("fy", _D), ("cx", _D), ("cy", _D), ("width", _D), ("height", _D), ("margin_px", _D),
        ("nearest_m", _D), ("min_cosine", _D), ("max_nearer", _D), ("max_farther", _D),
        ("T_camera_world", _D * 16),
    )  # fmt: skip


class _FitRequest(ctypes.Structure):
    """``rse_pf_fit_request`` of ``rse_pf_track.h``."""

    _fields_ = (
        ("abi", ctypes.c_uint32), ("flags", ctypes.c_uint32), ("rows", _I), ("points", _P), ("spreads", _P),
        ("pixels", _P), ("pixels_px", _P), ("depths_m", _P), ("depths_dev", _P), ("fx", _D), ("fy", _D),
        ("cx", _D), ("cy", _D), ("cauchy2", _D), ("gate2", _D), ("T_camera_world", _D * 16),
    )  # fmt: skip


class _FitResult(ctypes.Structure):
    """``rse_pf_fit_result`` of ``rse_pf_track.h``."""

    _fields_ = (("inliers", _I), ("T_camera_world", _D * 16), ("information", _D * 36))


_SIGNATURES = {
    "distinct": ((_P, _P, _I, _D, _P), ctypes.c_int32),
    "match_near": ((_P,) * 4, _I),
    "seek": ((_P,) * 5, _I),
    "fit_pose": ((_P,) * 3, ctypes.c_int32),
    "fit_sway": ((_P,) * 4, ctypes.c_int32),
}


@cache
def _function(name: str) -> Any:
    return core_function("track", f"rse_pf_{name}", *_SIGNATURES[name])


def distinct_distances(
    descriptors: Descriptors, pixels: Array, apart_px: float = 6.0
) -> npt.NDArray[np.int32]:
    """Return the distance of each feature to the most similar other one of its image.

    Features that are closer than *apart_px* in rows and columns are the same point, and are not compared.

    Args:
        descriptors: ``(n, d)``.
        pixels: ``(n, 2)``.
        apart_px: Of two features that are compared.

    Returns:
        ``(n,)``; where there is no other one a number above all distances, 256 of ORB.

    Raises:
        BadRequest: Shapes do not fit, or descriptors are neither uint8 nor int8.
    """
    is_fit = descriptors.ndim == 2 and len(descriptors) == len(pixels) and pixels.shape[1:] == (2,)
    if not is_fit or descriptors.dtype not in _DTYPES:
        raise BadRequest(
            f"{len(pixels)} features with descriptors of shape {descriptors.shape}, {descriptors.dtype}",
            hint="give a descriptor and two pixel coordinates for each feature",
        )
    if ORB.is_kind_of(descriptors):
        descriptors, pixels = aligned(descriptors), aligned(pixels, np.float64)
        nearest = np.full(len(pixels), _NO_ORB_DISTANCE, dtype=np.int32)
        _function("distinct")(
            address_of(descriptors), address_of(pixels), len(pixels), float(apart_px), address_of(nearest)
        )
        return nearest
    pixels = np.asarray(pixels, dtype=np.float64)
    distances, none = distance_matrix(descriptors, descriptors), no_distance(descriptors)
    with np.errstate(invalid="ignore", over="ignore"):
        apart = (np.abs(pixels[:, None] - pixels[None]) >= apart_px).any(axis=2)
    distances[~apart | np.eye(len(pixels), dtype=bool)] = none
    similar: npt.NDArray[np.int32] = distances.min(axis=1, initial=none).astype(np.int32)
    return similar


def match_near(sought: SoughtFeatures, image: ImageFeatures, limits: NearLimits) -> tuple[Rows, Rows]:
    """Return rows of *sought* and of *image* that match, by the rows of *sought*; deterministic, one to one.

    A feature or prediction at no finite place, or beyond 1e9 px, matches nothing.

    Raises:
        BadRequest: Shapes or the radius do not fit, or descriptors are no bytes.
    """
    m, n = len(sought.pixels), len(image)
    d = sought.descriptors.shape[1:]
    shapes = (
        sought.pixels.shape, sought.descriptors.shape, sought.turns.shape, sought.sizes.shape,
        image.pixels.shape, image.descriptors.shape, image.turns.shape, image.sizes.shape,
        image.distinct.shape,
    )  # fmt: skip
    if len(d) != 1 or shapes != ((m, 2), (m, *d), (m, 2), (m,), (n, 2), (n, *d), (n, 2), (n,), (n,)):
        raise BadRequest(
            "features of different numbers of rows, or kinds", hint="give one row of each for each feature"
        )
    if sought.descriptors.dtype not in _DTYPES or image.descriptors.dtype != sought.descriptors.dtype:
        raise BadRequest(
            f"descriptors of {sought.descriptors.dtype} and {image.descriptors.dtype}",
            hint="give uint8 or int8 of both",
        )
    if not 0.0 <= limits.radius_px <= _MAX_ABS:
        raise BadRequest(f"a radius of {limits.radius_px:g} px", hint="give 0 to 1e9 px")
    if not ORB.is_kind_of(image.descriptors):
        return _match_near_by_numpy(sought, image, limits)
    arrays = _aligned(sought.pixels, sought.turns, sought.sizes, descriptors=sought.descriptors)
    request, _held = _near_request(image, limits, arrays, m)
    return _core_matches(_function("match_near"), (request,), m, n)


def expect(
    looks: LandmarkLooks, numbers: Rows, T_camera_world: Array, camera: Camera, margin_px: float
) -> ExpectedFeatures:
    """Return what a pose sees of landmarks: those ahead, in the image, and seen from such a place before.

    Args:
        looks: Of landmarks.
        numbers: ``(m,)`` rows of *looks*.
        T_camera_world: ``(4, 4)``.
        camera: Its intrinsics.
        margin_px: Around its image.
    """
    points = transform(T_camera_world, looks.points[numbers])
    ahead = np.flatnonzero(points[:, 2] > _NEAREST_M)
    pixels = camera.project(points[ahead])
    u, v = pixels.T
    inside = (
        (u > -margin_px) & (u < camera.width + margin_px) & (v > -margin_px) & (v < camera.height + margin_px)
    )
    ahead, pixels = ahead[inside], pixels[inside]
    distances = np.linalg.norm(points[ahead], axis=1)
    # The ray of the last look, in this camera's frame.
    rays = looks.rays[numbers[ahead]] @ T_camera_world[:3, :3].T
    before = np.linalg.norm(rays, axis=1)
    cosines = (rays * points[ahead]).sum(axis=1) / np.maximum(distances * before, 1e-9)
    is_alike = (
        (cosines > _MIN_COSINE) & (distances < _MAX_FARTHER * before) & (before < _MAX_NEARER * distances)
    )
    rows, pixels = ahead[is_alike], pixels[is_alike]
    turns = looks.turns[numbers[rows]] @ T_camera_world[:2, :3].T
    features = SoughtFeatures(
        pixels=pixels,
        descriptors=looks.descriptors[numbers[rows]],
        turns=turns / np.maximum(np.linalg.norm(turns, axis=1), 1e-9)[:, None],
        sizes=looks.sizes[numbers[rows]] * before[is_alike] / np.maximum(distances[is_alike], 1e-9),
    )
    return ExpectedFeatures(rows=rows, features=features)


def seek_near(
    looks: LandmarkLooks, numbers: Rows, T_camera_world: Array, camera: Camera, image: ImageFeatures,
    limits: NearLimits, margin_px: float,
) -> tuple[Rows, Rows]:  # fmt: skip
    """Return rows of *numbers* and of *image* that match where a pose expects landmarks, as `match_near`.

    Args:
        looks: Of landmarks.
        numbers: ``(m,)`` rows of *looks* that are sought.
        T_camera_world: ``(4, 4)``.
        camera: Its intrinsics.
        image: Where they are sought.
        limits: When a feature is the expected one.
        margin_px: Landmarks are expected so far around the image, too.
    """
    if not ORB.is_kind_of(image.descriptors):
        expected = expect(looks, numbers, T_camera_world, camera, margin_px)
        rows, features = match_near(expected.features, image, limits)
        return expected.rows[rows], features
    chosen = aligned(numbers, np.int64)
    arrays = _aligned(looks.points, looks.rays, looks.turns, looks.sizes, descriptors=looks.descriptors)
    request = _SeekRequest(
        _ABI, 0, len(chosen), len(looks.points), address_of(chosen), *map(address_of, arrays),
        camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height, margin_px,
        _NEAREST_M, _MIN_COSINE, _MAX_NEARER, _MAX_FARTHER, (_D * 16)(*T_camera_world.ravel().tolist()),
    )  # fmt: skip
    near, _held = _near_request(image, limits)
    return _core_matches(_function("seek"), (request, near), len(chosen), len(image))


def _aligned(*arrays: Array, descriptors: npt.NDArray[np.uint8]) -> list[npt.NDArray[Any]]:
    """Return arrays of numbers and their descriptors as the native core reads them."""
    return [*(aligned(array, np.float64) for array in arrays), aligned(descriptors)]


def _near_request(
    image: ImageFeatures, limits: NearLimits, sought: Sequence[npt.NDArray[Any]] = (), sought_rows: int = 0
) -> tuple[_NearRequest, list[npt.NDArray[Any]]]:
    """Return a request, and the arrays of *image* that it points to, which must live as long."""
    arrays = _aligned(image.pixels, image.turns, image.sizes, descriptors=image.descriptors)
    arrays.append(aligned(image.distinct, np.int32))
    sought_at: list[int | None] = [None] * 4
    sought_at[: len(sought)] = map(address_of, sought)
    *numbers, max_distance = _numbers_of(limits, image)
    request = _NearRequest(
        _ABI, 0, sought_rows, len(image), *sought_at, *map(address_of, arrays), *map(float, numbers),
        int(min(max(max_distance, -1), _NO_ORB_DISTANCE)),
    )  # fmt: skip
    return request, arrays


def _core_matches(
    function: Any, requests: Sequence[ctypes.Structure], sought_rows: int, image_rows: int
) -> tuple[Rows, Rows]:
    """Return the rows that a function of the native core matches."""
    rows, columns = np.empty((2, min(sought_rows, image_rows)), dtype=np.int64)
    workspace = _WORKSPACE.words(11 * sought_rows + 12 * image_rows + _CELL_WORDS)
    count = function(*map(ctypes.byref, requests), *map(address_of, (workspace, rows, columns)))
    return rows[: max(0, count)], columns[: max(0, count)]


def _numbers_of(limits: NearLimits, image: ImageFeatures) -> tuple[float, float, float, float, float, int]:
    """Return the limits in the order of the native core; features without turns have no limit of them."""
    return (
        limits.radius_px, limits.ratio, limits.distinct_ratio,
        limits.min_cosine if image.is_oriented else -np.inf,
        limits.max_size_ratio if image.is_scaled else np.inf, limits.max_distance,
    )  # fmt: skip


def _match_near_by_numpy(
    sought: SoughtFeatures, image: ImageFeatures, limits: NearLimits
) -> tuple[Rows, Rows]:
    """Return what `match_near` does of descriptors of any kind."""
    radius_px, ratio, distinct_ratio, min_cosine, max_size_ratio, max_distance = _numbers_of(limits, image)
    empty = np.empty(0, dtype=np.int64)
    if not len(sought.pixels) or not len(image):
        return empty, empty
    with np.errstate(invalid="ignore", over="ignore"):
        rows, columns = _pairs_within(
            np.asarray(sought.pixels, np.float64), np.asarray(image.pixels, np.float64), radius_px
        )
        a, b = np.asarray(sought.turns, np.float64)[rows], np.asarray(image.turns, np.float64)[columns]
        expected = np.asarray(sought.sizes, np.float64)[rows]
        size = np.asarray(image.sizes, np.float64)[columns]
        fits = (
            (a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] >= min_cosine)
            & (size <= max_size_ratio * expected) & (expected <= max_size_ratio * size)
        )  # fmt: skip
    rows, columns = rows[fits], columns[fits]
    if not len(rows):
        return empty, empty
    distances = distances_of_pairs(sought.descriptors[rows], image.descriptors[columns])
    most = max_distance * image.descriptors.shape[1] // ORB.size
    if image.descriptors.dtype != np.uint8:
        most = no_distance(image.descriptors)
    order = np.lexsort((columns, distances, rows))
    rows, columns, distances = rows[order], columns[order], distances[order]
    starts = np.flatnonzero(np.concatenate(([True], rows[1:] != rows[:-1])))
    follows = np.minimum(starts + 1, len(rows) - 1)
    has_second = (rows[follows] == rows[starts]) & (follows > starts)
    best = distances[starts]
    clear = (
        (best <= most)
        & (best < distinct_ratio * image.distinct[columns[starts]])
        & (~has_second | (best < ratio * distances[follows]))
    )
    rows, columns, best = rows[starts][clear], columns[starts][clear], best[clear]
    nearest_first = np.argsort(best, kind="stable")
    _, firsts = np.unique(columns[nearest_first], return_index=True)
    chosen = np.sort(nearest_first[firsts])
    return rows[chosen].astype(np.int64), columns[chosen]


def _pairs_within(predicted: Array, pixels: Array, radius_px: float) -> tuple[Rows, Rows]:
    """Return all pairs (row of predicted, row of pixels) within the radius.

    The pixels are sorted by bands of rows, and by column within a band, so that each prediction looks at a
    stretch of three bands only.
    """
    reach = radius_px + 1.0  # the sum of a pixel and a radius is rounded
    known = np.flatnonzero((np.abs(predicted) <= _MAX_ABS).all(axis=1))
    predicted = predicted[known]
    key = _key(np.floor(pixels[:, 1] / reach), pixels[:, 0])
    order = np.argsort(key, kind="stable")
    key = key[order]
    band = np.floor(predicted[:, 1] / reach)
    pairs: list[tuple[Rows, Rows]] = []
    for offset in (-1, 0, 1):
        first = np.searchsorted(key, _key(band + offset, predicted[:, 0] - reach))
        last = np.searchsorted(key, _key(band + offset, predicted[:, 0] + reach), side="right")
        counts = last - first
        rows = np.repeat(np.arange(len(predicted)), counts)
        offsets = np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts)
        columns = order[np.repeat(first, counts) + offsets]
        apart = pixels[columns] - predicted[rows]
        near = apart[:, 0] * apart[:, 0] + apart[:, 1] * apart[:, 1] <= radius_px * radius_px
        pairs.append((known[rows[near]], columns[near].astype(np.int64)))
    return np.concatenate([rows for rows, _ in pairs]), np.concatenate([columns for _, columns in pairs])


def _key(band: Array, x: Array) -> Array:
    """Return numbers that sort by band, then by column; columns far outside stay in their band."""
    key: Array = band * _BAND + np.clip(x, -0.4 * _BAND, 0.4 * _BAND)
    return key


def fit_pose(
    observed: Observations,
    camera: Camera,
    T_camera_world: Array,
    *,
    cauchy: float = 2.5,
    gate2: float = 11.3,
) -> FittedPose | None:
    """Return the pose that fits pixels, depths and landmarks by the noise of all; None if it is free.

    Iterated least squares with a Cauchy weight; after three steps only rows within the gate count.  None as
    well where a number is not finite, or beyond what any camera measures: 1e9 m or px, depths of 1 km.

    Args:
        observed: Of one image.
        camera: Its intrinsics.
        T_camera_world: ``(4, 4)``, where the fit begins.
        cauchy: Distance in standard deviations at which a row weighs half.
        gate2: Squared distance beyond which a row does not agree: 11.3 keeps 99 % of three numbers.

    Raises:
        BadRequest: Shapes do not fit.

    Source:
        Errors in variables after Segal et al., Generalized-ICP (RSS 2009), here with pixels and depths.
    """
    n = len(observed.points)
    shapes = (
        observed.points.shape, observed.spreads.shape, observed.pixels.shape, observed.pixels_px.shape,
        observed.depths_m.shape, observed.depths_dev_m.shape, T_camera_world.shape,
    )  # fmt: skip
    if shapes != ((n, 3), (n, 3, 3), (n, 2), (n,), (n,), (n,), (4, 4)):
        raise BadRequest(
            "observations of different numbers of rows", hint="give one row for each landmark, and a 4x4 pose"
        )
    is_inlier = np.zeros(n, dtype=np.uint8)
    result = _FitResult()
    request, _held = _fit_request(observed, camera, T_camera_world, cauchy, gate2)
    if _function("fit_pose")(ctypes.byref(request), address_of(is_inlier), ctypes.byref(result)):
        return None
    return FittedPose(
        T_camera_world=np.array(result.T_camera_world).reshape(4, 4),
        information=np.array(result.information).reshape(6, 6), is_inlier=is_inlier.view(bool),
    )  # fmt: skip


def _fit_request(
    observed: Observations, camera: Camera, T_camera_world: Array, cauchy: float, gate2: float
) -> tuple[_FitRequest, list[Array]]:
    """Return a request, and the arrays that it points to, which must live as long."""
    upper = observed.spreads.reshape(-1, 9)[:, (0, 1, 2, 4, 5, 8)]
    measured = observed.pixels, observed.pixels_px, observed.depths_m, observed.depths_dev_m
    arrays = [aligned(array, np.float64) for array in (observed.points, upper, *measured)]
    request = _FitRequest(
        _ABI, 0, len(arrays[0]), *map(address_of, arrays), camera.fx, camera.fy, camera.cx, camera.cy,
        float(cauchy * cauchy), float(gate2), (_D * 16)(*T_camera_world.ravel().tolist()),
    )  # fmt: skip
    return request, arrays


def fit_sway(
    observed: Observations, sways: Array, camera: Camera, T_camera_world: Array, *, cauchy: float = 2.5
) -> tuple[float, float]:
    """Return by how much ``(n, 3)`` motions of the points explain what an image shows, and the information.

    It is solved beside the pose, by one step from the pose that fits; 0 and 0 where nothing can be said.

    Args:
        observed: Of one image; rows that agree with the pose.
        sways: ``(n, 3)``, how landmarks move in the camera's frame for a unit, less how measured points do.
        camera: Its intrinsics.
        T_camera_world: ``(4, 4)``, the pose that fits.
        cauchy: As in `fit_pose`.
    """
    sways = aligned(sways, np.float64)
    request, _held = _fit_request(observed, camera, T_camera_world, cauchy, 0.0)
    fitted = np.zeros(2)
    at = address_of(fitted)
    _function("fit_sway")(ctypes.byref(request), address_of(sways), at, at + fitted.itemsize)
    return float(fitted[0]), float(fitted[1])
