"""Decompress bags within bounds of memory and work, which the library `rosbags` does not have.

`bound_reader` replaces the decompression functions of `rosbags` by those of this module.
"""

from __future__ import annotations

import bz2
import functools
import importlib
import io
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

__all__ = ["MAX_CHUNK_BYTES", "Allowance", "bound_reader", "charge"]

MAX_CHUNK_BYTES = 256 << 20
"""Largest decompressed size of a chunk or message; writers close a chunk after some MB and one message."""
_FREE_BYTES = 4 << 30  # bytes that one pass over a bag may decompress, whatever the size of the bag
# Bytes that one pass may decompress, beyond `_FREE_BYTES`, for each byte of the bag.
_EXTRA_BYTES_PER_BAG_BYTE = 200


class Allowance:
    """The number of bytes that one pass over a bag of *size_bytes* may still decompress, ``left_bytes``."""

    def __init__(self, size_bytes: int) -> None:
        self.left_bytes = _FREE_BYTES + _EXTRA_BYTES_PER_BAG_BYTE * size_bytes

    def take(self, size_bytes: int) -> None:
        """Subtract decompressed bytes; raises ValueError if none are left."""
        self.left_bytes -= size_bytes
        if self.left_bytes < 0:
            raise ValueError("the bag decompresses to far more bytes than its file has")


_charged = Allowance(0)  # the allowance from which decompressed bytes are subtracted at present


def charge(allowance: Allowance) -> None:
    """Subtract the size of all decompressed data in this process from *allowance* from now on.

    It replaces the previous allowance.  Decompression raises ValueError once *allowance* is used up.
    """
    global _charged
    _charged = allowance


@functools.cache
def bound_reader() -> None:
    """Replace the decompression functions of `rosbags` in this process by those of this module."""
    names = ("rosbag1.reader", "rosbag2.storage_mcap", "rosbag2.reader")
    modules: list[Any] = [importlib.import_module(f"rosbags.{name}") for name in names]
    ros1, mcap, ros2 = modules
    lz4, zstd = importlib.import_module("lz4.frame").LZ4FrameDecompressor, ros2.zstd.ZstdDecompressor
    ros1.decompressors |= {
        "bz2": functools.partial(_decompress, bz2.BZ2Decompressor),
        "lz4": functools.partial(_decompress, lz4),
    }
    mcap.DECOMPRESSORS |= {
        "lz4": functools.partial(_decompress, lz4),
        "zstd": functools.partial(_decompress, zstd),
    }
    ros2.zstd = SimpleNamespace(
        decompress=functools.partial(_decompress, zstd),
        open=functools.partial(_CountedFile, ros2.zstd.open),
        ZstdError=ros2.zstd.ZstdError,
        ZstdDecompressor=zstd,
    )


def _decompress(make: Callable[[], Any], data: bytes, size: int | None = None) -> bytes:
    """Decompress all streams in *data* with decompressors that *make* returns.

    Raises ValueError if the result is larger than *size* or 256 MiB, if the allowance is used up, or if the
    data are truncated.
    """
    parts: list[bytes] = []
    max_bytes = left = MAX_CHUNK_BYTES if size is None else min(size, MAX_CHUNK_BYTES)
    while data:
        stream = make()
        part: bytes = stream.decompress(data, left + 1)
        left -= len(part)
        if left < 0:
            raise ValueError(f"a chunk or message decompresses to more than {max_bytes} bytes")
        _charged.take(len(part))
        if not stream.eof:
            raise ValueError("a chunk or message is cut off")
        parts.append(part)
        data = stream.unused_data or b""
    return parts[0] if len(parts) == 1 else b"".join(parts)


class _CountedFile(io.RawIOBase):
    """A compressed file whose decompressed bytes are subtracted from the allowance while it is read."""

    def __init__(self, opened: Callable[..., Any], file: Any, mode: str) -> None:
        self._content = opened(file, mode)

    def read(self, size: int = -1) -> bytes:
        """Return the next decompressed bytes; raises ValueError if the allowance is used up."""
        data: bytes = self._content.read(size)
        _charged.take(len(data))
        return data

    def close(self) -> None:
        """Close the compressed file."""
        self._content.close()
        super().close()
