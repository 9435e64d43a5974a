"""Encode the thinned coloured points of a keyframe, which a robot stores as an object of their own.

A keyframe holds an `ObjectReference` to this object.  The points are pixels with depths, so that malformed or
false bytes can only give points that lie in the image of the keyframe's camera and within 65.535 m of it.

The object is little-endian: ``KP``, version 1 (uint8), 0 (uint8), number of points n (uint32); then,
compressed by zlib, five arrays of n differences.  The points are sorted by the index of their pixel, counted
row by row, and a difference is the number of a point minus that of the previous point (0 for the first): of
the index (uint32), of the depth in mm (uint16, modulo 2**16), and of red, green and blue (uint8 each, modulo
2**8).  An array is stored as planes of bytes: first the lowest byte of all its numbers, then the second byte
of all, and so on.
"""

from __future__ import annotations

import re
import struct
import zlib
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest
from rse_pf.geometry import Array, Camera
from rse_pf.slam.ply import Colours

__all__ = [
    "MAX_OBJECT_BYTES",
    "MAX_POINTS",
    "MAX_POINTS_BYTES",
    "REFERENCE_BYTES",
    "ObjectReference",
    "decode_points",
    "decode_reference",
    "encode_points",
    "encode_reference",
]

# Largest number of coloured points of one keyframe; the encoder takes an even selection of more points, and
# the decoder refuses an object with more.
MAX_POINTS = 16_000
MAX_POINTS_BYTES = 160_000
"""Largest size in bytes of the object with the coloured points of one keyframe.  16,000 points have 144,008
bytes without compression (8 of the head, 9 for each point), so that the limit refuses no valid object."""
MAX_OBJECT_BYTES = 1 << 20
"""Largest size in bytes of an object to which a keyframe may refer, its image or its coloured points: 1 MiB.
A reference that states more is refused."""
_HEAD_STRUCT = struct.Struct("<2sBBI")
_REFERENCE_STRUCT = struct.Struct("<32sI")
REFERENCE_BYTES = _REFERENCE_STRUCT.size  # size in bytes of an encoded reference to an object
_MAGIC = b"KP"  # the first two bytes of the points of a keyframe
_VERSION = 1  # version of the encoding of coloured points, the only one that is read and written
_POINT_BYTES = 9  # size in bytes of an uncompressed point: index 4, depth 2, colour 3
_MIN_DEPTH_MM = 10
"""Smallest depth in millimetres of a coloured point: a nearer point is not encoded, and encoded points with a
nearer one are refused."""
_MAX_DEPTH_MM = 65_535  # largest depth in millimetres that a uint16 holds; a farther point is not encoded
_DIGEST = re.compile(r"[0-9a-f]{64}\Z")


@dataclass(frozen=True, slots=True)
class ObjectReference:
    """A reference to an object that the robot of a keyframe has stored: its points, or its image.

    Attributes:
        digest: The sha256 of the object's bytes, 64 hexadecimal digits in lower case.
        size: The number of the object's bytes, from 1 to 2**20.

    Raises:
        BadRequest: *digest* is no sha256, or *size* is out of its range.
    """

    digest: str
    size: int

    def __post_init__(self) -> None:
        if not _DIGEST.match(self.digest) or not 0 < self.size <= MAX_OBJECT_BYTES:
            raise BadRequest(
                f"a reference to an object has a size of {self.size} bytes, not of 1..{MAX_OBJECT_BYTES}, or "
                "a digest that is no sha256 in 64 lower-case hexadecimal digits",
                hint="send the size and the sha256 of the object's bytes",
            )


def encode_reference(reference: ObjectReference) -> bytes:
    """Return *reference* as 36 bytes: 32 bytes of sha256, and the size (uint32)."""
    return _REFERENCE_STRUCT.pack(bytes.fromhex(reference.digest), reference.size)


def decode_reference(data: bytes) -> ObjectReference:
    """Return the reference that `encode_reference` encoded; raises BadRequest if *data* is malformed."""
    if len(data) != REFERENCE_BYTES:
        raise BadRequest(
            f"the keyframe is refused: a reference has {REFERENCE_BYTES} bytes, not {len(data)}",
            hint="send what encode_keyframe returned",
        )
    digest, size = _REFERENCE_STRUCT.unpack(data)
    return ObjectReference(digest.hex(), size)


