"""The visual front end in the native core: ORB keypoints and descriptors, their points, and matches.

The library is the one that `rse_pf.native` finds; without it, or with an older one, the front end does the
same work in numpy and OpenCV, with the same numbers.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Sequence
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array, Camera
from rse_pf.native import address_of, aligned, load_core, load_part
from rse_pf.native_matcher import MATCH_ABI, Lanes, MatchCore, Workspace, open_matcher

__all__ = ["FrontEndCore", "Keypoints", "front_end_core", "open_front_end"]

_BYTES = 32
_RADIANS = np.float32(math.pi / 180)
# Of the library, which refuses a level of this scale.
_MOST_SCALE, _MOST_LEVELS, _MOST_ROWS = 1e4, 32, 1 << 20


class Keypoints(NamedTuple):
    """Keypoints of one image, as OpenCV has them: all arrays are those of its numbers, row by row.

    ``pixels`` ``(n, 2)`` float32, of the whole image; ``responses`` ``(n,)`` float32, how strong they are;
    ``angles_deg`` ``(n,)`` float32, how they are turned; ``octaves`` ``(n,)`` int32, the levels that they
    were found in.
    """

    pixels: npt.NDArray[np.float32]
    responses: npt.NDArray[np.float32]
    angles_deg: npt.NDArray[np.float32]
    octaves: npt.NDArray[np.int32]

    def only(self, rows: Sequence[int] | slice) -> Keypoints:
        """Return these rows."""
        return Keypoints(self.pixels[rows], self.responses[rows], self.angles_deg[rows], self.octaves[rows])


class _DetectRequest(ctypes.Structure):
    """``rse_pf_detect_request`` of ``rse_pf_match.h``."""

    _fields_ = (
        ("gray", ctypes.c_void_p), ("width", ctypes.c_int64), ("height", ctypes.c_int64),
        ("scales", ctypes.c_void_p), ("wanted", ctypes.c_void_p), ("levels", ctypes.c_int32),
        ("threshold", ctypes.c_int32), ("room", ctypes.c_int64), ("workspace", ctypes.c_void_p),
    )  # fmt: skip


class FrontEndCore:
    """The front end of one loaded library; every thread may call it."""

    def __init__(
        self,
        detect: Callable[..., int],
        describe: Callable[..., int],
        points_at: Callable[..., int],
        matcher: MatchCore,
    ) -> None:
        self._detect = detect
        self._describe = describe
        self._points_at = points_at
        self.matches = matcher.matches
        self._workspace = Workspace()

    def detect(
        self, gray: npt.NDArray[np.uint8], count: int, *, scale: float, levels: int, threshold: int
    ) -> Keypoints | None:
        """Return ORB's keypoints in OpenCV's order, bit by bit its own.

        Args:
            gray: ``(h, w)``.
            count: How many are sought; those that equal the last one come beside it.
            scale: From one level to the next.
            levels: Of the pyramid.
            threshold: FAST's, up to 255.

        Returns:
            None where the processor lacks AVX2, more than twice as many equal each other, or the arguments
            are not of these shapes and numbers.
        """
        is_fine = _is(gray, np.uint8, 2) and 1.0 <= scale < _MOST_SCALE and 1 <= levels <= _MOST_LEVELS
        if not is_fine or not 0 <= count <= _MOST_ROWS:
            return None
        gray = aligned(gray)
        height, width = gray.shape
        scales, wanted, room = _scales(scale, levels), _wanted(count, scale, levels), 2 * count + 64
        found = Keypoints(
            np.empty((room, 2), dtype=np.float32), np.empty(room, dtype=np.float32),
            np.empty(room, dtype=np.float32), np.empty(room, dtype=np.int32),
        )  # fmt: skip
        workspace = self._workspace.words(width * height // 2 + 8 * width + height + 64)
        request = _DetectRequest(
            address_of(gray), width, height, address_of(scales), address_of(wanted), levels, threshold, room,
            address_of(workspace),
        )  # fmt: skip
        rows = self._detect(ctypes.byref(request), *map(address_of, found))
        return None if rows < 0 else found.only(slice(rows))

    def describe(
        self,
        gray: npt.NDArray[np.uint8],
        pixels: npt.NDArray[np.float32],
        angles_deg: npt.NDArray[np.float32],
        octaves: npt.NDArray[np.int32],
        *,
        scale: float,
        levels: int,
    ) -> npt.NDArray[np.uint8] | None:
        """Return ORB's descriptors of keypoints, bit by bit those of OpenCV.

        Args:
            gray: ``(h, w)``.
            pixels: ``(n, 2)``, where OpenCV found the keypoints.
            angles_deg: ``(n,)``, how they are turned.
            octaves: ``(n,)``, the levels that they were found in.
            scale: From one level to the next.
            levels: Of the pyramid.

        Returns:
            ``(n, 32)``; None where the processor lacks AVX2 or FMA, a keypoint is nearer than 22 px to the
            edge of its level, or the arrays are not of these shapes and numbers.
        """
        n = len(pixels)
        if not (
            _is(gray, np.uint8, 2) and _is(pixels, np.float32, 2) and pixels.shape == (n, 2)
            and _is(angles_deg, np.float32, 1) and _is(octaves, np.int32, 1)
            and len(angles_deg) == len(octaves) == n
            and 1.0 <= scale < _MOST_SCALE and 1 <= levels <= _MOST_LEVELS
        ):  # fmt: skip
            return None
        gray, pixels, octaves = aligned(gray), aligned(pixels), aligned(octaves)
        height, width = gray.shape
        turned = (angles_deg * _RADIANS).astype(np.float64)
        with np.errstate(invalid="ignore"):  # what is not finite, the library refuses
            cosines, sines = np.cos(turned).astype(np.float32), np.sin(turned).astype(np.float32)
        scales = _scales(scale, levels)
        descriptors = np.empty((n, _BYTES), dtype=np.uint8)
        workspace = self._workspace.words(3 * width * height // 8 + 7 * width + 64)
        done = self._describe(
            address_of(gray), width, height, address_of(scales), levels, address_of(pixels),
            address_of(cosines), address_of(sines), address_of(octaves), n, address_of(workspace),
            address_of(descriptors),
        )  # fmt: skip
        return None if done < 0 else descriptors

    def points_at(
        self,
        depth_m: npt.NDArray[np.float32],
        pixels: Array,
        camera: Camera,
        *,
        min_depth_m: float,
        max_depth_m: float,
        spread: float,
    ) -> Array | None:
        """Return the points of the camera frame that are seen at pixels.

        Args:
            depth_m: ``(h, w)``, metres along the optical axis, 0 where there is no reading.
            pixels: ``(n, 2)``; the depth of one is the median of its 3x3 patch.
            camera: Intrinsics of the depth image.
            min_depth_m: A median below is not trusted.
            max_depth_m: A median above is not trusted.
            spread: Nor is a patch whose depths differ by more than this share of their median.

        Returns:
            ``(n, 3)`` metres, NaN where the depth cannot be trusted; None where the arrays are not float32
            and float64 of these shapes.
        """
        if not (_is(depth_m, np.float32, 2) and _is(pixels, np.float64, 2) and pixels.shape[1] == 2):
            return None
        depth_m, pixels = aligned(depth_m), aligned(pixels)
        points_camera = np.empty((len(pixels), 3))
        height, width = depth_m.shape
        done = self._points_at(
            address_of(depth_m), width, height, address_of(pixels), len(pixels),
            camera.fx, camera.fy, camera.cx, camera.cy, min_depth_m, max_depth_m, spread,
            address_of(points_camera),
        )  # fmt: skip
        return None if done < 0 else points_camera


@lru_cache(maxsize=16)
def _scales(scale: float, levels: int) -> npt.NDArray[np.float32]:
    """Return the scale of each level of a pyramid."""
    powers = (float(np.float32(scale)) ** level for level in range(levels))
    return np.array([min(power, _MOST_SCALE) for power in powers], dtype=np.float32)


@lru_cache(maxsize=16)
def _wanted(count: int, scale: float, levels: int) -> npt.NDArray[np.int64]:
    """Return how many keypoints each level gives, in the shares and with the rounding of OpenCV."""
    factor = np.float32(1.0 / float(np.float32(scale)))
    one = np.float32(1.0)
    share = one / np.float32(levels)
    if factor < one:
        share = (one - factor) / (one - np.float32(float(factor) ** levels))
    share = np.float32(count) * share
    wanted = []
    for _ in range(levels - 1):
        wanted.append(int(np.rint(share)))
        share *= factor
    wanted.append(max(0, count - sum(wanted)))
    return np.array(wanted, dtype=np.int64)


def _is(array: npt.NDArray[Any], kind: type, dimensions: int) -> bool:
    return array.dtype == kind and array.ndim == dimensions


def open_front_end(path: Path, lanes: Lanes = "avx512") -> FrontEndCore:
    """Load the library at *path*; *lanes* are the widest instructions it may use.

    Raises:
        ConfigurationError: As `load_part` says.
    """
    detect, describe, points_at = load_part(
        path, "match", MATCH_ABI, "rse_pf_detect", "rse_pf_describe", "rse_pf_points_at"
    )
    pointer, size, number = ctypes.c_void_p, ctypes.c_int64, ctypes.c_double
    detect.argtypes, detect.restype = (pointer,) * 5, size
    describe.argtypes = (
        pointer, size, size, pointer, ctypes.c_int32, *[pointer] * 4, size, pointer, pointer
    )  # fmt: skip
    describe.restype = ctypes.c_int32
    points_at.argtypes = (pointer, size, size, pointer, size, *[number] * 7, pointer)
    points_at.restype = ctypes.c_int32
    return FrontEndCore(detect, describe, points_at, open_matcher(path, lanes))


@cache
def front_end_core() -> FrontEndCore:
    """Return the front end of the native core, which is required."""
    return load_core(open_front_end)
