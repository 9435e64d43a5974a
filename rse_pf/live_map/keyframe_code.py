"""The features of a keyframe as bytes: pixels, depths and binary descriptors, never more than 34,000 bytes.

Only features with depth are kept, since only they can be placed.  Sizes are judged before an array is made.

Format: one byte of version, one byte *f* (pixels count in units of ``2**-f``), the number of features *n* as
uint16; then *n* columns, *n* rows and *n* depths (mm) as uint16, and *n* descriptors of 32 bytes; all
little-endian.
"""

from __future__ import annotations

import struct

import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest
from rse_pf.geometry import Camera
from rse_pf.slam.keyframe import KeyframeFeatures

__all__ = ["MAX_FEATURES", "MAX_FEATURES_BYTES", "KeyframeFeatures", "decode_features", "encode_features"]

MAX_FEATURES_BYTES = 34_000
"""Of one keyframe."""
_VERSION = 1
_HEAD = struct.Struct("<BBH")
_DESCRIPTOR_BYTES = 32
_FEATURE_BYTES = 2 + 2 + 2 + _DESCRIPTOR_BYTES
MAX_FEATURES = (MAX_FEATURES_BYTES - _HEAD.size) // _FEATURE_BYTES
"""Of one keyframe."""
_FINEST, _COARSEST = 4, 2
_NEAREST_MM, _FARTHEST_MM = 10, 65_535
_BORDER_PX = 64
"""Undistorted pixels may lie so far beyond the image."""


def encode_features(
    pixels: npt.NDArray[np.floating],
    depths_m: npt.NDArray[np.floating],
    descriptors: npt.NDArray[np.uint8],
) -> bytes:
    """Return the features of a keyframe as bytes; rows without a usable depth are left out.

    Pixels are rounded to 1/16 px (images wider than 4,095 px: 1/8, 1/4), depths to 1 mm.  Where there are too
    many features, the first are kept: ORB gives those of the finest level first, which keep most links.

    Args:
        pixels: ``(n, 2)``, undistorted; rows outside 0..16383 px are left out.
        depths_m: ``(n,)`` metres along the optical axis; not finite or out of 0.01..65 m: none.
        descriptors: ``(n, 32)``.

    Raises:
        BadRequest: The shapes do not fit.
    """
    n = len(depths_m)
    if pixels.shape != (n, 2) or depths_m.shape != (n,) or descriptors.shape != (n, _DESCRIPTOR_BYTES):
        raise BadRequest(
            f"pixels {pixels.shape}, depths_m {depths_m.shape}, descriptors {descriptors.shape} do not fit",
            hint="give one row for each feature",
        )
    with np.errstate(invalid="ignore", over="ignore"):
        depths_mm = np.rint(np.asarray(depths_m, dtype=np.float64) * 1000.0)
        largest_px = pixels.max(axis=1, initial=-1.0)
        usable = (depths_mm >= _NEAREST_MM) & (depths_mm <= _FARTHEST_MM)
        usable &= (pixels.min(axis=1, initial=np.inf) >= 0.0) & (largest_px <= _largest_px(_COARSEST))
    rows = np.flatnonzero(usable)[:MAX_FEATURES]
    widest_px = float(largest_px[rows].max(initial=0.0))
    fraction = next(f for f in range(_FINEST, _COARSEST - 1, -1) if widest_px <= _largest_px(f))
    units = np.rint(pixels[rows].astype(np.float64) * 2.0**fraction).astype("<u2")
    return b"".join(
        (
            _HEAD.pack(_VERSION, fraction, len(rows)), units[:, 0].tobytes(), units[:, 1].tobytes(),
            depths_mm[rows].astype("<u2").tobytes(), descriptors[rows].astype(np.uint8).tobytes(),
        )
    )  # fmt: skip


def decode_features(data: bytes, camera: Camera) -> KeyframeFeatures:
    """Return the features that `encode_features` encoded, of an image of *camera*.

    Raises:
        BadRequest: The bytes are too many or malformed, or a feature lies outside the image.
    """
    if not _HEAD.size <= len(data) <= MAX_FEATURES_BYTES:
        raise _refused(f"{len(data)} bytes are not within {_HEAD.size}..{MAX_FEATURES_BYTES}")
    version, fraction, n = _HEAD.unpack_from(data)
    if version != _VERSION or not _COARSEST <= fraction <= _FINEST:
        raise _refused(f"version {version} with pixels in 2**-{fraction} is not known")
    if len(data) != _HEAD.size + n * _FEATURE_BYTES:
        raise _refused(f"{len(data)} bytes are not {n} features of {_FEATURE_BYTES} bytes")
    numbers = np.frombuffer(data, dtype="<u2", count=3 * n, offset=_HEAD.size).reshape(3, n)
    pixels = (numbers[:2].T * np.float32(2.0**-fraction)).astype(np.float32)
    depths_mm = numbers[2]
    if n and (pixels.max(axis=0) > (camera.width + _BORDER_PX, camera.height + _BORDER_PX)).any():
        raise _refused(f"a pixel lies outside the image of {camera.width}x{camera.height} px")
    if n and depths_mm.min() < _NEAREST_MM:
        raise _refused(f"a depth is below {_NEAREST_MM} mm")
    descriptors = np.frombuffer(data, dtype=np.uint8, offset=_HEAD.size + 6 * n)
    return KeyframeFeatures(
        pixels=pixels,
        depths_m=(depths_mm / 1000.0).astype(np.float32),
        descriptors=descriptors.reshape(n, _DESCRIPTOR_BYTES),
    )


def _largest_px(fraction: int) -> float:
    """Return the largest pixel that uint16 holds in units of ``2**-fraction``."""
    return 65_535 / 2.0**fraction


def _refused(why: str) -> BadRequest:
    return BadRequest(f"the features of the keyframe: {why}", hint="send what encode_features returned")
