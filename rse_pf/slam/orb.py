"""ORB features of one image: detected, spread over the image, and described.

Every part of the platform that compares an image with keyframes gets its ORB features here.  The native core
detects and describes them, and OpenCV gives the same bytes.  OpenCV is used where the core returns no result
(see `detect_keypoints` and `describe_keypoints`), such as on processors without AVX2, and by `describe_at`.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array
from rse_pf.images import load_opencv
from rse_pf.maps.descriptors import ORB, DescriptorKind, Descriptors
from rse_pf.native import Workspace, address_of, aligned, core_function

__all__ = [
    "DescribedKeypoints",
    "Keypoints",
    "describe_at",
    "describe_keypoints",
    "describe_orb",
    "detect_keypoints",
    "select_spread_rows",
]

_Floats = npt.NDArray[np.floating[Any]]

_PYRAMID_SCALE = 1.2
"""Ratio of the sizes of two neighbouring levels of ORB's image pyramid: the default of OpenCV's ORB."""
_PYRAMID_LEVELS = 8
"""Number of levels of ORB's image pyramid: the default of OpenCV's ORB."""
_LEVEL_SIZES: Array = np.power(_PYRAMID_SCALE, np.arange(_PYRAMID_LEVELS, dtype=np.float64))
_CORE_LEVEL_SIZES = np.array(
    [float(np.float32(_PYRAMID_SCALE)) ** level for level in range(_PYRAMID_LEVELS)], dtype=np.float32
)
"""Scale of each pyramid level with the rounding of OpenCV, as the native core needs it for equal results."""
_FAST_THRESHOLD = 10
"""Threshold of the FAST corner detector in grey levels where the strongest features of the image are
taken."""
_FAST_THRESHOLD_SPREAD = 7
"""Threshold of the FAST corner detector in grey levels where features are spread over the cells of the image:
it is lower, so that there are keypoints in dark cells, too."""
_PATCH_PX = 31.0
"""Width of ORB's patch on the finest pyramid level, in pixels."""
_DETECTED_PER_FEATURE = 3
"""Quotient of the number of keypoints that are detected and the number of features that are wanted, where
features are spread over the image."""
_CELL_PX = 40
"""Width and height of the image cells over which features are spread, in pixels."""
_RADIANS_PER_DEGREE = np.float32(math.pi / 180)
_WORKSPACE = Workspace()
_DESCRIBE_ARGUMENTS = (
    ctypes.c_void_p,
    ctypes.c_int64,
    ctypes.c_int64,
    ctypes.c_void_p,
    ctypes.c_int32,
    *[ctypes.c_void_p] * 4,
    ctypes.c_int64,
    *[ctypes.c_void_p] * 2,
)
"""Types of the arguments of the native core's ``rse_pf_describe``."""


class Keypoints(NamedTuple):
    """Keypoints of one image, in the number types of OpenCV.

    Attributes:
        pixels: ``(n, 2)`` float32, column and row in the pyramid level times the size of the level.
        responses: ``(n,)`` float32, Harris corner measure.
        angles_deg: ``(n,)`` float32, orientation, clockwise from the x axis.
        octaves: ``(n,)`` int32, level of the pyramid, 0 for the finest.
    """

    pixels: npt.NDArray[np.float32]
    responses: npt.NDArray[np.float32]
    angles_deg: npt.NDArray[np.float32]
    octaves: npt.NDArray[np.int32]

    def select(self, rows: Sequence[int] | slice) -> Keypoints:
        """Return only the keypoints of *rows*, in the order of *rows*."""
        return Keypoints(self.pixels[rows], self.responses[rows], self.angles_deg[rows], self.octaves[rows])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DescribedKeypoints:
    """Keypoints of one image with their descriptors.

    Attributes:
        pixels: ``(n, 2)``, column and row.
        descriptors: ``(n, d)`` of one *kind*.
        orientations: ``(n, 2)``, cosine and sine of each keypoint's angle in the image.
        sizes: ``(n,)``, scale of each keypoint, 1 for the finest pyramid level.
        kind: Name, type and length of the descriptors.
        is_oriented: Whether *orientations* were measured; otherwise they are meaningless.
        is_scaled: Whether *sizes* were measured; otherwise they are meaningless.
    """

    pixels: Array
    descriptors: Descriptors
    orientations: Array
    sizes: Array
    kind: DescriptorKind = ORB
    is_oriented: bool = True
    is_scaled: bool = True


