"""Decode the images of ROS messages: RGB with 8 bits, and depth in metres.

The functions are pure, and read no files.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from client_sdk.bags.bag_file import BrokenMessage
from client_sdk.bags.message_types import COMPRESSED_IMAGE
from rse_pf.errors import RsePfError
from rse_pf.images import load_opencv, photo_size

__all__ = ["ImageFormat", "check_image", "decode_colour", "decode_depth", "format_of"]

_COLOUR_ENCODINGS = {
    "rgb8": (3, None), "bgr8": (3, "BGR2RGB"), "rgba8": (4, "RGBA2RGB"), "bgra8": (4, "BGRA2RGB"),
    "8UC3": (3, "BGR2RGB"), "8UC4": (4, "BGRA2RGB"),
    "mono8": (1, "GRAY2RGB"), "8UC1": (1, "GRAY2RGB"),
    "bayer_rggb8": (1, "BayerRGGB2RGB"), "bayer_bggr8": (1, "BayerBGGR2RGB"),
    "bayer_gbrg8": (1, "BayerGBRG2RGB"), "bayer_grbg8": (1, "BayerGRBG2RGB"),
    "yuv422": (2, "YUV2RGB_UYVY"), "uyvy": (2, "YUV2RGB_UYVY"),
    "yuv422_yuy2": (2, "YUV2RGB_YUY2"), "yuyv": (2, "YUV2RGB_YUY2"),
}  # fmt: skip
"""Encodings of colour images, each with the bytes of a pixel and OpenCV's conversion to RGB (None for
RGB)."""
# Encodings of depth images, and the numpy types of their pixels.
_DEPTH_ENCODINGS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}

_JPEG = b"\xff\xd8"  # first bytes of a JPEG image
_PNG = b"\x89PNG\r\n\x1a\n"  # first bytes of a PNG image
# Head of an image of compressed_depth_image_transport: its format, and the parameters a and b of the
# quantisation of floats.
_COMPRESSED_DEPTH_HEADER = struct.Struct("<iff")
_NO_READING = 65535
"""Value with which some recorders mark a pixel without a reading in a 16-bit depth image; it is read as 0."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageFormat:
    """The format of the images of a topic.

    Attributes:
        holds: ``colour`` or ``depth``; empty for images that cannot be decoded.
        encoding: Encoding of a raw image, or format of a compressed one, as the message states it.
        frame: Name of the camera's frame.
        size: Width and height, px; None if a compressed image does not state them.
    """

    holds: Literal["colour", "depth", ""]
    encoding: str
    frame: str
    size: tuple[int, int] | None


def format_of(message: Any, kind: str) -> ImageFormat:
    """Return the format of an image message of the type *kind*, without decoding the image."""
    holds: Literal["colour", "depth", ""] = ""
    if kind != COMPRESSED_IMAGE:
        encoding = str(message.encoding)
        if encoding in _COLOUR_ENCODINGS:
            holds = "colour"
        elif encoding in _DEPTH_ENCODINGS:
            holds = "depth"
        size = (int(message.width), int(message.height))
        return ImageFormat(holds=holds, encoding=encoding, frame=message.header.frame_id, size=size)
    encoding = str(message.format)
    data = message.data.tobytes()
    if "compressedDepth" in encoding:
        if "rvl" not in encoding.lower():
            holds = "depth"
        data = data[_COMPRESSED_DEPTH_HEADER.size :]
    elif data.startswith(_JPEG):
        holds = "colour"
    elif data.startswith(_PNG):
        # Bytes 24 and 25 of a PNG are bits per channel and colour type: grey of 16 bits is depth.
        holds = "depth" if data[24:26] == b"\x10\x00" else "colour"
    return ImageFormat(
        holds=holds, encoding=encoding or "no format", frame=message.header.frame_id, size=_coded_size(data)
    )


def check_image(message: Any, expected: ImageFormat) -> None:
    """Check an image message, without decoding it, against the format of the first image of its topic.

    Raises:
        BrokenMessage: The image is truncated or damaged, or has another size or encoding.
    """
    if hasattr(message, "encoding"):
        if (message.width, message.height) != expected.size or message.encoding != expected.encoding:
            raise BrokenMessage(
                f"an image is {message.width}x{message.height} {message.encoding}, unlike the first image"
            )
        _rows(message)
        return
    data = message.data.tobytes()
    if "compressedDepth" in expected.encoding:
        data = data[_COMPRESSED_DEPTH_HEADER.size :]
    if data.startswith(_JPEG):
        if b"\xff\xd9" not in data[-64:]:
            raise BrokenMessage("a JPEG image is cut off")
    elif data.startswith(_PNG):
        _check_png(data)
    else:
        raise BrokenMessage("an image is neither JPEG nor PNG")
    size = _coded_size(data)
    if size is not None and expected.size is not None and size != expected.size:
        raise BrokenMessage(f"an image is {size[0]}x{size[1]}, unlike the first image")


