"""Load OpenCV, and decode images that may be untrusted.

`decode_photo` checks the structure and the stated size of a JPEG or PNG before it decodes pixels.
"""

from __future__ import annotations

import os
import re
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest, LimitExceeded, MissingExtra

__all__ = ["MAX_IMAGE_PIXELS", "MAX_PHOTO_PIXELS", "decode_photo", "load_opencv", "photo_size", "read_image"]

MAX_IMAGE_PIXELS = 1 << 25
"""Largest number of pixels of an image that OpenCV decodes: a frame of 8K video has slightly fewer, and takes
some 200 MB of memory."""
MAX_PHOTO_PIXELS = 1 << 24
"""Largest number of pixels of an image that a client sends to a server: 16 megapixels."""
_OPENCV_LIMIT_VARIABLE = "OPENCV_IO_MAX_IMAGE_PIXELS"
"""Environment variable with the most pixels of an image that OpenCV decodes; read when OpenCV is loaded."""
_JPEG = b"\xff\xd8\xff"  # first bytes of each JPEG file
_PNG = b"\x89PNG\r\n\x1a\n"  # first bytes of each PNG file
_MAX_SEGMENTS = 1000  # segments of a JPEG that are searched for its size
_FILL_BYTES = re.compile(rb"\xff*(?=\xff)")  # padding that a JPEG may have before each marker
_MAX_CHUNKS = 10_000  # chunks of a PNG: programs write pixels in chunks of 8 KiB and more
_CRITICAL_CHUNKS = (b"IHDR", b"PLTE", b"IDAT", b"IEND")  # chunks that a decoder of PNG needs for the pixels
_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # by the colour type of a PNG: channels of each pixel
_MAX_PNG_BYTES = 5 * MAX_PHOTO_PIXELS  # inflated pixels of a PNG: four channels of 8 bits, and filter bytes
_EXTRA_ROW_BYTES = 4  # the filter bytes and the last bits of a row in all seven passes of an interlaced PNG
_MAX_SCANS = 20
"""Most scans of a JPEG.  Decoding a scan of a progressive JPEG costs time for the whole image, even if the
scan has few bytes; cameras write ten scans."""
_FRAMES = range(0xC0, 0xD0)  # second bytes of JPEG markers; segments with these state the size of the image
_NO_FRAMES = (0xC4, 0xC8, 0xCC)  # exceptions in `_FRAMES`: segments with these state no size
_DECODED_FRAMES = (0xC0, 0xC1, 0xC2)
"""Second bytes of the JPEG markers of the accepted codings: baseline, extended and progressive Huffman."""
_SCAN = b"\xff\xda"  # marker at the start of each scan of a JPEG
_END_OF_JPEG = b"\xff\xd9"  # marker at the end of a JPEG
_END_OF_PNG = b"IEND"  # name of the last chunk of a PNG
_LONGEST_TRAILER = 1 << 16  # bytes that some programs write after the end of a PNG
_HINT = "send a JPEG or PNG file as a camera writes it"


def load_opencv() -> Any:
    """Return the module ``cv2``, which decodes no image above `MAX_IMAGE_PIXELS`; raises MissingExtra.

    The limit does not hold if the program has imported ``cv2`` before.  If the environment variable
    ``OPENCV_IO_MAX_IMAGE_PIXELS`` is set already, its limit holds instead.
    """
    os.environ.setdefault(_OPENCV_LIMIT_VARIABLE, str(MAX_IMAGE_PIXELS))
    try:
        import cv2
    except ImportError as error:
        raise MissingExtra("opencv-python-headless", "vision") from error
    return cv2


def read_image(path: Path, flags: int) -> npt.NDArray[Any] | None:
    """Return the image in the file *path* as OpenCV decodes it with *flags* (``cv2.IMREAD_...``).

    None if the file cannot be read, is damaged or cut off, or has more than `MAX_IMAGE_PIXELS`.  The image is
    not rotated by an orientation in its EXIF data, so that the intrinsics and the depth of the camera fit.

    Raises:
        MissingExtra: OpenCV is not installed.
    """
    cv2 = load_opencv()
    if not path.is_file():  # reading a pipe would wait for its writer
        return None
    try:
        data = path.read_bytes()
        if not data or _is_cut_off(data):
            return None
        image: npt.NDArray[Any] | None = cv2.imdecode(
            np.frombuffer(data, dtype=np.uint8),
            flags if flags == cv2.IMREAD_UNCHANGED else flags | cv2.IMREAD_IGNORE_ORIENTATION,
        )
    except (OSError, cv2.error):
        return None
    return image


def _is_cut_off(data: bytes) -> bool:
    """Return whether a JPEG or PNG has no end: OpenCV would fill the missing pixels with grey.

    False for a file of another format.
    """
    if data.startswith(_JPEG):
        return data.rfind(_END_OF_JPEG) < max(0, data.rfind(_SCAN))
    return data.startswith(_PNG) and _END_OF_PNG not in data[-_LONGEST_TRAILER:]


