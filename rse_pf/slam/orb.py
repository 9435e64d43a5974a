"""ORB features of one image, as robots find them and as keyframes hold them.

Every part of the platform that compares an image with keyframes finds its features here.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from operator import attrgetter
from typing import Any

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array
from rse_pf.images import load_opencv
from rse_pf.maps.descriptors import ORB, DescriptorKind, Descriptors
from rse_pf.native_front_end import FrontEndCore, Keypoints, front_end_core

__all__ = ["DescribedPixels", "describe_at", "describe_orb", "spread_rows"]

_Floats = npt.NDArray[np.floating[Any]]

# ORB's pyramid.
_SCALE, _LEVELS = 1.2, 8
_SCALES: Array = np.power(_SCALE, np.arange(_LEVELS, dtype=np.float64))
_FAST, _FAST_SPREAD = 10, 7
_PATCH_PX = 31.0
_SOUGHT, _CELL_PX = 3, 40
"""So many times the features are sought, and spread over cells of this size."""


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
        MissingExtra: OpenCV is not installed.

    Source:
        Rublee et al., ICCV 2011; scale 1.2, 8 levels, FAST threshold 7, and 10 where features are not spread.
    """
    cv2 = load_opencv()
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    sought, threshold = (_SOUGHT * count, _FAST_SPREAD) if is_spread else (count, _FAST)
    found = _detected(cv2, gray, sought, threshold)
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


def _detected(cv2: Any, gray: npt.NDArray[np.uint8], count: int, threshold: int) -> Keypoints:
    core = front_end_core()
    found = None
    if core is not None and _is_alike(core)[0]:
        found = core.detect(gray, count, scale=_SCALE, levels=_LEVELS, threshold=threshold)
    return _detected_by_opencv(cv2, gray, count, threshold) if found is None else found


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
    core = front_end_core()
    descriptors = None
    if core is not None and _is_alike(core)[1]:
        descriptors = core.describe(
            gray, found.pixels, found.angles_deg, found.octaves, scale=_SCALE, levels=_LEVELS
        )
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


@cache
def _is_alike(core: FrontEndCore) -> tuple[bool, bool]:
    """Say whether the core detects and describes as the installed OpenCV, which may be another version."""
    cv2 = load_opencv()
    blocks = np.random.default_rng(1).integers(0, 256, (60, 80))
    gray = np.kron(blocks, np.ones((5, 5))).astype(np.uint8)
    expected = _detected_by_opencv(cv2, gray, 500, _FAST)
    found = core.detect(gray, 500, scale=_SCALE, levels=_LEVELS, threshold=_FAST)
    is_found = found is not None and all(map(np.array_equal, found, expected))
    _, descriptors = _computed(cv2, gray, expected.pixels, expected.angles_deg, expected.octaves)
    ours = core.describe(
        gray, expected.pixels, expected.angles_deg, expected.octaves, scale=_SCALE, levels=_LEVELS
    )
    return is_found, ours is not None and bool(np.array_equal(ours, descriptors))