def decode_colour(message: Any) -> npt.NDArray[np.uint8]:
    """Return the RGB image ``(h, w, 3)`` of a message.

    Raises:
        BrokenMessage: The image cannot be decoded.
        MissingExtra: OpenCV is not installed.
    """
    cv2 = load_opencv()
    if not hasattr(message, "encoding"):
        image = _decode(cv2, np.asarray(message.data), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        rgb: npt.NDArray[np.uint8] = cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
        return rgb
    bytes_per_px, conversion = _COLOUR_ENCODINGS[message.encoding]
    rows = _rows(message)
    pixels = rows.reshape(message.height, message.width, bytes_per_px)
    if conversion is None:
        return np.ascontiguousarray(pixels)
    try:
        converted: npt.NDArray[np.uint8] = cv2.cvtColor(pixels, getattr(cv2, f"COLOR_{conversion}"))
    except cv2.error as error:
        raise BrokenMessage(f"an image of {message.width}x{message.height} px cannot be converted") from error
    return converted


def decode_depth(message: Any, depth_scale: float) -> npt.NDArray[np.float32]:
    """Return the depth image ``(h, w)`` of a message, metres, 0 for pixels without a reading.

    16-bit values are divided by *depth_scale* (units per metre); 32-bit floats are metres.

    Raises:
        BrokenMessage: The image cannot be decoded.
        MissingExtra: OpenCV is not installed.
    """
    if hasattr(message, "encoding"):
        kind = np.dtype(_DEPTH_ENCODINGS[message.encoding]).newbyteorder(">" if message.is_bigendian else "<")
        values = _rows(message).view(kind)
        return _metres_of_floats(values) if kind.kind == "f" else _metres_of_units(values, depth_scale)
    cv2 = load_opencv()
    data = np.asarray(message.data)
    is_quantised, a, b = False, 0.0, 0.0
    if "compressedDepth" in message.format:
        if len(data) < _COMPRESSED_DEPTH_HEADER.size:
            raise BrokenMessage("a compressed depth image is cut off")
        _, a, b = _COMPRESSED_DEPTH_HEADER.unpack(data[: _COMPRESSED_DEPTH_HEADER.size].tobytes())
        data = data[_COMPRESSED_DEPTH_HEADER.size :]
        is_quantised = message.format.startswith("32FC1")
    image = _decode(cv2, data, cv2.IMREAD_UNCHANGED)
    if image.ndim != 2 or image.dtype != np.uint16:
        raise BrokenMessage("a depth image does not hold 16 bits of one channel")
    if not is_quantised:
        return _metres_of_units(image, depth_scale)
    # compressed_depth_image_transport stores a / depth + b, and 0 for a pixel without a reading.
    inverse = image.astype(np.float32) - np.float32(b)
    with np.errstate(divide="ignore", invalid="ignore"):
        return _metres_of_floats(np.where(image > 0, np.float32(a) / inverse, np.float32(0)))


def _decode(cv2: Any, data: npt.NDArray[np.uint8], flags: int) -> npt.NDArray[Any]:
    try:
        image: npt.NDArray[Any] | None = cv2.imdecode(data, flags)
    except cv2.error as error:
        raise BrokenMessage("an image cannot be decoded") from error
    if image is None:
        raise BrokenMessage("an image cannot be decoded")
    return image


def _rows(message: Any) -> npt.NDArray[np.uint8]:
    """Return the rows ``(h, bytes)`` of a raw image without padding; raises BrokenMessage if too short."""
    encoding = message.encoding
    bytes_per_px = (
        _COLOUR_ENCODINGS[encoding][0]
        if encoding in _COLOUR_ENCODINGS
        else np.dtype(_DEPTH_ENCODINGS[encoding]).itemsize
    )
    used, height, step = message.width * bytes_per_px, message.height, message.step
    if not used or not height or step < used or len(message.data) < step * height:
        raise BrokenMessage(
            f"an image of {message.width}x{height} px has {len(message.data)} bytes in rows of {step} bytes: "
            "not enough for the image"
        )
    rows: npt.NDArray[np.uint8] = message.data[: step * height].reshape(height, step)
    return rows if step == used else np.ascontiguousarray(rows[:, :used])


def _metres_of_units(values: npt.NDArray[Any], depth_scale: float) -> npt.NDArray[np.float32]:
    metres: npt.NDArray[np.float32] = values.astype(np.float32) / np.float32(depth_scale)
    metres[values == _NO_READING] = 0.0
    return metres


def _metres_of_floats(values: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
    metres = values.astype(np.float32)
    metres[~(np.isfinite(metres) & (metres > 0))] = 0.0
    return metres


def _coded_size(data: bytes) -> tuple[int, int] | None:
    """Return width and height, px, that a JPEG or PNG image states; None if the head is invalid."""
    try:
        return photo_size(data)
    except RsePfError:
        return None


def _check_png(data: bytes) -> None:
    """Verify the checksums of all chunks of a PNG image, which takes a tenth of the time of decoding it.

    Raises BrokenMessage if the image is damaged or truncated.
    """
    place = len(_PNG)
    while place + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, place)
        end = place + 8 + length
        if end + 4 > len(data):
            break
        if zlib.crc32(data[place + 4 : end]) != struct.unpack_from(">I", data, end)[0]:
            raise BrokenMessage("a PNG image is damaged")
        if data[place + 4 : place + 8] == b"IEND":
            return
        place = end + 4
    raise BrokenMessage("a PNG image is cut off")
