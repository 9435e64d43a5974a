"""Images that a stranger may send: bombs, damaged files, other formats, and what only looks like a photo."""

from __future__ import annotations

import struct
import zlib

import cv2
import numpy as np

__all__ = ["HARMLESS", "chunk", "hostile_images", "photo", "png"]

HARMLESS = (
    "jpeg of random bits", "jpeg that says to be larger", "jpeg without huffman", "png and a zip",
    "png with a text bomb", "png with a profile bomb", "jpeg of one pixel",
    "png of one pixel",
)  # fmt: skip
"""Begin the names of those that may be decoded: they are images, but show no place."""


def photo(width: int = 640, height: int = 480, kind: str = ".jpg") -> bytes:
    """Return a picture of blocks."""
    blocks = np.random.default_rng(1).integers(0, 256, (height // 8, width // 8, 3)).astype(np.uint8)
    image = np.kron(blocks, np.ones((8, 8, 1), dtype=np.uint8))
    return bytes(cv2.imencode(kind, image)[1])


def chunk(name: bytes, data: bytes) -> bytes:
    """Return a chunk of a PNG."""
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def png(
    width: int = 64, height: int = 48, *, bits: int = 8, colour: int = 2, method: int = 0, interlace: int = 0,
    before: bytes = b"", pixels: bytes | None = None, head: bytes | None = None,
) -> bytes:  # fmt: skip
    """Return a PNG whose parts may be wrong."""
    fields = struct.pack(
        ">IIBBBBB", width & 0xFFFFFFFF, height & 0xFFFFFFFF, bits, colour, method, 0, interlace
    )
    rows = zlib.compress(bytes((1 + 3 * 64) * 48)) if pixels is None else pixels
    first = chunk(b"IHDR", fields) if head is None else head
    return b"\x89PNG\r\n\x1a\n" + first + before + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def with_frame(data: bytes, **changed: int) -> bytes:
    """Return a JPEG whose frame header says something else."""
    at = data.index(b"\xff\xc0")
    kind, precision = changed.get("kind", 0xC0), changed.get("precision", 8)
    height, width = struct.unpack(">HH", data[at + 5 : at + 9])
    size = struct.pack(">HH", changed.get("height", height), changed.get("width", width))
    parts = changed.get("components", data[at + 9])
    return data[:at] + bytes((0xFF, kind)) + data[at + 2 : at + 4] + bytes((precision,)) + size + bytes(
        (parts,)
    ) + data[at + 10 :]  # fmt: skip


def hostile_images() -> dict[str, bytes]:
    """Return them by name; the same each time."""
    jpeg, rng = photo(), np.random.default_rng(2)
    frame, scan = jpeg.index(b"\xff\xc0"), jpeg.index(b"\xff\xda")
    segment = b"\xff\xe5\x00\x04ab"
    bomb = zlib.compress(bytes(1 << 28), 9)
    progressive = bytes(
        cv2.imencode(".jpg", np.zeros((4000, 4000), np.uint8), (cv2.IMWRITE_JPEG_PROGRESSIVE, 1))[1]
    )
    last = progressive.rindex(b"\xff\xda")
    others = {
        "no bytes": b"", "one byte": b"\xff", "text": b"not an image\n" * 100, "html": b"<html><img src=x>",
        "svg": b"<svg xmlns='http://www.w3.org/2000/svg' width='1e9' height='1e9'/>", "pdf": b"%PDF-1.7\n",
        "zip": b"PK\x03\x04" + bytes(100), "program": b"\x7fELF" + bytes(100), "gif": b"GIF89a" + bytes(100),
        "avif": b"\0\0\0\x1cftypavif" + bytes(100), "jxl": b"\xff\x0a" + bytes(100),
        "exr": b"v/1\x01" + bytes(100), "hdr": b"#?RADIANCE\n" + bytes(100), "nothing but zeros": bytes(5000),
        **{kind: photo(64, 48, f".{kind}") for kind in ("bmp", "webp", "tiff", "ppm", "jp2")},
    }  # fmt: skip
    jpegs = {
        "jpeg that only begins": jpeg[:3], "jpeg that ends at once": b"\xff\xd8\xff\xd9",
        **{f"jpeg of {share} percent": jpeg[: len(jpeg) * share // 100] for share in (1, 5, 20, 50, 90, 99)},
        "jpeg of 65535x65535": with_frame(jpeg, width=65535, height=65535),
        "jpeg of 65535x257": with_frame(jpeg, width=65535, height=257),
        "jpeg of no width": with_frame(jpeg, width=0), "jpeg of no height": with_frame(jpeg, height=0),
        "jpeg of 12 bits": with_frame(jpeg, precision=12), "jpeg without loss": with_frame(jpeg, kind=0xC3),
        "jpeg in a hierarchy": with_frame(jpeg, kind=0xC5), "arithmetic jpeg": with_frame(jpeg, kind=0xC9),
        "jpeg of two colours": with_frame(jpeg, components=2),
        "jpeg of four colours": with_frame(jpeg, components=4),
        "jpeg of 255 colours": with_frame(jpeg, components=255),
        "jpeg without a frame": jpeg[:frame] + jpeg[scan:],
        "jpeg whose frame comes late": jpeg[:2] + jpeg[scan:-2] + jpeg[frame:scan] + jpeg[-2:],
        "jpeg of a thousand segments": jpeg[:2] + segment * 1001 + jpeg[2:],
        "jpeg of a million segments": jpeg[:2] + b"\xff\xe5\x00\x02" * 1_000_000 + jpeg[2:],
        "jpeg with a segment of no length": jpeg[:2] + b"\xff\xe5\x00\x00" + jpeg[2:],
        "jpeg with a segment of length one": jpeg[:2] + b"\xff\xe5\x00\x01" + jpeg[2:],
        "jpeg with a segment beyond the end": jpeg[:2] + b"\xff\xe5\xff\xff" + jpeg[2:500] + b"\xff\xd9",
        "jpeg of zeros behind its head": jpeg[:4] + bytes(5000) + b"\xff\xd9",
        "jpeg of many scans": progressive[:last] + progressive[last:-2] * 20 + progressive[-2:],
        "jpeg of ten thousand scans": progressive[:last] + progressive[last:][:40] * 10_000 + b"\xff\xd9",
        "jpeg of random bits": jpeg[: scan + 14] + rng.bytes(20_000).replace(b"\xff", b"\xfe") + b"\xff\xd9",
        "jpeg that says to be larger": with_frame(jpeg, width=4000, height=4000),
        "jpeg without huffman tables": jpeg.replace(b"\xff\xc4", b"\xff\xe5"),
        "jpeg without tables": jpeg.replace(b"\xff\xdb", b"\xff\xe5"),
        "jpeg of two frames": jpeg[:frame] + jpeg[frame:scan] * 2 + jpeg[scan:],
        "jpeg of one pixel": bytes(cv2.imencode(".jpg", np.zeros((1, 1), np.uint8))[1]),
    }  # fmt: skip
    tables = b"".join(chunk(b"tEXt", b"a\0b") for _ in range(10_000))
    pngs = {
        "png that only begins": png()[:8], "png of half a head": png()[:20],
        "png without a head": png(head=b""),
        "png with a short head": png(head=chunk(b"IHDR", bytes(12))),
        "png with a long head": png(head=chunk(b"IHDR", bytes(200))), "png of no size": png(0, 0),
        "png of no height": png(64, 0), "png of 100000x100000": png(100_000, 100_000),
        "png of 2^31 pixels a row": png(1 << 31, 1), "png of 2^32-1 rows": png(1, -1),
        "png of 65536x257": png(65536, 257, pixels=bomb), "png of 3 bits": png(bits=3),
        "png of colour kind 5": png(colour=5), "png of method 7": png(method=7),
        "png of interlace 9": png(interlace=9), "png without a palette": png(colour=3),
        "png of no pixels": png(pixels=b""), "png of noise": png(pixels=rng.bytes(5000)),
        "png of half the pixels": png(pixels=zlib.compress(bytes(4000))),
        "png without pixels": png()[:33] + chunk(b"IEND", b""),
        "png of two heads": png(before=png()[8:33]), "animated png": png(before=chunk(b"acTL", bytes(8))),
        "png of ten thousand texts": png(before=tables),
        "png with a chunk beyond the end": png(before=b"\x7f\xff\xff\xfftEXt"),
        "png with a wrong sum": png()[:29] + b"\0\0\0\0" + png()[33:],
        "png with too many pixels": png(pixels=bomb),
        "png with a text bomb": png(before=chunk(b"zTXt", b"a\0\0" + bomb)),
        "png with a profile bomb": png(before=chunk(b"iCCP", b"a\0\0" + bomb)),
        "png and a zip": png() + b"PK\x03\x04" * 1000,
        "png of one pixel": png(1, 1, pixels=zlib.compress(bytes(4))),
    }  # fmt: skip
    return {**others, **jpegs, **pngs}