def photo_size(data: bytes) -> tuple[int, int]:
    """Return the width and the height in pixels that the head of a JPEG or PNG states; decode no pixels.

    Raises:
        BadRequest: *data* is neither JPEG nor PNG, is incomplete, states a size of 0, or has a coding that no
            camera writes, such as an animation.
        LimitExceeded: The image has more than `MAX_PHOTO_PIXELS`, or too many scans or chunks.

    Source:
        ITU-T T.81, Annex B; W3C PNG, Sect. 5 and 11.2.2.
    """
    if data.startswith(_JPEG):
        width, height = _jpeg_size(data)
    elif data.startswith(_PNG):
        width, height = _png_size(data)
    else:
        raise BadRequest("the image is neither JPEG nor PNG", hint=_HINT)
    if not width or not height:
        raise BadRequest(f"an image of {width}x{height} px has no pixels", hint=_HINT)
    if width * height > MAX_PHOTO_PIXELS:
        raise LimitExceeded(
            f"an image of {width}x{height} px is above {MAX_PHOTO_PIXELS} pixels",
            hint="make it smaller, and scale fx fy cx cy with it",
        )
    return width, height


def decode_photo(data: bytes) -> npt.NDArray[np.uint8]:
    """Return the RGB image ``(height, width, 3)`` of a JPEG or PNG.

    The image is not rotated by an orientation in its EXIF data, so that the intrinsics of the camera fit.

    Raises:
        BadRequest: As for `photo_size`, or the pixels are damaged.
        LimitExceeded: As for `photo_size`.
        MissingExtra: OpenCV is not installed.
    """
    width, height = photo_size(data)
    if data.startswith(_PNG):
        data = _critical_png(data)
    cv2 = load_opencv()
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags)
    except cv2.error:
        image = None
    if image is None or image.shape != (height, width, 3):
        raise BadRequest("the image is damaged", hint=_HINT)
    rgb: npt.NDArray[np.uint8] = cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
    return rgb


def _jpeg_size(data: bytes) -> tuple[int, int]:
    if data.count(_SCAN) > _MAX_SCANS:
        raise LimitExceeded(f"the image has more than {_MAX_SCANS} scans", hint=_HINT)
    if data.rfind(_END_OF_JPEG) < data.rfind(_SCAN):
        raise BadRequest("the image has no end", hint=_HINT)
    for kind, body in _jpeg_segments(data):
        if kind in _FRAMES and kind not in _NO_FRAMES:
            if kind not in _DECODED_FRAMES or len(body) < 6 or body[0] != 8 or body[5] not in (1, 3):
                raise BadRequest("the image is no JPEG of 8 bits in grey or colour", hint=_HINT)
            return int.from_bytes(body[3:5], "big"), int.from_bytes(body[1:3], "big")
        if kind == _SCAN[1]:
            break
    raise BadRequest("the image does not state its size", hint=_HINT)


def _jpeg_segments(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield the marker (second byte) and the content of each segment at the start of a JPEG.

    Ends without an error after `_MAX_SEGMENTS`, or at a segment that is damaged or incomplete.
    """
    at = 2
    for _ in range(_MAX_SEGMENTS):
        fill = _FILL_BYTES.match(data, at)
        at = at if fill is None else fill.end()
        length = int.from_bytes(data[at + 2 : at + 4], "big")
        if data[at : at + 1] != b"\xff" or length < 2 or at + 2 + length > len(data):
            return
        yield data[at + 1], data[at + 4 : at + 2 + length]
        at += 2 + length


def _png_size(data: bytes) -> tuple[int, int]:
    size, has_pixels = (0, 0), False
    for number, (name, chunk) in enumerate(_png_chunks(data)):
        if (number == 0) != (name == b"IHDR"):
            break
        if name == b"IHDR":
            if len(chunk) != 25:
                break
            size = int.from_bytes(chunk[8:12], "big"), int.from_bytes(chunk[12:16], "big")
        elif name == b"acTL":
            raise BadRequest("the image is animated", hint=_HINT)
        has_pixels = has_pixels or name == b"IDAT"
    else:
        if has_pixels:
            return size
    raise BadRequest("the image does not state its size, or has no pixels", hint=_HINT)


def _png_chunks(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Yield the name and all bytes of each chunk of a PNG up to ``IEND``; bytes after ``IEND`` are ignored.

    Raises:
        BadRequest: The data end within a chunk, or before ``IEND``.
        LimitExceeded: The PNG has more than `_MAX_CHUNKS`.
    """
    at = len(_PNG)
    for _ in range(_MAX_CHUNKS):
        end = at + 12 + int.from_bytes(data[at : at + 4], "big")
        if end > len(data):
            raise BadRequest("the image has no end", hint=_HINT)
        name = data[at + 4 : at + 8]
        yield name, data[at:end]
        if name == b"IEND":
            return
        at = end
    raise LimitExceeded(f"the image has more than {_MAX_CHUNKS} chunks", hint=_HINT)


def _critical_png(data: bytes) -> bytes:
    """Return a PNG with its critical chunks only: libpng would inflate other chunks, or print warnings.

    Raises:
        BadRequest: Its pixels are damaged, or inflate to more bytes than the size in its head allows.
    """
    chunks = [chunk for name, chunk in _png_chunks(data) if name in _CRITICAL_CHUNKS]
    width, height, bits, colour = struct.unpack_from(">IIBB", chunks[0], 8)
    row_bytes = _EXTRA_ROW_BYTES + (width * bits * _CHANNELS.get(colour, 0) + 7) // 8
    max_bytes = min(height * row_bytes, _MAX_PNG_BYTES)
    packed = b"".join(chunk[8:-4] for chunk in chunks if chunk[4:8] == b"IDAT")
    try:
        inflated = zlib.decompressobj().decompress(packed, max_bytes + 1)
    except zlib.error:
        raise BadRequest("the image is damaged", hint=_HINT) from None
    if len(inflated) > max_bytes:
        raise BadRequest(f"the pixels of the image are above {max_bytes} bytes", hint=_HINT)
    return b"".join((_PNG, *chunks))