def describe_orb(rgb: npt.NDArray[np.uint8], count: int, *, is_spread: bool = True) -> DescribedKeypoints:
    """Detect and describe ORB features of an image; deterministic.

    Args:
        rgb: ``(h, w, 3)``, red first.
        count: Number of features that are wanted.  With *is_spread*, there are never more.  Otherwise there
            may be: of several keypoints that are equally strong as the weakest selected one of their pyramid
            level, all are returned.
        is_spread: Whether to spread the features over the image as `select_spread_rows` does, which takes
            weak features where a cell has no stronger ones; otherwise the strongest of the image are taken.

    Raises:
        MissingExtra: OpenCV or the native core is not installed.

    Source:
        Rublee et al., "ORB: an efficient alternative to SIFT or SURF", ICCV 2011.  Pyramid scale 1.2 and 8
        levels are the defaults of OpenCV; the FAST threshold is 7 where features are spread, else 10.
    """
    cv2 = load_opencv()
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    detected, threshold = count, _FAST_THRESHOLD
    if is_spread:
        detected, threshold = _DETECTED_PER_FEATURE * count, _FAST_THRESHOLD_SPREAD
    keypoints = detect_keypoints(gray, detected, threshold)
    if keypoints is None:
        keypoints = _detect_by_opencv(cv2, gray, detected, threshold)
    if is_spread and len(keypoints.pixels):
        keypoints = keypoints.select(
            select_spread_rows(keypoints.pixels, keypoints.responses, gray.shape, count)
        )
    keypoints, descriptors = _describe(cv2, gray, keypoints)
    angles = np.radians(keypoints.angles_deg.astype(np.float64))
    sizes = _LEVEL_SIZES[keypoints.octaves]
    return DescribedKeypoints(
        pixels=(keypoints.pixels / sizes[:, None] + 0.5) * _pixels_per_level_pixel(gray, sizes) - 0.5,
        descriptors=descriptors,
        orientations=np.stack([np.cos(angles), np.sin(angles)], axis=1),
        sizes=sizes,
    )


def _pixels_per_level_pixel(gray: npt.NDArray[np.uint8], sizes: Array) -> Array:
    """Return the exact width and height ``(n, 2)`` of a pixel of the pyramid levels of *sizes* ``(n,)``.

    A level has a whole number of pixels, and its corners are those of the image.  OpenCV neglects both where
    it multiplies a column of a level by the level's size: its keypoints of coarse levels lie up to 1.3 px too
    far to the upper left, and approaching a scene by 10 m then turns the camera by a degree.
    """
    extent = np.array(gray.shape[::-1], dtype=np.float64)
    ratios: Array = extent / np.rint(extent / sizes[:, None])
    return ratios


def describe_at(
    rgb: npt.NDArray[np.uint8], pixels: Array, orientations: Array, sizes: Array
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.uint8]]:
    """Compute ORB descriptors at given pixels of an image, whether or not a corner was detected there.

    Args:
        rgb: ``(h, w, 3)``, red first.
        pixels: ``(n, 2)``, column and row.
        orientations: ``(n, 2)``, cosine and sine of the angle of each patch.
        sizes: ``(n,)``, scale of each patch; the nearest level of the pyramid is taken.

    Returns:
        The ``(k,)`` rows of *pixels* that could be described, and their ``(k, 32)`` descriptors.  Pixels near
        the edge of the image cannot be described.  The rows are not always in ascending order.

    Raises:
        MissingExtra: OpenCV is not installed.
    """
    cv2 = load_opencv()
    levels = np.clip(np.rint(np.log(sizes) / np.log(_PYRAMID_SCALE)), 0, _PYRAMID_LEVELS - 1).astype(int)
    angles_deg = np.degrees(np.arctan2(orientations[:, 1], orientations[:, 0])) % 360.0
    nothing = np.empty(0, dtype=np.int64), np.empty((0, ORB.size), dtype=np.uint8)
    if not len(pixels):
        return nothing
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    sizes = _LEVEL_SIZES[levels]
    pixels = ((pixels + 0.5) / _pixels_per_level_pixel(gray, sizes) - 0.5) * sizes[:, None]
    keypoints, descriptors = _describe_by_opencv(cv2, gray, pixels, angles_deg, levels)
    if not keypoints:
        return nothing
    return np.fromiter(map(attrgetter("class_id"), keypoints), np.int64, len(keypoints)), descriptors


