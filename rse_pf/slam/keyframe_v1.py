"""Read the keyframes of protocol version 1, and of the logs, snapshots and spools of that time.

Their features were bytes of their own, beside a pose and a camera: one byte of version, one byte *f* (pixels
count in units of ``2**-f``), the number *n* as uint16; *n* columns, *n* rows and *n* depths (mm) as uint16,
and *n* descriptors of 32 bytes; all little-endian.  Nothing writes this form any more.
"""

from __future__ import annotations

import struct

import numpy as np

from rse_pf.errors import BadRequest
from rse_pf.geometry import Array, Camera, rigid
from rse_pf.slam.keyframe import MAX_FEATURES, Keyframe, KeyframeFeatures, decode_keyframe, encode_keyframe

__all__ = ["MAX_FEATURES_BYTES", "CameraNumbers", "keyframe_of_v1"]

MAX_FEATURES_BYTES = 34_000
"""Size of the features of one keyframe of version 1."""
CameraNumbers = tuple[float, float, float, float, int, int]
"""fx fy cx cy (pixels), width, height."""
_VERSION = 1
_HEAD = struct.Struct("<BBH")
_DESCRIPTOR_BYTES = 32
_FEATURE_BYTES = 2 + 2 + 2 + _DESCRIPTOR_BYTES
_FINEST, _COARSEST = 4, 2


def keyframe_of_v1(timestamp_s: float, T_odom_camera: Array, camera: Camera, features: bytes) -> bytes:
    """Return the bytes of the keyframe whose parts version 1 held; pixels and depths are the same numbers.

    Args:
        timestamp_s: Seconds since 1970.
        T_odom_camera: ``(4, 4)``, metres.
        camera: Which took the image.
        features: In the form of version 1.

    Raises:
        BadRequest: A part is malformed, as `decode_keyframe` says.
    """
    T_rigid = rigid(T_odom_camera)
    if T_rigid is None:
        raise BadRequest(
            "T_odom_camera is no pose: it takes 16 numbers of a rotation and a translation",
            hint="send it row after row with at least three decimals, the last row 0 0 0 1",
        )
    keyframe = Keyframe(
        timestamp_s=timestamp_s, T_odom_camera=T_rigid, camera=camera, features=_decoded(features)
    )  # fmt: skip
    data = encode_keyframe(keyframe)
    decode_keyframe(data)
    return data


def _decoded(data: bytes) -> KeyframeFeatures:
    if not _HEAD.size <= len(data) <= MAX_FEATURES_BYTES:
        raise _refusal(f"{len(data)} bytes are not within {_HEAD.size}..{MAX_FEATURES_BYTES}")
    version, fraction, n = _HEAD.unpack_from(data)
    if version != _VERSION or not _COARSEST <= fraction <= _FINEST:
        raise _refusal(f"version {version} with pixels in 2**-{fraction} is not known")
    if n > MAX_FEATURES or len(data) != _HEAD.size + n * _FEATURE_BYTES:
        raise _refusal(f"{len(data)} bytes are not {n} features of {_FEATURE_BYTES} bytes")
    numbers = np.frombuffer(data, dtype="<u2", count=3 * n, offset=_HEAD.size).reshape(3, n)
    descriptors = np.frombuffer(data, dtype=np.uint8, offset=_HEAD.size + 6 * n)
    return KeyframeFeatures(
        pixels=(numbers[:2].T * np.float32(2.0**-fraction)).astype(np.float32),
        depths_m=(numbers[2] / 1000.0).astype(np.float32),
        descriptors=descriptors.reshape(n, _DESCRIPTOR_BYTES),
    )


def _refusal(why: str) -> BadRequest:
    return BadRequest(
        f"the features of the keyframe: {why}", hint="send keyframes of version 2: see docs/protocol.md"
    )
