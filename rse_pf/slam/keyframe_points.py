"""The thinned coloured points of a keyframe, which a robot stores as an object beside it.

A keyframe holds an `ObjectReference` to them.  They are pixels with depths, so that whatever the bytes say
lies in front of the keyframe's camera, within its image and within 65 m.

Little-endian: ``KP``, version 1 (uint8), 0 (uint8), number n (uint32); then with zlib, each as planes of
bytes: the steps from pixel to pixel, counted row by row (n uint32), the steps from depth to depth in mm
(n uint16, modulo 2**16), and those of red, green and blue (3 times n uint8, modulo 2**8).
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
    "MAX_IMAGE_BYTES",
    "MAX_POINTS",
    "MAX_POINTS_BYTES",
    "REFERENCE_BYTES",
    "ObjectReference",
    "decode_points",
    "decode_reference",
    "encode_points",
    "encode_reference",
]

MAX_POINTS = 16_000
MAX_POINTS_BYTES = 160_000
MAX_IMAGE_BYTES = 1 << 20
_HEAD = struct.Struct("<2sBBI")
_MAGIC, _VERSION = b"KP", 1
_POINT_BYTES = 9
_NEAREST_MM, _FARTHEST_MM = 10, 65_535
_REFERENCE = struct.Struct("<32sI")
REFERENCE_BYTES = _REFERENCE.size
_DIGEST = re.compile(r"[0-9a-f]{64}\Z")


@dataclass(frozen=True, slots=True)
class ObjectReference:
    """An object of the robot that made the keyframe: the sha256 of its bytes, in hex, and their number.

    Raises:
        BadRequest: It is no sha256, or the object is empty or too large.
    """

    digest: str
    size: int

    def __post_init__(self) -> None:
        if not _DIGEST.match(self.digest) or not 0 < self.size <= MAX_IMAGE_BYTES:
            raise BadRequest(
                f"an object of {self.size} bytes belongs to no keyframe",
                hint=f"refer to 1..{MAX_IMAGE_BYTES} bytes by their sha256",
            )


def encode_reference(reference: ObjectReference) -> bytes:
    """Return the content of the block of a keyframe: 32 bytes of sha256, and the size (uint32)."""
    return _REFERENCE.pack(bytes.fromhex(reference.digest), reference.size)


def decode_reference(data: bytes) -> ObjectReference:
    """Return what `encode_reference` encoded; raises BadRequest."""
    if len(data) != REFERENCE_BYTES:
        raise BadRequest(
            f"the keyframe is refused: a reference has {REFERENCE_BYTES} bytes, not {len(data)}",
            hint="send what encode_keyframe returned",
        )
    digest, size = _REFERENCE.unpack(data)
    return ObjectReference(digest.hex(), size)


def encode_points(
    pixels: npt.NDArray[np.int64], depths_m: npt.NDArray[np.floating], colours: Colours, camera: Camera
) -> bytes:
    """Return points as the bytes of an object, in the order of their pixels, each pixel once.

    Args:
        pixels: ``(n, 2)`` columns and rows within the image, undistorted; the first of a pixel is kept, and
            of more than `MAX_POINTS` an even share.
        depths_m: ``(n,)`` along the optical axis; those not within 0.01..65 m are left out.
        colours: ``(n, 3)``.
        camera: Of the keyframe.
    """
    with np.errstate(invalid="ignore"):
        steps_mm = np.rint(np.asarray(depths_m, dtype=np.float64) * 1000.0)
        usable = np.flatnonzero((steps_mm >= _NEAREST_MM) & (steps_mm <= _FARTHEST_MM))
    places, first = np.unique(pixels[usable, 1] * camera.width + pixels[usable, 0], return_index=True)
    if len(places) > MAX_POINTS:
        even = np.linspace(0, len(places) - 1, MAX_POINTS).astype(np.int64)
        places, first = places[even], first[even]
    rows = usable[first]
    planes = [
        _planes(_steps(places), "<u4"),
        _planes(_steps(steps_mm[rows].astype(np.int64)), "<u2"),
        *(_planes(_steps(colours[rows, channel].astype(np.int64)), "u1") for channel in range(3)),
    ]
    return _HEAD.pack(_MAGIC, _VERSION, 0, len(rows)) + zlib.compress(b"".join(planes), 6)


def decode_points(data: bytes, camera: Camera) -> tuple[Array, Colours]:
    """Return ``(n, 3)`` points in metres in the frame of *camera*, and ``(n, 3)`` uint8 colours.

    Raises:
        BadRequest: The bytes are too many or malformed, hold more than `MAX_POINTS`, or points outside the
            image.
    """
    if not _HEAD.size <= len(data) <= MAX_POINTS_BYTES:
        raise _refusal(f"{len(data)} bytes are not within {_HEAD.size}..{MAX_POINTS_BYTES}")
    magic, version, zero, n = _HEAD.unpack_from(data)
    if (magic, version, zero) != (_MAGIC, _VERSION, 0):
        raise _refusal("they do not begin as points of version 1")
    if n > MAX_POINTS:
        raise _refusal(f"{n} points are above {MAX_POINTS}")
    inflate, size = zlib.decompressobj(), n * _POINT_BYTES
    try:
        raw = inflate.decompress(data[_HEAD.size :], size + 1)
    except zlib.error as error:
        raise _refusal("they are damaged") from error
    if len(raw) != size or not inflate.eof or inflate.unused_data:
        raise _refusal(f"they are not {n} points")
    places = np.cumsum(_numbers(raw, 0, n, "<u4"))
    if n and (places[-1] >= camera.width * camera.height or (np.diff(places) <= 0).any()):
        raise _refusal("a pixel lies outside the image, or stands twice")
    steps_mm = np.cumsum(_numbers(raw, 4 * n, n, "<u2")) & 0xFFFF
    if n and steps_mm.min() < _NEAREST_MM:
        raise _refusal(f"a depth is below {_NEAREST_MM} mm")
    colours = np.stack(
        [np.cumsum(_numbers(raw, (6 + channel) * n, n, "u1")) & 0xFF for channel in range(3)], axis=1
    )
    pixels = np.column_stack((places % camera.width, places // camera.width)).astype(np.float64)
    return camera.back_project(pixels, steps_mm / 1000.0), colours.astype(np.uint8)


def _steps(numbers: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    return np.diff(numbers, prepend=np.int64(0))


def _planes(numbers: npt.NDArray[np.int64], dtype: str) -> bytes:
    """Return numbers, modulo what *dtype* holds, as all lowest bytes, then all next ones."""
    kind = np.dtype(dtype)
    wrapped = (numbers & ((1 << (8 * kind.itemsize)) - 1)).astype(kind)
    planes: bytes = wrapped.view(np.uint8).reshape(-1, kind.itemsize).T.tobytes()
    return planes


def _numbers(raw: bytes, begin: int, n: int, dtype: str) -> npt.NDArray[np.int64]:
    """Return the *n* numbers whose planes begin there."""
    kind = np.dtype(dtype)
    planes = np.frombuffer(raw, dtype=np.uint8, count=n * kind.itemsize, offset=begin)
    columns = np.ascontiguousarray(planes.reshape(kind.itemsize, n).T)
    return columns.view(kind).reshape(n).astype(np.int64)


def _refusal(why: str) -> BadRequest:
    return BadRequest(f"the points are refused: {why}", hint="send what encode_points returned")