def encode_points(
    pixels: npt.NDArray[np.int64], depths_m: npt.NDArray[np.floating], colours: Colours, camera: Camera
) -> bytes:
    """Return coloured points as the bytes of an object, sorted by their pixels.

    Of several points at one pixel the first is encoded, and of more than 16,000 pixels an even selection of
    16,000.

    Args:
        pixels: ``(n, 2)`` columns and rows within the image, undistorted.
        depths_m: ``(n,)`` along the optical axis; points that are not within 0.01..65.535 m are left out.
        colours: ``(n, 3)``.
        camera: The camera of the keyframe; only its width is used, and no pixel is checked.
    """
    # 1. Keep points whose depth can be encoded, one at each pixel.
    with np.errstate(invalid="ignore"):
        depths_mm = np.rint(np.asarray(depths_m, dtype=np.float64) * 1000.0)
        usable = np.flatnonzero((depths_mm >= _MIN_DEPTH_MM) & (depths_mm <= _MAX_DEPTH_MM))
    indices, first = np.unique(pixels[usable, 1] * camera.width + pixels[usable, 0], return_index=True)
    # 2. Of more than `MAX_POINTS` points take an even selection.
    if len(indices) > MAX_POINTS:
        even = np.linspace(0, len(indices) - 1, MAX_POINTS).astype(np.int64)
        indices, first = indices[even], first[even]
    rows = usable[first]
    # 3. Encode the differences between neighbours, which compress well.
    planes = [
        _encode_planes(_differences(indices), "<u4"),
        _encode_planes(_differences(depths_mm[rows].astype(np.int64)), "<u2"),
        *(_encode_planes(_differences(colours[rows, i].astype(np.int64)), "u1") for i in range(3)),
    ]
    return _HEAD_STRUCT.pack(_MAGIC, _VERSION, 0, len(rows)) + zlib.compress(b"".join(planes), 6)


def decode_points(data: bytes, camera: Camera) -> tuple[Array, Colours]:
    """Return points ``(n, 3)`` in metres in the frame of *camera*, and their colours ``(n, 3)``.

    *camera* must be that of the keyframe, with which the points were encoded.

    Raises:
        BadRequest: *data* is longer than 160,000 bytes or malformed, holds more than 16,000 points, or a
            point outside the image or nearer than 10 mm.
    """
    # 1. Check the head, and decompress no more bytes than the stated number of points has.
    if not _HEAD_STRUCT.size <= len(data) <= MAX_POINTS_BYTES:
        raise _bad_points(f"{len(data)} bytes are not within {_HEAD_STRUCT.size}..{MAX_POINTS_BYTES}")
    magic, version, zero, n = _HEAD_STRUCT.unpack_from(data)
    if (magic, version, zero) != (_MAGIC, _VERSION, 0):
        raise _bad_points("they do not begin as points of version 1")
    if n > MAX_POINTS:
        raise _bad_points(f"{n} points are above {MAX_POINTS}")
    decompressor, size = zlib.decompressobj(), n * _POINT_BYTES
    try:
        raw = decompressor.decompress(data[_HEAD_STRUCT.size :], size + 1)
    except zlib.error as error:
        raise _bad_points("they are damaged") from error
    if len(raw) != size or not decompressor.eof or decompressor.unused_data:
        raise _bad_points(f"they are not {n} points")
    # 2. Sum the differences up to pixels, depths and colours, and check pixels and depths.
    indices = np.cumsum(_decode_planes(raw, 0, n, "<u4"))
    if n and (indices[-1] >= camera.width * camera.height or (np.diff(indices) <= 0).any()):
        raise _bad_points("a pixel lies outside the image, or occurs twice")
    depths_mm = np.cumsum(_decode_planes(raw, 4 * n, n, "<u2")) & 0xFFFF
    if n and depths_mm.min() < _MIN_DEPTH_MM:
        raise _bad_points(f"a depth is below {_MIN_DEPTH_MM} mm")
    colours = np.stack(
        [np.cumsum(_decode_planes(raw, (6 + i) * n, n, "u1")) & 0xFF for i in range(3)], axis=1
    )
    # 3. Back-project the pixels with their depths to points.
    pixels = np.column_stack((indices % camera.width, indices // camera.width)).astype(np.float64)
    return camera.back_project(pixels, depths_mm / 1000.0), colours.astype(np.uint8)


def _differences(numbers: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    return np.diff(numbers, prepend=np.int64(0))


def _encode_planes(numbers: npt.NDArray[np.int64], dtype: str) -> bytes:
    """Return numbers modulo the range of *dtype*: the lowest bytes of all numbers, then the second bytes."""
    integer = np.dtype(dtype)
    wrapped = (numbers & ((1 << (8 * integer.itemsize)) - 1)).astype(integer)
    planes: bytes = wrapped.view(np.uint8).reshape(-1, integer.itemsize).T.tobytes()
    return planes


def _decode_planes(raw: bytes, begin: int, n: int, dtype: str) -> npt.NDArray[np.int64]:
    """Return the *n* numbers whose planes begin at the byte *begin* of *raw*."""
    integer = np.dtype(dtype)
    planes = np.frombuffer(raw, dtype=np.uint8, count=n * integer.itemsize, offset=begin)
    columns = np.ascontiguousarray(planes.reshape(integer.itemsize, n).T)
    return columns.view(integer).reshape(n).astype(np.int64)


def _bad_points(reason: str) -> BadRequest:
    return BadRequest(f"the points are refused: {reason}", hint="send what encode_points returned")
