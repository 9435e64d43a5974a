"""ORB features of one image, as robots find them and as keyframes hold them.

Every part of the platform that compares an image with keyframes finds its features here.  The native core
finds and describes them.  OpenCV, whose bytes are the same, does so on processors without AVX2 and FMA, and
it describes pixels near the edge of an image.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array
from rse_pf.images import load_opencv
from rse_pf.maps.descriptors import ORB, DescriptorKind, Descriptors
from rse_pf.native import Workspace, address_of, aligned, core_function

__all__ = [
    "DescribedPixels",
    "Keypoints",
    "describe_at",
    "describe_keypoints",
    "describe_orb",
    "detect_keypoints",
    "spread_rows",
]

_Floats = npt.NDArray[np.floating[Any]]

# ORB's pyramid.
_SCALE, _LEVELS = 1.2, 8
_SCALES: Array = np.power(_SCALE, np.arange(_LEVELS, dtype=np.float64))
_CORE_SCALES = np.array([float(np.float32(_SCALE)) ** level for level in range(_LEVELS)], dtype=np.float32)
_FAST, _FAST_SPREAD = 10, 7
_PATCH_PX = 31.0
_SOUGHT, _CELL_PX = 3, 40
"""So many times the features are sought, and spread over cells of this size."""


class Keypoints(NamedTuple):
    """Keypoints of one image in OpenCV's order: all arrays are those of its numbers, row by row.

    ``pixels`` ``(n, 2)`` float32, of the whole image; ``responses`` ``(n,)`` float32, the Harris measure;
    ``angles_deg`` ``(n,)`` float32, the orientation; ``octaves`` ``(n,)`` int32, the level of the pyramid.
    """

    pixels: npt.NDArray[np.float32]
    responses: npt.NDArray[np.float32]
    angles_deg: npt.NDArray[np.float32]
    octaves: npt.NDArray[np.int32]

    def only(self, rows: Sequence[int] | slice) -> Keypoints:
        """Return these rows."""
        return Keypoints(self.pixels[rows], self.responses[rows], self.angles_deg[rows], self.octaves[rows])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DescribedPixels:
    """Keypoints of one image as `Features` has them, without depth."""

    pixels: Array
    descriptors: Descriptors
    turns: Array
    sizes: Array
    kind: DescriptorKind = ORB
    is_oriented: bool = True
    is_scaled: bool = True


def describe_orb(rgb: npt.NDArray[np.uint8], count: int, *, is_spread: bool = True) -> DescribedPixels:
    """Return *count* ORB features of an ``(h, w, 3)`` image; deterministic.

    Args:
        rgb: ``(h, w, 3)``.
        count: The most features.
        is_spread: Take the strongest of each cell of 40 px, with weak ones where there are no others; else
            the strongest of the image.

    Raises:
        MissingExtra: OpenCV or the native core is not installed.

    Source:
        Rublee et al., ICCV 2011; scale 1.2, 8 levels, FAST threshold 7, and 10 where features are not spread.
    """
    cv2 = load_opencv()
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    sought, threshold = (_SOUGHT * count, _FAST_SPREAD) if is_spread else (count, _FAST)
    found = detect_keypoints(gray, sought, threshold)
    if found is None:
        found = _detected_by_opencv(cv2, gray, sought, threshold)
    if is_spread and len(found.pixels):
        found = found.only(spread_rows(found.pixels, found.responses, gray.shape, count))
    found, descriptors = _described(cv2, gray, found)
    angles = np.radians(found.angles_deg.astype(np.float64))
    return DescribedPixels(
        pixels=found.pixels.astype(np.float64),
        descriptors=descriptors,
        turns=np.stack([np.cos(angles), np.sin(angles)], axis=1),
        sizes=_SCALES[found.octaves],
    )


def describe_at(
    rgb: npt.NDArray[np.uint8], pixels: Array, turns: Array, sizes: Array
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.uint8]]:
    """Return the ORB descriptors that an image has at given pixels, whether it has features there or not.

    Args:
        rgb: ``(h, w, 3)``.
        pixels: ``(n, 2)``.
        turns: ``(n, 2)``, cosine and sine of the orientations.
        sizes: ``(n,)``, as `Features` has them; the nearest level of the pyramid is taken.

    Returns:
        The rows that could be described, none of which is near the edge, and ``(k, 32)`` descriptors.

    Raises:
        MissingExtra: OpenCV is not installed.
    """
    cv2 = load_opencv()
    levels = np.clip(np.rint(np.log(sizes) / np.log(_SCALE)), 0, _LEVELS - 1).astype(int)
    angles_deg = np.degrees(np.arctan2(turns[:, 1], turns[:, 0])) % 360.0
    none = np.empty(0, dtype=np.int64), np.empty((0, 32), dtype=np.uint8)
    if not len(pixels):
        return none
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    keypoints, descriptors = _computed(cv2, gray, pixels, angles_deg, levels)
    if not keypoints:
        return none
    return np.fromiter(map(attrgetter("class_id"), keypoints), np.int64, len(keypoints)), descriptors


def spread_rows(pixels: _Floats, responses: _Floats, size: tuple[int, int], count: int) -> list[int]:
    """Return the rows of the strongest keypoints of each cell of the image, *count* in all, ascending.

    Args:
        pixels: ``(n, 2)``.
        responses: ``(n,)``, how strong a keypoint is.
        size: Height and width of the image.
        count: Rows of the first, then the second strongest of all cells, and so on.
    """
    across = -(-size[1] // _CELL_PX)
    cells = (pixels[:, 1] // _CELL_PX * across + pixels[:, 0] // _CELL_PX).astype(np.int64)
    order = np.lexsort((-responses, cells))
    starts = np.flatnonzero(np.concatenate(([True], np.diff(cells[order]) != 0)))
    rank = np.arange(len(order)) - np.repeat(starts, np.diff(np.append(starts, len(order))))
    best = order[np.lexsort((-responses[order], rank))][:count]
    rows: list[int] = np.sort(best).tolist()
    return rows


def _orb(cv2: Any, count: int, threshold: int) -> Any:
    return cv2.ORB_create(nfeatures=count, scaleFactor=_SCALE, nlevels=_LEVELS, fastThreshold=threshold)


class _DetectRequest(ctypes.Structure):
    """``rse_pf_detect_request`` of ``rse_pf_match.h``."""

    _fields_ = (
        ("gray", ctypes.c_void_p), ("width", ctypes.c_int64), ("height", ctypes.c_int64),
        ("scales", ctypes.c_void_p), ("wanted", ctypes.c_void_p), ("levels", ctypes.c_int32),
        ("threshold", ctypes.c_int32), ("room", ctypes.c_int64), ("workspace", ctypes.c_void_p),
    )  # fmt: skip


def detect_keypoints(gray: npt.NDArray[np.uint8], count: int, threshold: int) -> Keypoints | None:
    """Return ORB's keypoints as the native core finds them.

    Args:
        gray: ``(h, w)``.
        count: The most keypoints; those that equal the last one are returned as well.
        threshold: FAST's, 0 to 255.

    Returns:
        None where the processor lacks AVX2, where more than twice as many equal each other, or where a side
        of the image is below 2 or above 16,384 px.

    Raises:
        MissingExtra: The native core is not installed.
    """
    gray = aligned(gray)
    height, width = gray.shape
    wanted, room = _wanted(count), 2 * count + 64
    found = Keypoints(
        np.empty((room, 2), dtype=np.float32), np.empty(room, dtype=np.float32),
        np.empty(room, dtype=np.float32), np.empty(room, dtype=np.int32),
    )  # fmt: skip
    request = _DetectRequest(
        address_of(gray), width, height, address_of(_CORE_SCALES), address_of(wanted), _LEVELS, threshold,
        room, address_of(_WORKSPACE.words(width * height // 2 + 8 * width + height + 64)),
    )  # fmt: skip
    rows = _detect()(ctypes.byref(request), *map(address_of, found))
    return None if rows < 0 else found.only(slice(rows))


def describe_keypoints(gray: npt.NDArray[np.uint8], keypoints: Keypoints) -> npt.NDArray[np.uint8] | None:
    """Return ORB's ``(n, 32)`` descriptors of keypoints of an ``(h, w)`` image by the native core.

    Returns:
        None where the processor lacks AVX2 or FMA, or a keypoint is nearer than 22 px to the edge of its
        level.

    Raises:
        MissingExtra: The native core is not installed.
    """
    gray, pixels, octaves = aligned(gray), aligned(keypoints.pixels), aligned(keypoints.octaves)
    height, width = gray.shape
    angles = (keypoints.angles_deg * _RADIANS).astype(np.float64)
    with np.errstate(invalid="ignore"):  # the library refuses what is not finite
        cosines, sines = np.cos(angles).astype(np.float32), np.sin(angles).astype(np.float32)
    descriptors = np.empty((len(pixels), ORB.size), dtype=np.uint8)
    workspace = _WORKSPACE.words(3 * width * height // 8 + 7 * width + 64)
    refused = _describe()(
        address_of(gray), width, height, address_of(_CORE_SCALES), _LEVELS, address_of(pixels),
        address_of(cosines), address_of(sines), address_of(octaves), len(pixels), address_of(workspace),
        address_of(descriptors),
    )  # fmt: skip
    return None if refused else descriptors


_WORKSPACE = Workspace()
_RADIANS = np.float32(math.pi / 180)


@cache
def _detect() -> Any:
    return core_function("match", "rse_pf_detect", (ctypes.c_void_p,) * 5, ctypes.c_int64)


@cache
def _describe() -> Any:
    pointer, size, count = ctypes.c_void_p, ctypes.c_int64, ctypes.c_int32
    arguments = (pointer, size, size, pointer, count, *[pointer] * 4, size, pointer, pointer)
    return core_function("match", "rse_pf_describe", arguments, count)


@lru_cache(maxsize=16)
def _wanted(count: int) -> npt.NDArray[np.int64]:
    """Return how many keypoints each level gives, in the shares and with the rounding of OpenCV."""
    factor, one = np.float32(1.0 / float(np.float32(_SCALE))), np.float32(1.0)
    share = np.float32(count) * (one - factor) / (one - np.float32(float(factor) ** _LEVELS))
    wanted = []
    for _ in range(_LEVELS - 1):
        wanted.append(int(np.rint(share)))
        share *= factor
    wanted.append(max(0, count - sum(wanted)))
    return np.array(wanted, dtype=np.int64)


def _detected_by_opencv(cv2: Any, gray: npt.NDArray[np.uint8], count: int, threshold: int) -> Keypoints:
    keypoints = _orb(cv2, count, threshold).detect(gray, None)
    n = len(keypoints)
    return Keypoints(
        cv2.KeyPoint_convert(keypoints) if n else np.empty((0, 2), dtype=np.float32),
        np.fromiter(map(attrgetter("response"), keypoints), np.float32, n),
        np.fromiter(map(attrgetter("angle"), keypoints), np.float32, n),
        np.fromiter(map(attrgetter("octave"), keypoints), np.int32, n),
    )


def _described(
    cv2: Any, gray: npt.NDArray[np.uint8], found: Keypoints
) -> tuple[Keypoints, npt.NDArray[np.uint8]]:
    """Return the keypoints that can be described, and their descriptors."""
    descriptors = describe_keypoints(gray, found)
    if descriptors is not None:
        return found, descriptors
    if not len(found.pixels):
        return found, np.empty((0, 32), dtype=np.uint8)
    keypoints, descriptors = _computed(cv2, gray, found.pixels, found.angles_deg, found.octaves)
    return found.only(list(map(attrgetter("class_id"), keypoints))), descriptors


def _computed(
    cv2: Any, gray: npt.NDArray[np.uint8], pixels: npt.NDArray[Any], angles_deg: npt.NDArray[Any],
    octaves: npt.NDArray[Any],
) -> tuple[Any, npt.NDArray[np.uint8]]:  # fmt: skip
    """Return OpenCV's keypoints that it can describe, the class of each of which is its row."""
    keypoints = [
        cv2.KeyPoint(
            float(u), float(v), float(_PATCH_PX * _SCALES[octave]), float(angle), 1.0, int(octave), row
        )
        for row, ((u, v), angle, octave) in enumerate(zip(pixels, angles_deg, octaves, strict=True))
    ]
    computed: tuple[Any, npt.NDArray[np.uint8]] = _orb(cv2, len(keypoints), _FAST).compute(gray, keypoints)
    return computed