def select_spread_rows(pixels: _Floats, responses: _Floats, size: tuple[int, int], count: int) -> list[int]:
    """Select keypoints that are spread over the image.

    The strongest keypoint of every cell of 40 px is taken first, then the second strongest of every cell, and
    so on, until there are *count*.

    Args:
        pixels: ``(n, 2)``, column and row.
        responses: ``(n,)``, strength of each keypoint.
        size: Height and width of the image, in pixels.
        count: Largest number of rows.

    Returns:
        Ascending rows of *pixels*.
    """
    cells_across = -(-size[1] // _CELL_PX)
    cells = (pixels[:, 1] // _CELL_PX * cells_across + pixels[:, 0] // _CELL_PX).astype(np.int64)
    order = np.lexsort((-responses, cells))
    starts = np.flatnonzero(np.concatenate(([True], np.diff(cells[order]) != 0)))
    rank_in_cell = np.arange(len(order)) - np.repeat(starts, np.diff(np.append(starts, len(order))))
    best = order[np.lexsort((-responses[order], rank_in_cell))][:count]
    rows: list[int] = np.sort(best).tolist()
    return rows


class _DetectRequest(ctypes.Structure):
    """The C struct ``rse_pf_detect_request`` of ``rse_pf_match.h``."""

    _fields_ = (
        ("gray", ctypes.c_void_p),
        ("width", ctypes.c_int64),
        ("height", ctypes.c_int64),
        ("scales", ctypes.c_void_p),
        ("wanted", ctypes.c_void_p),
        ("levels", ctypes.c_int32),
        ("threshold", ctypes.c_int32),
        ("room", ctypes.c_int64),
        ("workspace", ctypes.c_void_p),
    )


def detect_keypoints(gray: npt.NDArray[np.uint8], count: int, threshold: int) -> Keypoints | None:
    """Detect ORB's keypoints by the native core.

    Args:
        gray: ``(h, w)``.
        count: Number of keypoints that are wanted.  There may be more: of several keypoints that are equally
            strong as the weakest selected one of their pyramid level, all are returned.
        threshold: Threshold of the FAST corner detector, 0 to 255 grey levels.

    Returns:
        The keypoints, sorted by pyramid level, the finest first.  None, so that the caller uses OpenCV, if
        the processor lacks AVX2, if there are more than ``2 * count + 64`` keypoints because many are equally
        strong, if the order is not known in which OpenCV would return them, or if a side of the image is
        below 2 or above 16,384 px.

    Raises:
        MissingExtra: The native core is not installed.
    """
    gray = aligned(gray)
    height, width = gray.shape
    wanted, capacity = _keypoints_per_level(count), 2 * count + 64
    keypoints = Keypoints(
        np.empty((capacity, 2), dtype=np.float32),
        np.empty(capacity, dtype=np.float32),
        np.empty(capacity, dtype=np.float32),
        np.empty(capacity, dtype=np.int32),
    )
    request = _DetectRequest(
        gray=address_of(gray),
        width=width,
        height=height,
        scales=address_of(_CORE_LEVEL_SIZES),
        wanted=address_of(wanted),
        levels=_PYRAMID_LEVELS,
        threshold=threshold,
        room=capacity,
        workspace=address_of(_WORKSPACE.words(width * height // 2 + 8 * width + height + 64)),
    )
    detect = core_function("match", "rse_pf_detect", (ctypes.c_void_p,) * 5, ctypes.c_int64)
    detected = detect(ctypes.byref(request), *map(address_of, keypoints))
    return None if detected < 0 else keypoints.select(slice(detected))


def describe_keypoints(gray: npt.NDArray[np.uint8], keypoints: Keypoints) -> npt.NDArray[np.uint8] | None:
    """Compute the ``(n, 32)`` ORB descriptors of keypoints of an ``(h, w)`` image by the native core.

    Returns:
        None, so that the caller uses OpenCV, if the processor lacks AVX2 or FMA, a keypoint is nearer than
        22 px to the edge of its pyramid level, or an angle is not finite.

    Raises:
        MissingExtra: The native core is not installed.
    """
    gray, pixels, octaves = aligned(gray), aligned(keypoints.pixels), aligned(keypoints.octaves)
    height, width = gray.shape
    angles = (keypoints.angles_deg * _RADIANS_PER_DEGREE).astype(np.float64)
    # No warning for an angle that is not finite: the native core refuses the request, and None is returned.
    with np.errstate(invalid="ignore"):
        cosines, sines = np.cos(angles).astype(np.float32), np.sin(angles).astype(np.float32)
    descriptors = np.empty((len(pixels), ORB.size), dtype=np.uint8)
    workspace = _WORKSPACE.words(3 * width * height // 8 + 7 * width + 64)
    describe = core_function("match", "rse_pf_describe", _DESCRIBE_ARGUMENTS, ctypes.c_int32)
    refused = describe(
        address_of(gray),
        width,
        height,
        address_of(_CORE_LEVEL_SIZES),
        _PYRAMID_LEVELS,
        *map(address_of, (pixels, cosines, sines, octaves)),
        len(pixels),
        address_of(workspace),
        address_of(descriptors),
    )
    return None if refused else descriptors


@lru_cache(maxsize=16)
def _keypoints_per_level(count: int) -> npt.NDArray[np.int64]:
    """Return how many of *count* keypoints each pyramid level contributes, with the rounding of OpenCV."""
    factor, one = np.float32(1.0 / float(np.float32(_PYRAMID_SCALE))), np.float32(1.0)
    share = np.float32(count) * (one - factor) / (one - np.float32(float(factor) ** _PYRAMID_LEVELS))
    wanted = []
    for _ in range(_PYRAMID_LEVELS - 1):
        wanted.append(int(np.rint(share)))
        share *= factor
    wanted.append(max(0, count - sum(wanted)))
    return np.array(wanted, dtype=np.int64)


def _describe(
    cv2: Any, gray: npt.NDArray[np.uint8], keypoints: Keypoints
) -> tuple[Keypoints, npt.NDArray[np.uint8]]:
    """Return those *keypoints* that can be described, and their ``(k, 32)`` descriptors.

    The native core describes all of them, or OpenCV leaves out those near the edge of the image.
    """
    descriptors = describe_keypoints(gray, keypoints)
    if descriptors is not None:
        return keypoints, descriptors
    if not len(keypoints.pixels):
        return keypoints, np.empty((0, ORB.size), dtype=np.uint8)
    described, descriptors = _describe_by_opencv(
        cv2, gray, keypoints.pixels, keypoints.angles_deg, keypoints.octaves
    )
    return keypoints.select(list(map(attrgetter("class_id"), described))), descriptors


def _make_opencv_orb(cv2: Any, count: int, threshold: int) -> Any:
    return cv2.ORB_create(
        nfeatures=count, scaleFactor=_PYRAMID_SCALE, nlevels=_PYRAMID_LEVELS, fastThreshold=threshold
    )


def _detect_by_opencv(cv2: Any, gray: npt.NDArray[np.uint8], count: int, threshold: int) -> Keypoints:
    keypoints = _make_opencv_orb(cv2, count, threshold).detect(gray, None)
    n = len(keypoints)
    return Keypoints(
        cv2.KeyPoint_convert(keypoints) if n else np.empty((0, 2), dtype=np.float32),
        np.fromiter(map(attrgetter("response"), keypoints), np.float32, n),
        np.fromiter(map(attrgetter("angle"), keypoints), np.float32, n),
        np.fromiter(map(attrgetter("octave"), keypoints), np.int32, n),
    )


def _describe_by_opencv(
    cv2: Any,
    gray: npt.NDArray[np.uint8],
    pixels: npt.NDArray[Any],
    angles_deg: npt.NDArray[Any],
    octaves: npt.NDArray[Any],
) -> tuple[Any, npt.NDArray[np.uint8]]:
    """Return the keypoints that OpenCV could describe, as OpenCV's objects, and their descriptors.

    The ``class_id`` of a keypoint is its row of *pixels*.  Those near the edge of the image are left out.
    """
    keypoints = [
        cv2.KeyPoint(
            float(u), float(v), float(_PATCH_PX * _LEVEL_SIZES[octave]), float(angle), 1.0, int(octave), row
        )
        for row, ((u, v), angle, octave) in enumerate(zip(pixels, angles_deg, octaves, strict=True))
    ]
    described: tuple[Any, npt.NDArray[np.uint8]] = _make_opencv_orb(
        cv2, len(keypoints), _FAST_THRESHOLD
    ).compute(gray, keypoints)
    return described
